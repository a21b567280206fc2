# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A search written as a plan: a generator that yields points and receives their observations."""

from __future__ import annotations

from typing import Generator, Sequence

import numpy as np

from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.model.chain import Floats
from dlo_calibration.search.protocol import Observation

#: It yields (m, d) points, receives their m observations, and returns why it finished, in words.
Plan = Generator[Floats, Sequence[Observation], str]


class PlannedSearch:
    """
    Offer a plan as ask / tell.

    A batch that the plan yields may be asked in portions of any size; the points
    do not depend on the portions.

    :param dimension: number of parameters.
    """

    def __init__(self, dimension: int) -> None:
        self._dimension = dimension
        self._plan_under_way: Plan | None = None
        self._batch: Floats = np.zeros((0, dimension))
        self._told: list[Observation] = []
        self._reason = ''

    def _plan(self) -> Plan:
        raise NotImplementedError

    def ask(self, limit: int) -> Floats:
        """Return the next (m, d) points, m <= limit; none once the plan has ended."""
        if self._plan_under_way is None:
            self._plan_under_way = self._plan()
            self._batch = np.asarray(next(self._plan_under_way), dtype=float)
        return self._batch[len(self._told):][:limit].copy()

    def tell(self, observations: Sequence[Observation]) -> None:
        """Take the results of the last `ask`; continue the plan once its batch is complete."""
        self._told.extend(observations)
        if self._plan_under_way is None or self._reason or len(self._told) < len(self._batch):
            return
        told, self._told = self._told, []
        try:
            self._batch = np.asarray(self._plan_under_way.send(told), dtype=float)
        except StopIteration as end:
            self._batch, self._reason = np.zeros((0, self._dimension)), str(end.value)

    @property
    def model(self) -> Linearisation | None:
        """None: the method makes no linear model."""
        return None

    @property
    def stop_reason(self) -> str:
        """Why the plan ended, in words; empty until then."""
        return self._reason
