# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Unmade: a simulator that is made where it simulates; a process that sends it to others loads no kernels."""

from __future__ import annotations

from typing import Any, Callable, Mapping, Sequence

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.kernel_cache import is_compiled, SIMULATION
from dlo_calibration.simulation.protocol import Job, Rollout, simulate_all, Simulator


class Unmade:
    """
    A simulator that is made when it first simulates; pickled or copied, it becomes the simulator itself.

    :param name: of the engine.
    :param make: a function of a module, which makes the simulator.
    :param arguments: of this function.
    :param finer: whether to refine it once it is made.
    """

    def __init__(self, name: str, make: Callable[..., Simulator], *arguments: Any,
                 finer: bool = False) -> None:
        self.name = name
        self._parts = make, *arguments
        self._finer = finer
        self._made: Simulator | None = None

    @property
    def _itself(self) -> Simulator:
        self._made = self._made or _new(self._finer, *self._parts)
        return self._made

    def prepare(self) -> None:
        """See to it that the kernels are compiled."""
        if not is_compiled(SIMULATION):
            self._itself.prepare()

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """Simulate a trial; see `Simulator`."""
        return self._itself.simulate(trial, physical)

    def refined(self) -> Simulator | None:
        """Return a simulator with twice the segments and half the time step, not made yet, if possible."""
        return self._itself.refined() if self._finer else type(self)(self.name, *self._parts, finer=True)

    def close(self) -> None:
        """Close it if it was made."""
        if self._made is not None:
            self._made.close()

    def __reduce__(self) -> tuple[Callable[..., Simulator], tuple[Any, ...]]:
        return _new, (self._finer, *self._parts)


class UnmadeTogether(Unmade):
    """One that is given several rollouts at a time."""

    def simulate_together(self, jobs: Sequence[Job], between: Callable[[], None] = lambda: None
                          ) -> list[Rollout | SimulationError]:
        """Simulate each job; see `TogetherSimulator`."""
        return list(simulate_all(self._itself, jobs, between))


def _new(finer: bool, make: Callable[..., Simulator], *arguments: Any) -> Simulator:
    made = make(*arguments)
    refined = made.refined() if finer else None
    return refined or made
