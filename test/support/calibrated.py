# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A calibrated DLO that a test makes up, without a calibration."""

from dataclasses import dataclass, field
from typing import Mapping

import numpy as np

from dlo_calibration import Chain
from dlo_calibration.calibration.result import ParameterEstimate
from dlo_calibration.model.parameters import PAPER_PARAMETERS, ParameterSpace
from dlo_calibration.model.score import PointErrors

LENGTH = 0.6  # m
LEVEL = 0.004  # m, at which its centre line rests on the table
#: Of a limp rope: name -> value, lower and upper end of its interval.
ROPE = {'flexibility': (66.0, 65.0, 67.0), 'elasticity': (50.0, 20.0, 80.0), 'friction': (70.0, 68.0, 72.0),
        'self_collision': (25.0, 20.0, 30.0)}
#: Of a stiff hose.
HOSE = {**ROPE, 'flexibility': (16.0, 15.0, 17.0)}


@dataclass(frozen=True)
class MadeUpDlo:
    """A DLO with given intervals; see `CalibratedDlo`."""

    intervals: Mapping[str, tuple[float, float, float]] = field(default_factory=lambda: ROPE)
    error: float = 0.0  # m, that the calibration left, root mean square
    correlations: Mapping[str, Mapping[str, float]] | None = None
    length: float = LENGTH
    space: ParameterSpace = field(default_factory=lambda: ParameterSpace(PAPER_PARAMETERS, mass=0.03))

    @property
    def parameters(self) -> dict[str, ParameterEstimate]:
        """The made-up estimates."""
        return {name: self._estimate(name, *interval) for name, interval in self.intervals.items()}

    def _estimate(self, name: str, value: float, lower: float, upper: float) -> ParameterEstimate:
        physical = [self.space.reported(name, one)[0] for one in (value, lower, upper)]
        unit = self.space.reported(name, value)[1]
        return ParameterEstimate(name, value, (upper - lower) / 3.29, lower, upper, *physical, unit, True)

    @property
    def errors(self) -> PointErrors:
        """Errors whose root mean square is `error`."""
        return PointErrors(self.error, self.error, self.error, self.error)


def straight(points: int = 21, length: float = LENGTH) -> Chain:
    """Return a DLO that lies straight along x, its first point in the origin."""
    x = np.linspace(0.0, length, points)
    return Chain(np.stack([x, np.zeros(points), np.full(points, LEVEL)], axis=1))
