# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Output: verbs print JSON or tables on stdout, and everything else on stderr."""

from __future__ import annotations

from contextlib import contextmanager, suppress
import json
import os
import sys
from typing import Any, Iterator, Mapping, Sequence, TextIO, TYPE_CHECKING

from dlo_calibration.errors import DloCalibrationError, printable

if TYPE_CHECKING:
    from dlo_calibration.calibration.result import CalibrationResult


def tell(text: str) -> None:
    """Print a line on stderr, if that is possible."""
    with suppress(OSError):  # where stderr is a file on a full disk, the work goes on
        sys.stderr.write(f'{printable(text)}\n')


def flush() -> None:
    """Write what waits for stdout and stderr; if that fails, drop it, so that Python's end does not fail."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):  # ValueError: it is closed
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@contextmanager
def standard_output() -> Iterator[TextIO]:
    """
    Give the stream for what a verb prints in this block.

    :raises DloCalibrationError: if it cannot be written.
    """
    try:
        yield sys.stdout
        sys.stdout.flush()
    except BrokenPipeError:  # the reader wants no more, which is no error
        raise
    except OSError as error:
        raise DloCalibrationError(f'standard output: could not be written: {error.strerror or error}; '
                                  'make room, and repeat the command') from error


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON document, with null for numbers that are not finite."""
    from dlo_calibration.calibration.plain import known

    with standard_output() as stream:
        json.dump(known(value), stream, indent=2, allow_nan=False)
        stream.write('\n')


def print_result(result: CalibrationResult, as_json: bool, told: Sequence[str] = ()) -> None:
    """
    Print a result on stdout, or else on stderr, and its warnings on stderr.

    :param told: warnings that have been printed already.
    :raises DloCalibrationError: if stdout cannot be written.
    """
    from dlo_calibration.calibration.plain import plain
    from dlo_calibration.report import terminal

    for warning in result.warnings:
        if warning not in told:
            tell(f'warning: {warning}')
    try:
        if as_json:
            print_json(plain(result))
        else:
            with standard_output() as stream:
                terminal.print_result(result, stream)
    except DloCalibrationError:
        with suppress(OSError):
            terminal.print_result(result, sys.stderr)
        raise
