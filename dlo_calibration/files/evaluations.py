# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Evaluations: all evaluations of a calibration as a CSV file."""

from __future__ import annotations

import csv
from pathlib import Path

from dlo_calibration.calibration.plain import evaluation_rows
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.writing import whole


def write_evaluations(path: Path, result: CalibrationResult) -> None:
    """
    Write every evaluation as a row of a CSV file; see `evaluation_rows`.

    :raises InputError: where the file cannot be written.
    """
    head, rows = evaluation_rows(result)
    with whole(path) as new, new.open('w', newline='', encoding='utf-8') as stream:
        csv.writer(stream).writerows([head, *rows])
