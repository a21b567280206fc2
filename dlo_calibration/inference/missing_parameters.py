# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Missing parameters: which of those that were held fixed would explain what a fit leaves over."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Callable, Iterator, Sequence

import numpy as np

from dlo_calibration.evaluation.evaluator import Evaluator
from dlo_calibration.evaluation.linearisation import Linearisation, perpendicular
from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import BY_NAME, Parameter, PARAMETERS, ParameterSpace, PART_NAMES, SCALE

PARTS = 'parts'  # the name where it is parts of different stiffness that are missing
TRIED_PARTS = 4  # so that a middle stiffer than both ends shows
MOVE = 0.15  # that a parameter is moved, in the unit cube;
LONG_MOVE = 0.5  # from where it is nothing at all
FURTHEST = 2.0  # times that move, to which its effect is trusted to grow
WORTH_TELLING = 0.1  # of the squares that are left


@dataclass(frozen=True)
class MissingParameter:
    """
    A parameter that a calibration held fixed, and that the trials ask for.

    :param name: of the parameter, or PARTS.
    :param share: of the sum of squares left over, that it would explain.
    """

    name: str
    share: float


def missing_parameters(evaluator: Evaluator, fit: Linearisation,
                       should_stop: Callable[[], bool] = lambda: False) -> tuple[MissingParameter, ...]:
    """
    Return what would explain at least a tenth of what is left, most first.

    Each parameter that was held fixed is moved once; what counts is its effect
    on the residuals that the free ones cannot have (a score test: Rao, Linear
    Statistical Inference and Its Applications, 1973, 6e.3).

    :param evaluator: of the calibration.
    :param fit: the residuals around what was found.
    :raises CancelledError: when stopped.
    """
    roots = Huber.of(fit.residuals).roots(fit.residuals)
    weighted = fit.weighted(roots)
    left = perpendicular(weighted.jacobian, weighted.residuals)
    found = []
    for name, wider, moves in _candidates(evaluator.space):
        wide = Evaluator(evaluator.trials, wider, evaluator.simulator)
        columns = []
        for move in moves:
            seen = wide.evaluate(0, np.concatenate([fit.point, move]), should_stop).residuals
            if seen is not None:
                columns.append(perpendicular(weighted.jacobian, roots * (seen - fit.residuals)))
        share = _explained(left, columns, BY_NAME[name] if name != PARTS else None)
        if share >= WORTH_TELLING:
            found.append(MissingParameter(name, share))
    return tuple(sorted(found, key=lambda one: -one.share))


def _candidates(space: ParameterSpace) -> Iterator[tuple[str, ParameterSpace, Floats]]:
    """Yield names, the spaces with what is added, and the (k, a) places of that in the unit cube."""
    for parameter in PARAMETERS:
        name = parameter.name
        if name in space.free or name in PART_NAMES or name == 'mass' and not space.mass_known:
            continue
        fixed = {key: value for key, value in space.fixed.items() if key != name}
        now = space.fixed.get(name, parameter.default) / SCALE
        step = LONG_MOVE if _is_nothing(parameter, now) else MOVE
        yield (name, replace(space, free=(*space.free, name), fixed=fixed),
               np.array([[now + step if now + step <= 1 else now - step]]))
    if space.parts == 1 and 'flexibility' in space.free:
        divided = space.divided(TRIED_PARTS)
        even = np.array([BY_NAME[name].default for name in PART_NAMES[:TRIED_PARTS - 1]]) / SCALE
        yield PARTS, divided, even + MOVE * np.eye(len(even))


def _is_nothing(parameter: Parameter, now: float) -> bool:
    """Tell whether a parameter means at the lower end of a logarithmic scale that there is nothing of it."""
    return parameter.neutral == 0 and not parameter.linear and now == 0


def _explained(left: Floats, columns: Sequence[Floats], parameter: Parameter | None) -> float:
    """Return the share of (m,) what is left that a combination of (m,) columns, not too long, takes away."""
    from scipy.optimize import lsq_linear

    matrix = np.stack(columns, axis=1) if columns else np.zeros((len(left), 0))
    total = float(left @ left)
    if not total > 0 or not float(np.square(matrix).sum()) > 0:
        return 0.0
    # What is nothing at its default cannot be less.
    least = 0.0 if parameter is not None and parameter.neutral == 0 else -FURTHEST
    steps = lsq_linear(matrix, -left, (least, FURTHEST), method='bvls').x
    rest = left + matrix @ steps
    return 1 - float(rest @ rest) / total
