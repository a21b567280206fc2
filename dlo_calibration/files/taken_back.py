# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Trials that ``~/discard_last`` took back: their marks in a recording, and the messages left out."""

from __future__ import annotations

from contextlib import suppress
import re
from typing import Iterable, Sequence

from dlo_calibration.errors import InputError
from dlo_calibration.files.bag import decode
from dlo_calibration.files.intake import Record
from dlo_calibration.messages.codec import INITIAL, NANOSECONDS

_MARK = re.compile(r'discard (\d{1,19}) (\d{1,19})')


def mark(first: int, last: int) -> str:
    """Return the mark that tells that messages stamped from `first` to `last` [ns] are left out."""
    return f'discard {first} {last}'


def without_taken_back(records: Sequence[Record], marks: Iterable[str], problems: list[str]) -> list[Record]:
    """
    Return the messages without those of trials that were taken back, and tell how many these are.

    The collector leaves out the same ones: all that are stamped within such a trial, and what comes after it
    before the next initial chain.
    """
    spans = [(int(found[1]), int(found[2])) for found in map(_MARK.fullmatch, marks) if found]
    if not spans:
        return list(records)
    gone: set[int] = set()
    stamped = []
    for k, record in enumerate(records):
        with suppress(InputError):  # one that does not decode is told of later
            stamp = decode(record).header.stamp
            stamped.append((stamp.sec * NANOSECONDS + stamp.nanosec, record.name != INITIAL, k))
    for first, last in spans:
        follows = False  # whether the newest initial chain is that of the trial
        for stamp, later, k in sorted(stamped):
            follows = follows and later or first <= stamp <= last
            if follows and stamp >= first:
                gone.add(k)
    problems.append(f'{len(gone)} message(s) of {len(spans)} trial(s) that were taken back are left out')
    return [record for k, record in enumerate(records) if k not in gone]
