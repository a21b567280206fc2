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


"""The node with the toy as its engine: `toy_calibrator.py SECONDS_PER_SIMULATION [--ros-args ...]`."""

import functools
import sys

from dlo_calibration.signals import StopFlag


def make_toy(seconds, options):
    """Return a toy that takes `seconds` for a simulation."""
    from toy_simulator import ToySimulator

    return ToySimulator(seconds)


def main():
    """Run it, as `dlo_calibration.calibrator` runs the real one."""
    stop = StopFlag()
    stop.listen()
    from dlo_calibration.node import spin

    code = spin(sys.argv[2:], stop, functools.partial(make_toy, float(sys.argv[1])))
    stop.ignore()
    return code


if __name__ == '__main__':
    sys.exit(main())
