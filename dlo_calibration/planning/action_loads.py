# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""ActionLoads: the largest loads that a DLO bears in an action, with their 90 % intervals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Sequence

import numpy as np

from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.planning.dlo import intervals
from dlo_calibration.planning.rehearsal import Rehearsal

KEYS = ('least_bend_radius', 'most_tension', 'most_strain')
UNITS = ('_m', '_n', '')


@dataclass(frozen=True)
class ActionLoads:
    """
    The largest loads of a DLO from the start of an action until it rests, or the next action begins.

    :param most: (3,) sharpest curvature [1/m], largest tension [N], and largest strain, with the best
        parameters.
    :param places: (3,) [m] arc lengths where they occur.
    :param lower: (3,) lower ends of their 90 % intervals; `upper` (3,) upper ends.
    """

    most: Floats
    places: Floats
    lower: Floats
    upper: Floats

    @property
    def least_bend_radius(self) -> float:
        """The radius [m] of the sharpest bend; infinite if the DLO stays straight."""
        return _radius(self.most[0])

    @property
    def most_tension(self) -> float:
        """The largest tension [N]."""
        return float(self.most[1])

    @property
    def most_strain(self) -> float:
        """The largest strain."""
        return float(self.most[2])

    @property
    def ends(self) -> tuple[tuple[float, float], ...]:
        """Lower and upper ends of the intervals of the least bend radius [m], of tension [N], of strain."""
        return ((_radius(self.upper[0]), _radius(self.lower[0])),
                *((float(self.lower[k]), float(self.upper[k])) for k in (1, 2)))


def _radius(curvature: float) -> float:
    return 1 / float(curvature) if curvature > 0 else float('inf')


def loads_of_actions(best: Rehearsal, drawn: Sequence[Rehearsal], finer: Rehearsal | None = None
                     ) -> tuple[ActionLoads | None, ...]:
    """
    Return the loads in each action of a rehearsal; None where the engine does not know them.

    :param best: with the best parameters, which has not failed; `drawn` with draws from the posterior, of
        which those that failed do not count.
    :param finer: by a finer simulation, to which the difference widens the intervals; None: there is none.
    """
    if best.loads is None:
        return (None,) * len(best.chains)
    lower, upper = intervals(
        best.loads.most, [draw.loads.most for draw in drawn if draw.loads is not None], 0.0,
        None if finer is None or finer.loads is None else finer.loads.most)
    return tuple(ActionLoads(best.loads.most[k], best.loads.places[k], frozen_array(np.maximum(lower[k], 0)),
                             frozen_array(upper[k])) for k in range(len(lower)))


def plain_loads(loads: ActionLoads | None) -> dict[str, Any]:
    """Return loads as plain values, in m and N; of an action whose loads are unknown, each is None."""
    values: dict[str, Any] = {}
    for k, (key, unit) in enumerate(zip(KEYS, UNITS, strict=True)):
        known = None if loads is None else (
            (loads.least_bend_radius, loads.most_tension, loads.most_strain)[k], float(loads.places[k]),
            list(loads.ends[k]))
        names = (f'{key}{unit}', f'{key}_at_m', f'{key}_lower_upper{unit}')
        values.update(zip(names, known or (None,) * 3, strict=True))
    return values
