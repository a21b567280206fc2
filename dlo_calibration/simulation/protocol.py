# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Simulator: what an engine does, and what a simulated trial is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Mapping, Protocol

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.trial import Trial

DEFAULT_NODES = 41
DEFAULT_TIME_STEP = 0.003  # s


@dataclass(frozen=True)
class Rollout:
    """
    One simulated trial.

    :param chains: (g, n, 3) [m] the simulated points at each of the g goals.
    :param settled: (g,) False where a goal is a stable configuration and the
        DLO had not come to rest within the time limit; it is compared as it was.
    :param duration: simulated time [s].
    :param steps: time steps taken.
    :raises SimulationError: where a point is not finite.
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


class Simulator(Protocol):
    """
    Simulates trials; the same call gives the same rollout, bit for bit.

    It is pickled to worker processes, and copied for worker threads, so what
    belongs to one process or thread is made at the first `simulate` and dropped
    by `__getstate__`.
    """

    name: str

    def prepare(self) -> None:
        """
        Do once what all copies would else do each for itself, e.g. compile into a cache.

        Called before the first copy is made.
        """

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """
        Simulate a trial with physical parameters by name (SI units).

        :raises SimulationError: where the rollout diverges or the trial cannot
            be represented.
        """

    def refined(self) -> Simulator | None:
        """Return one with twice the nodes and half the time step; None where it has no such thing."""

    def close(self) -> None:
        """Free what the simulator holds; it may be used again afterwards."""
