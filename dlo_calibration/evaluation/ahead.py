# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""SimulatedAhead: rollouts that an executor simulates while this thread does something else."""

from __future__ import annotations

from concurrent.futures import Executor
from typing import Mapping, Sequence

from dlo_calibration.evaluation.kept import kept_simulator, packed_simulator
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.protocol import Rollout, Simulator


class SimulatedAhead:
    """
    A simulator of some trials with one parameter set, whose rollouts are under way from the beginning.

    :param simulator: sent to the executor, whose workers keep it; it is closed with this one.
    :param executor: simulates the trials, each in one call.
    :param physical: parameters by name (SI units).
    """

    def __init__(self, simulator: Simulator, executor: Executor, trials: Sequence[Trial],
                 physical: Mapping[str, float]) -> None:
        self.name = simulator.name
        self._simulator, self._physical = simulator, dict(physical)
        packed = packed_simulator(simulator)
        self._rollouts = {id(trial): executor.submit(_simulated, packed, trial, self._physical)
                          for trial in trials}

    def prepare(self) -> None:
        """Need nothing."""

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """
        Return the rollout of a trial, as soon as it is finished; of another one, simulate it here.

        :raises SimulationError: if the rollout diverges.
        """
        rollout = self._rollouts.get(id(trial))
        if rollout is None or dict(physical) != self._physical:
            return self._simulator.simulate(trial, physical)
        return rollout.result()

    def refined(self) -> None:
        """Have no finer one."""

    def close(self) -> None:
        """Cancel the rollouts that have not begun."""
        for rollout in self._rollouts.values():
            rollout.cancel()
        self._simulator.close()


def _simulated(packed: bytes, trial: Trial, physical: Mapping[str, float]) -> Rollout:
    """Simulate a trial in a worker."""
    return kept_simulator(packed).simulate(trial, physical)
