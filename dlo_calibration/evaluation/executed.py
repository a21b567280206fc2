# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Executed: a simulator whose rollouts an executor simulates, several at a time."""

from __future__ import annotations

from concurrent.futures import Executor, wait
from typing import Callable, Mapping, Sequence

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.protocol import Job, Rollout, simulate_all, simulate_one, Simulator

PERIOD = 0.05  # s between two calls of `between`


class Executed:
    """
    A simulator whose rollouts are shared by the workers of an executor.

    :param simulator: sent to the executor with each portion.
    """

    def __init__(self, simulator: Simulator, executor: Executor) -> None:
        self.name = simulator.name
        self._simulator, self._executor = simulator, executor

    def prepare(self) -> None:
        """Need nothing."""

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """
        Simulate a trial with physical parameters by name (SI units).

        :raises SimulationError: if the rollout diverges.
        """
        return simulate_one(self, (trial, physical))

    def simulate_together(self, jobs: Sequence[Job], between: Callable[[], None] = lambda: None
                          ) -> list[Rollout | SimulationError]:
        """Simulate each job, a portion in each worker; see `TogetherSimulator`."""
        portions = min(getattr(self._executor, 'workers', 1), len(jobs))
        futures = [self._executor.submit(_simulated, self._simulator, jobs[k::portions])
                   for k in range(portions)]
        try:
            while wait(futures, PERIOD).not_done:
                between()
        finally:
            for future in futures:
                future.cancel()
        found: list[Rollout | SimulationError | None] = [None] * len(jobs)
        for k, future in enumerate(futures):
            found[k::portions] = future.result()
        return [one for one in found if one is not None]

    def refined(self) -> Executed | None:
        """Return a simulator with twice the segments and half the time step; None if there is none."""
        finer = self._simulator.refined()
        return None if finer is None else Executed(finer, self._executor)

    def close(self) -> None:
        """Leave the executor to others."""


def _simulated(simulator: Simulator, jobs: Sequence[Job]) -> list[Rollout | SimulationError]:
    """Simulate jobs in a worker, with a simulator that was sent with them."""
    try:
        return list(simulate_all(simulator, jobs, lambda: None))
    finally:
        simulator.close()
