# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Knowledge: the parameters that a planner believes a DLO to have: fitted, default or true."""

from __future__ import annotations

from concurrent.futures import CancelledError
from contextlib import closing
from dataclasses import dataclass
import functools
from typing import Any, Callable, Mapping

from dlo_calibration.calibration.calibrate import fitted
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.result import ParameterEstimate
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.experiment.known_dlos import KnownDlo
from dlo_calibration.experiment.study import digest, effective, Observed
from dlo_calibration.model.parameters import BY_NAME, PAPER_PARAMETERS, ParameterSpace
from dlo_calibration.model.score import PointErrors

FITTED, DEFAULT, TRUE = 'fitted', 'default', 'true'


@dataclass(frozen=True)
class Knowledge:
    """
    A `CalibratedDlo` of plain values.

    :param kind: FITTED, DEFAULT or TRUE.
    :param mass: [kg]; `length` [m].
    :param intervals: value of each parameter with the ends of its 90 % interval, on the 0..100 scale; the
        ends equal the value where the planner does not doubt it.
    :param fixed: values of other parameters on the same scale.
    :param errors: point errors of the fit.
    """

    kind: str
    mass: float
    length: float
    intervals: Mapping[str, tuple[float, float, float]]
    fixed: Mapping[str, float]
    errors: PointErrors
    correlations: Mapping[str, Mapping[str, float]] | None = None

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> Knowledge:
        """Build from the values of `asdict`; raise TypeError, KeyError or ValueError for any others."""
        intervals = {name: tuple(map(float, ends)) for name, ends in entry['intervals'].items()}
        return cls(**{**entry, 'intervals': intervals, 'errors': PointErrors(**entry['errors'])})

    @classmethod
    def without_doubt(cls, kind: str, dlo: KnownDlo) -> Knowledge:
        """Return the TRUE or the DEFAULT parameters of a DLO whose mass and length are known."""
        values = dlo.values if kind == TRUE else {name: BY_NAME[name].default for name in PAPER_PARAMETERS}
        return cls(kind, dlo.mass, dlo.length, {name: (value,) * 3 for name, value in values.items()}, {},
                   PointErrors(0.0, 0.0, 0.0, 0.0))

    @property
    def space(self) -> ParameterSpace:
        """The believed parameters, and the values of the others."""
        return ParameterSpace(tuple(self.intervals), self.fixed, self.mass)

    @property
    def parameters(self) -> Mapping[str, ParameterEstimate]:
        """The believed parameters by name."""
        return {name: self._estimate(name, *interval) for name, interval in self.intervals.items()}

    def _estimate(self, name: str, value: float, lower: float, upper: float) -> ParameterEstimate:
        (physical, unit), (one, _), (other, _) = (self.space.reported(name, x) for x in (value, lower, upper))
        return ParameterEstimate(name, value, 0.0, lower, upper, physical, min(one, other), max(one, other),
                                 unit, True)


@dataclass(frozen=True)
class Calibration:
    """
    A calibration of a known DLO, which gives FITTED knowledge.

    :param engine: name of the simulator that will be used.
    """

    dlo: KnownDlo
    observed: Observed
    engine: str

    @property
    def about(self) -> dict[str, Any]:
        """Plain values that tell a reader of the journal which calibration it is."""
        return {'object': self.dlo.name, 'engine': self.engine}

    @functools.cached_property
    def key(self) -> str:
        """A digest of all that the outcome depends on."""
        return digest(self.engine, self.observed.trials, effective(self.observed.options))


def learn(task: Calibration, make_simulator: SimulatorFactory,
          should_stop: Callable[[], bool] = lambda: False) -> Knowledge:
    """
    Calibrate once, on one thread.

    :raises SimulationError: if no evaluation could be simulated.
    :raises CancelledError: if stopped.
    """
    options = task.observed.options
    with closing(make_simulator(options)) as simulator:
        found = fitted(Setting(task.observed.trials, options, simulator, should_stop=should_stop))
    if should_stop():
        raise CancelledError
    return Knowledge(
        FITTED, found.space.mass, found.length,
        {name: (one.value, one.lower, one.upper) for name, one in found.parameters.items()},
        found.space.fixed, found.errors, found.correlations)
