# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Output: verbs print JSON or tables on stdout, and messages on stderr."""

from __future__ import annotations

from contextlib import contextmanager, suppress
import json
import os
import sys
from typing import Any, Iterable, Iterator, Mapping, Sequence, TextIO, TYPE_CHECKING

from dlo_calibration.errors import DloCalibrationError, printable

if TYPE_CHECKING:
    from dlo_calibration.calibration.result import CalibrationResult


def print_message(text: str) -> None:
    """Print a line on stderr, if that is possible."""
    with suppress(OSError):  # if stderr is a file on a full disk, the work goes on
        sys.stderr.write(f'{printable(text)}\n')


def flush() -> None:
    """Flush stdout and stderr; drop what cannot be written, so that the interpreter ends without error."""
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
    from dlo_calibration.calibration.result import with_nulls

    with standard_output() as stream:
        json.dump(with_nulls(value), stream, indent=2, allow_nan=False)
        stream.write('\n')


def print_sentences(sentences: Iterable[str]) -> None:
    """Print sentences on stdout, wrapped to its width."""
    from dlo_calibration.report.terminal import console, escape

    with standard_output() as stream:
        out = console(stream)
        for sentence in sentences:
            out.print(escape(sentence))


def print_result(result: CalibrationResult, as_json: bool, printed: Sequence[str] = ()) -> None:
    """
    Print a result on stdout, and its warnings on stderr; without stdout, print both there.

    :param printed: warnings that have been printed already.
    :raises DloCalibrationError: if stdout cannot be written.
    """
    from dlo_calibration.calibration.result import plain
    from dlo_calibration.report import terminal

    for warning in result.warnings:
        if warning not in printed:
            print_message(f'warning: {warning}')
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
