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

"""The package's exceptions: one base, and what an unusable input is called."""

from __future__ import annotations


class DloCalibrationError(Exception):
    """Base of every error that this package raises on purpose."""


class InputError(DloCalibrationError):
    """
    An input that cannot be used.

    The message always answers the same four questions, so that a person who
    reads it in a log can act without opening the code.

    :param thing: which input, e.g. ``goal_chain stamped 12.5 s``.
    :param came: what was found in it.
    :param expected: what would have been accepted.
    :param remedy: what to do about it.
    """

    def __init__(self, thing: str, came: str, expected: str, remedy: str) -> None:
        super().__init__(thing, came, expected, remedy)
        self.thing = thing
        self.came = came
        self.expected = expected
        self.remedy = remedy

    def __str__(self) -> str:
        return f'{self.thing}: got {self.came}, expected {self.expected}; {self.remedy}'


class SimulationError(DloCalibrationError):
    """A trial that an engine cannot simulate, or a rollout that diverged."""
