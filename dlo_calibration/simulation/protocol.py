# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Simulator: the interface of an engine; Rollout: a simulated trial."""

from __future__ import annotations

from concurrent.futures import CancelledError
from dataclasses import dataclass, field
from typing import Mapping, Protocol, runtime_checkable, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.core import Stop as Stop  # re-exported
from dlo_calibration.simulation.loads import Loads

# Defaults of both engines and of the options; doc/physics.md shows the small effect of a finer model.
DEFAULT_NODES = 41
DEFAULT_TIME_STEP = 0.003  # s


@dataclass(frozen=True)
class Rollout:
    """
    One simulated trial.

    :param chains: (g, n, 3) [m] simulated points at each of the g goals.
    :param settled: (g,) False if a goal is a stable configuration and the DLO did not come
        to rest within the time limit; its configuration at that time is compared.
    :param duration: simulated time [s].
    :param steps: number of time steps.
    :param loads: the largest ones up to each of the g goals, since the goal before; None if the trial does
        not ask for them, or the engine does not know them.
    :param forces: (f, 3) [N] that the DLO exerts on hands, in the order of `Trial.forces`.
    :raises SimulationError: if a point or a force is not finite.
    """

    chains: Floats
    settled: tuple[bool, ...]
    duration: float
    steps: int
    loads: Loads | None = None
    forces: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        for name, of in (('chains', 'point'), ('forces', 'force')):
            values = frozen_array(getattr(self, name))
            if not np.isfinite(values).all():
                raise SimulationError(f'the rollout diverged: a simulated {of} is not finite')
            object.__setattr__(self, name, values)


Job = tuple[Trial, Mapping[str, float]]  # a trial, and physical parameters by name (SI units)


@runtime_checkable
class Simulator(Protocol):
    """
    Simulates trials; the same call gives the same rollout, bit for bit.

    Any number of threads may call it at the same time.  It is picklable, for other machines.
    """

    name: str

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """
        Simulate a trial with physical parameters by name (SI units).

        :raises SimulationError: if the rollout diverges or the trial cannot
            be represented.
        """

    def refined(self) -> Simulator | None:
        """Return a simulator with twice the segments and half the time step; None if there is none."""

    def close(self) -> None:
        """Free the resources of the simulator; it may be used again afterwards."""


@runtime_checkable
class TogetherSimulator(Protocol):
    """
    A simulator that takes several jobs in one call, and can be stopped in the middle of a rollout.

    :param at_a_time: largest number of jobs that should share a call.
    """

    at_a_time: int

    def simulate_together(self, jobs: Sequence[Job], stop: Stop) -> list[Rollout | SimulationError]:
        """
        Simulate each job; the rollouts are those of `Simulator.simulate`.

        :param stop: once it is set, the call ends within milliseconds; what it returns is not used.
        :returns: the rollouts, or why they failed, in order.
        """

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """Simulate a single trial; see `Simulator`."""
        outcome, = self.simulate_together([(trial, physical)], Stop())
        if isinstance(outcome, SimulationError):
            raise outcome
        return outcome


def simulate_all(simulator: Simulator, jobs: Sequence[Job], stop: Stop) -> list[Rollout | SimulationError]:
    """
    Return the rollout of each job, or why it failed; in one call of a `TogetherSimulator`.

    :raises CancelledError: once `stop` is set.
    """
    if isinstance(simulator, TogetherSimulator) and not stop.is_set():
        outcomes = simulator.simulate_together(jobs, stop)
    else:
        outcomes = []
        for trial, physical in jobs:
            if stop.is_set():
                break
            try:
                outcomes.append(simulator.simulate(trial, physical))
            except SimulationError as error:
                outcomes.append(error)
    if stop.is_set():
        raise CancelledError
    return outcomes
