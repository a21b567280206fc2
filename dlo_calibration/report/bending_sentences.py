# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Sentences about what a DLO remembers: its rest shape, and the bend that it keeps."""

from __future__ import annotations

from collections import Counter

import numpy as np

from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.inference.uncertainty import IDENTIFIABLE, NOT_IDENTIFIABLE, WEAK
from dlo_calibration.model.bending import natural_curvature
from dlo_calibration.model.parameters import knot_names
from dlo_calibration.model.quantity import interval, measured, number

DRAWS = 200  # of the posterior, for an interval


def rest_shape_sentences(result: CalibrationResult) -> list[str]:
    """Say how curved a DLO is when nothing bends it, and where; nothing if its rest shape has no knots."""
    names = [name for name in knot_names(result.space.knots) if name in result.parameters]
    if not names:
        return []
    from dlo_calibration.planning.dlo import Posterior  # the planner comes with it, which few results need

    places = np.linspace(0, 1, 101)
    size = np.hypot(*natural_curvature(result.physical(), places).T)
    most = int(size.argmax())
    drawn = [float(np.hypot(*natural_curvature(one, places[most:most + 1])[0]))
             for one in Posterior.of(result).draws(DRAWS, seed=0)]
    low, high = np.percentile(drawn, (5, 95)).tolist()
    verdicts = Counter(result.parameters[name].verdict for name in names)
    known = [f'{verdicts[verdict]} {words}' for verdict, words in (
        (IDENTIFIABLE, 'are known well'), (WEAK, 'only roughly'),
        (NOT_IDENTIFIABLE, 'could not be determined')) if verdicts[verdict]]
    return [
        'When nothing bends it, the DLO is curved: most at '
        f'{number(100 * places[most])} % of its length, by {_with_radius(size[most])}, with 90 % probability '
        f'{interval(low, high, "1/m")}; least at {number(100 * places[size.argmin()])} %, by '
        f'{measured(size.min(), "1/m")}.',
        f'Of the {len(names)} components of this rest shape, {names[0]} to {names[-1]}, '
        f'{", ".join(known)}.']


def friction_sentences(result: CalibrationResult) -> list[str]:
    """Say how much of a bend the DLO keeps; nothing if it keeps none, or if that is not known."""
    if not keeps_bends(result):
        return []
    physical, unsure = result.physical(), _verdict(result, 'bending_friction') == WEAK
    slips = '' if _verdict(result, 'bending_slip') == NOT_IDENTIFIABLE else (
        f'; they slip where the curvature changes by more than {measured(physical["bending_slip"], "1/m")}')
    return [f'Bent far and released, the DLO {"may keep" if unsure else "keeps"} a curvature of up to '
            f'{_with_radius(physical["bending_friction"])}, because its strands rub on each other{slips}.']


def keeps_bends(result: CalibrationResult) -> bool:
    """Tell whether it is known that there is friction between the strands."""
    return result.physical().get('bending_friction', 0.0) > 0 and \
        _verdict(result, 'bending_friction') != NOT_IDENTIFIABLE


def _verdict(result: CalibrationResult, name: str) -> str:
    """Return the verdict on a found parameter; empty for others."""
    return result.parameters[name].verdict if name in result.parameters else ''


def _with_radius(curvature: float) -> str:
    return f'{measured(curvature, "1/m")} (a radius of {measured(1 / curvature, "m")})' if curvature > 0 \
        else measured(curvature, '1/m')
