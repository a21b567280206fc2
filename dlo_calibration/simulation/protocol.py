# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Simulator: the interface of an engine; Rollout: a simulated trial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Callable, Iterator, Mapping, Protocol, runtime_checkable, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.trial import Trial

# Defaults of both engines and of the options; doc/physics.md shows how little a finer model changes.
DEFAULT_NODES = 41
DEFAULT_TIME_STEP = 0.003  # s

_advances = [0]


def advanced() -> None:
    """Count one more piece of a simulation in this process; called at least every few seconds."""
    _advances[0] += 1


def advances() -> int:
    """Return how many pieces were counted in this process; what hangs does not count any more."""
    return _advances[0]


@dataclass(frozen=True)
class Rollout:
    """
    One simulated trial.

    :param chains: (g, n, 3) [m] simulated points at each of the g goals.
    :param settled: (g,) False if a goal is a stable configuration and the DLO did not come
        to rest within the time limit; its configuration at that time is compared.
    :param duration: simulated time [s].
    :param steps: number of time steps.
    :raises SimulationError: if a point is not finite.
    """

    chains: Floats
    settled: tuple[bool, ...]
    duration: float
    steps: int

    def __post_init__(self) -> None:
        chains = frozen_array(self.chains)
        if not np.isfinite(chains).all():
            raise SimulationError('the rollout diverged: a simulated point is not finite')
        object.__setattr__(self, 'chains', chains)


Job = tuple[Trial, Mapping[str, float]]  # a trial, and physical parameters by name (SI units)


class Simulator(Protocol):
    """
    Simulates trials; the same call gives the same rollout, bit for bit.

    Worker processes get a pickled simulator and worker threads a copy.  So the first
    `simulate` creates what belongs to one process or thread, and `__getstate__` drops it.
    """

    name: str

    def prepare(self) -> None:
        """
        Do once what each copy would do again otherwise, e.g. compile into a cache.

        It is called before the first copy is made.
        """

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
    """A simulator to which several rollouts at a time are less work."""

    def simulate_together(self, jobs: Sequence[Job], between: Callable[[], None]
                          ) -> list[Rollout | SimulationError]:
        """
        Simulate each job; the rollouts are those of `Simulator.simulate`.

        :param between: is called again and again; what it raises ends the simulation.
        :returns: the rollouts, or why they failed, in order.
        """


def simulate_one(simulator: TogetherSimulator, job: Job) -> Rollout:
    """
    Return the rollout of one job by a simulator that takes several.

    :raises SimulationError: if it failed.
    """
    found, = simulator.simulate_together([job], lambda: None)
    if isinstance(found, SimulationError):
        raise found
    return found


def simulate_all(simulator: Simulator, jobs: Sequence[Job], between: Callable[[], None]
                 ) -> Iterator[Rollout | SimulationError]:
    """Yield the rollout of each job, or why it failed; together if the simulator can."""
    if isinstance(simulator, TogetherSimulator) and len(jobs) > 1:
        yield from simulator.simulate_together(jobs, between)
        return
    for trial, physical in jobs:
        between()
        try:
            rollout = simulator.simulate(trial, physical)
        except SimulationError as error:
            yield error
        else:
            advanced()
            yield rollout
