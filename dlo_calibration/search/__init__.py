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

"""Search methods behind ask / tell; SEARCHES is the table of them."""

from __future__ import annotations

from typing import Callable, Mapping

from dlo_calibration.search.cma_es import CmaEs
from dlo_calibration.search.descent import Fit
from dlo_calibration.search.least_squares import LeastSquares
from dlo_calibration.search.protocol import Hints, Observation, Search
from dlo_calibration.search.random import RandomSearch
from dlo_calibration.search.sequential import Sequential

__all__ = ['CmaEs', 'Fit', 'Hints', 'LeastSquares', 'Observation', 'RandomSearch', 'Search', 'SEARCHES',
           'Sequential']

#: name -> constructor(dimension, seed, hints=None)
SEARCHES: Mapping[str, Callable[..., Search]] = {
    LeastSquares.name: LeastSquares,
    RandomSearch.name: RandomSearch,
    CmaEs.name: CmaEs,
    Sequential.name: Sequential,
}
