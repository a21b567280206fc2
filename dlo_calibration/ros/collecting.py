# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Collecting: the trials of a session; other options make it collect its messages anew, one at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator

from dlo_calibration.calibration.options import Options
from dlo_calibration.messages.collector import TrialCollector


@dataclass
class _Anew:
    """Collecting anew: the options, their collector, what fills it, and how many messages are left."""

    options: Options
    collector: TrialCollector
    steps: Iterator[int]
    left: int = 0


class Collecting:
    """
    Collects messages with the options in force.

    A stream of minutes has 10,000 messages, which take seconds to collect anew; a node that answers meanwhile
    does so in steps.  Until the last step, the trials are those of the former options.

    :ivar options: with which `collector` has collected.
    """

    def __init__(self, options: Options) -> None:
        self.options, self.collector = options, TrialCollector(options)
        self._anew: _Anew | None = None

    @property
    def left(self) -> int:
        """How many messages have to be collected anew."""
        return 0 if self._anew is None else self._anew.left

    @property
    def words(self) -> str:
        """What to tell while messages are collected anew; else empty."""
        return '' if self._anew is None else 'collecting the messages so far anew, as options have changed'

    def change(self, options: Options) -> None:
        """Begin to collect anew with other options, where those of the observation differ."""
        if self._anew is not None and options == self._anew.options:
            return
        self._anew = None
        if options != self.options:
            other, steps = self.collector.with_options(options)
            if other is self.collector:
                self.options = options
            else:
                self._anew = _Anew(options, other, steps)
                self.step()

    def step(self) -> bool:
        """Collect the next message anew; return whether none is left."""
        if self._anew is not None:
            self._anew.left = next(self._anew.steps, 0)
            if not self._anew.left:
                self.options, self.collector, self._anew = self._anew.options, self._anew.collector, None
        return self._anew is None
