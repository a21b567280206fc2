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


"""Engines: the table of simulators that a user can choose, by name."""

from __future__ import annotations

from typing import Callable, Mapping

from dlo_calibration.config import Options
from dlo_calibration.simulator import Simulator


def _bullet(options: Options) -> Simulator:
    from dlo_calibration.bullet import BulletSimulator

    return BulletSimulator(
        table=options.table, table_height=options.table_height, nodes=options.nodes,
        time_step=options.time_step, stable_distance=options.stable_distance,
        stable_time=options.stable_time, settle_limit=options.settle_limit)


#: name -> constructor; each imports its engine only when it is called
ENGINES: Mapping[str, Callable[[Options], Simulator]] = {
    'bullet': _bullet,
}


def make_simulator(options: Options) -> Simulator:
    """Return the simulator that `options` ask for."""
    return ENGINES[options.engine](options)
