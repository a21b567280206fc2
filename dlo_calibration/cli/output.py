# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Output: verbs print JSON or tables on stdout, and everything else on stderr."""

from __future__ import annotations

import json
import sys
from typing import Any, Mapping, Sequence, TextIO

from dlo_calibration.calibration.plain import known, plain
from dlo_calibration.calibration.result import CalibrationResult

INTERRUPTED = 130  # exit code of a program that Ctrl-C ended, by the shells' convention


def tell(text: str) -> None:
    """Print a line on stderr."""
    sys.stderr.write(f'{text}\n')


def print_json(value: Mapping[str, Any], stream: TextIO) -> None:
    """Print one JSON document, with null for numbers that are not finite."""
    json.dump(known(value), stream, indent=2, allow_nan=False)
    stream.write('\n')
    stream.flush()


def print_result(result: CalibrationResult, as_json: bool, told: Sequence[str] = ()) -> None:
    """
    Print a result on stdout, and its warnings on stderr.

    :param told: warnings that have been printed already.
    """
    from dlo_calibration.report import terminal

    for warning in result.warnings:
        if warning not in told:
            tell(f'warning: {warning}')
    if as_json:
        print_json(plain(result), sys.stdout)
    else:
        terminal.print_result(result, sys.stdout)
