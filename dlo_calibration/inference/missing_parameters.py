# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Missing parameters: which parameters that were held fixed would explain the residuals of a fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Callable, Iterator, Sequence

import numpy as np

from dlo_calibration.evaluation.batch import BatchEvaluator
from dlo_calibration.evaluation.linearisation import Linearisation, perpendicular
from dlo_calibration.evaluation.residuals import Huber
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import (
    BY_NAME,
    HANDS,
    Parameter,
    PARAMETERS,
    ParameterSpace,
    PART_NAMES,
    REST_STATE,
    SCALE,
    STIFFNESS_KNOTS,
)
from dlo_calibration.search.descent import bounded_least_squares

PARTS = 'parts'  # stands for parts of different bending stiffness
MOVE = 0.15  # change of a parameter, in units of a search: well above the noise of a simulation
FURTHEST = 2.0  # the effect is extrapolated to this multiple of the change, but no further


@dataclass(frozen=True)
class MissingParameter:
    """
    A parameter that a calibration held fixed although it would explain part of the residuals.

    :param name: of the parameter, or PARTS.
    :param share: the part of the sum of squared residuals that it would explain, 0..1.
    """

    name: str
    share: float


def missing_parameters(space: ParameterSpace, evaluate: Callable[[ParameterSpace], BatchEvaluator],
                       fit: Linearisation, parts: bool = True) -> tuple[MissingParameter, ...]:
    """
    Return the parameters that would explain at least a tenth of the squared residuals, largest share first.

    Each parameter that was held fixed is changed once.  Only the part of its effect that the free parameters
    cannot imitate counts (a score test: Rao, Linear Statistical Inference and Its Applications, 1973, 6e.3).

    :param space: of the calibration.
    :param evaluate: returns an evaluator for another space, which compares the goals that `fit` does.
    :param fit: linear model of the residuals at the found parameters.
    :param parts: False: the calibration has already tried parts of different stiffness.
    :raises CancelledError: when stopped.
    """
    roots = Huber.of(fit.residuals).roots(fit.residuals)
    weighted = fit.weighted(roots)
    unexplained = perpendicular(weighted.jacobian, weighted.residuals)
    pending = [(name, evaluate(wider).begin(np.hstack([np.tile(fit.point, (len(moves), 1)), moves])))
             for name, wider, moves in _candidates(space, parts)]
    missing = []
    for name, ended in pending:
        columns = [perpendicular(weighted.jacobian, roots * (residuals - fit.residuals))
                   for residuals in ended() if residuals is not None]
        share = _explained(unexplained, columns, BY_NAME[name] if name != PARTS else None)
        if share >= 0.1:
            missing.append(MissingParameter(name, share))
    return tuple(sorted(missing, key=lambda parameter: -parameter.share))


def _candidates(space: ParameterSpace, parts: bool = True) -> Iterator[tuple[str, ParameterSpace, Floats]]:
    """Yield names, spaces with a more free parameters, and (k, a) values of these in the box to try."""
    for parameter in PARAMETERS:
        name = parameter.name
        if name in (*space.free, *PART_NAMES, *STIFFNESS_KNOTS, *REST_STATE, *HANDS) \
                or _is_idle(name, space):
            continue
        fixed = {key: value for key, value in space.fixed.items() if key != name}
        now = space.fixed.get(name, parameter.default) / SCALE * parameter.extent
        # At the lower end of a logarithmic scale, such an effect is absent.
        step = 0.5 if parameter.neutral == 0 and not parameter.linear and now == 0 else MOVE
        yield (name, replace(space, free=(*space.free, name), fixed=fixed),
               np.array([[now + step if now + step <= parameter.extent else now - step]]))
    if parts and space.parts == 1 and 'flexibility' in space.free and STIFFNESS_KNOTS[0] not in space.free:
        divided = space.divided(4)  # four parts can show a middle that is stiffer than both ends
        even = np.array([BY_NAME[name].default / SCALE * BY_NAME[name].extent for name in PART_NAMES[:3]])
        yield PARTS, divided, even + MOVE * np.eye(len(even))


def _is_idle(name: str, space: ParameterSpace) -> bool:
    """Tell whether a parameter has no effect of its own beside the free and the fixed ones."""
    if name == 'bending_slip':
        return 'bending_friction' not in space.free and not space.fixed.get('bending_friction', 0.0)
    return name == 'mass' and not space.mass_known or name == 'natural_curvature' and space.knots > 0


def _explained(unexplained: Floats, columns: Sequence[Floats], parameter: Parameter | None) -> float:
    """Return the share of the squares of `left` (m,) that a bounded combination of (m,) columns explains."""
    matrix = np.stack(columns, axis=1) if columns else np.zeros((len(unexplained), 0))
    total = float(unexplained @ unexplained)
    if not total > 0 or not float(np.square(matrix).sum()) > 0:
        return 0.0
    # An effect that is absent at its default cannot be negative.
    least = 0.0 if parameter is not None and parameter.neutral == 0 else -FURTHEST
    bounds = np.full(len(columns), least), np.full(len(columns), FURTHEST)
    steps = bounded_least_squares(matrix, -unexplained, *bounds)
    rest = unexplained + matrix @ steps
    return 1 - float(rest @ rest) / total
