# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A search written as a plan: a generator that yields points and is sent what they gave."""

from __future__ import annotations

from typing import Generator, Sequence

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.search.protocol import Observation

#: Yields (m, d) points, is sent their m observations, and returns why it finished, in words.
Plan = Generator[Floats, Sequence[Observation], str]


class PlannedSearch:
    """
    Ask / tell around a plan.

    What the plan yields at once may be asked in any portions; the points are
    the same however they are divided.

    :param dimension: number of parameters.
    """

    def __init__(self, dimension: int) -> None:
        self._dimension = dimension
        self._running: Plan | None = None
        self._wanted: Floats = np.zeros((0, dimension))
        self._told: list[Observation] = []
        self._reason = ''

    def _plan(self) -> Plan:
        raise NotImplementedError

    def ask(self, limit: int) -> Floats:
        """Return the next (m, d) points, m <= limit; none once the plan has ended."""
        if self._running is None:
            self._running = self._plan()
            self._wanted = np.asarray(next(self._running), dtype=float)
        return self._wanted[len(self._told):][:limit].copy()

    def tell(self, observations: Sequence[Observation]) -> None:
        """Take what the points last asked gave; go on with the plan once all are there."""
        self._told.extend(observations)
        if self._running is None or self._reason or len(self._told) < len(self._wanted):
            return
        told, self._told = self._told, []
        try:
            self._wanted = np.asarray(self._running.send(told), dtype=float)
        except StopIteration as end:
            self._wanted, self._reason = np.zeros((0, self._dimension)), str(end.value)

    @property
    def stop_reason(self) -> str:
        """Why the plan ended, in words; empty while it has not."""
        return self._reason
