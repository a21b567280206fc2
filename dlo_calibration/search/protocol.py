# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What a search method is: it asks for points of the unit cube and is told what they gave."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Sequence

from dlo_calibration.chain import Floats


@dataclass(frozen=True)
class Observation:
    """
    What one point gave.

    :param point: (d,) in the unit cube.
    :param score: to be minimised; infinite where the simulation failed.
    :param residuals: (m,) [m] simulated minus observed coordinates of all
        trials; None where the simulation failed.
    """

    point: Floats
    score: float
    residuals: Floats | None


class Search(Protocol):
    """A minimiser over the unit cube.  It never sees a trial or a physical unit."""

    name: str

    def ask(self, limit: int) -> Floats:
        """
        Return the next (m, d) points to evaluate, m <= limit.

        How many is the method's choice and never depends on the number of
        workers.  No points at all means that it has finished.
        """

    def tell(self, observations: Sequence[Observation]) -> None:
        """Take the results of the last `ask`, in the order asked."""

    @property
    def stop_reason(self) -> str:
        """Why it finished, in words; empty while it has not."""
