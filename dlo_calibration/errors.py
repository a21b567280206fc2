# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The package's exceptions: one base class, unusable inputs, and simulations that fail."""

from __future__ import annotations


class DloCalibrationError(Exception):
    """Base of every error that this package raises on purpose."""


class InputError(DloCalibrationError):
    """
    An input that cannot be used.

    The message always answers the same four questions, so that its reader can act
    without opening the code.

    :param thing: which input, e.g. ``goal_chain stamped 12.5 s``.
    :param came: what was found in it.
    :param expected: what would have been accepted.
    :param remedy: what the user can do.
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


def unwritable(path: object, error: OSError, kind: str = 'file') -> InputError:
    """Return the error for a file, or another `kind` of path, that cannot be written."""
    return InputError(f'{kind} {path}', error.strerror or str(error), 'a place that can be written to',
                      'choose another one with --output')
