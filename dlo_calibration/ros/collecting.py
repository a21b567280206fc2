# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Messages that are collected anew when options change."""

from __future__ import annotations

from typing import Iterator

from dlo_calibration.calibration.options import Options
from dlo_calibration.messages.collector import TrialCollector


class Collecting:
    """
    Collects messages with the options in force.

    A stream of minutes has 10,000 messages, which take seconds to collect anew; a node that answers meanwhile
    does so in steps.  Until the last step, the trials are those of the former options.

    :ivar options: with which `collector` has collected.
    :ivar left: how many messages have to be collected anew.
    """

    def __init__(self, options: Options) -> None:
        self.options, self.collector = options, TrialCollector(options)
        self.left = 0
        self._next, self._other = options, self.collector  # once nothing is left
        self._steps: Iterator[int] = iter(())

    def change(self, options: Options) -> None:
        """Begin to collect anew with other options, where those of the observation differ."""
        if options != self._next:
            self._next = options
            self._other, self._steps = self.collector.with_options(options)
            self.step()

    def step(self) -> bool:
        """Collect the next message anew; return whether none is left."""
        self.left = next(self._steps, 0)
        if not self.left:
            self.options, self.collector = self._next, self._other
        return not self.left
