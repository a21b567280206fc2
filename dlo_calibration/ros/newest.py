# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Newest: the newest usable message of a topic."""

from __future__ import annotations

from typing import Callable, Generic, TypeVar

RATE = 5.0  # messages read in a second, out of a stream that may be of any rate
BURST = 10  # read at once, after a pause

T = TypeVar('T')


class Newest(Generic[T]):
    """
    The newest message of a topic that could be used.

    A few messages are read as they come.  Of a stream, the newest one waits, and is read now and then.

    :param read: returns the content of a message's bytes; an InputError refuses it.
    """

    def __init__(self, read: Callable[[bytes], T]) -> None:
        self.content: T | None = None
        self.came = float('-inf')  # when the content came [s]
        self._read = read
        self._waiting: tuple[bytes, float] | None = None
        self._allowed, self._last = float(BURST), float('-inf')

    def hear(self, octets: bytes, now: float) -> None:
        """Take the bytes of a message that came at the time `now` [s], instead of those that wait."""
        self._waiting = octets, now

    def due(self, now: float) -> bool:
        """Tell whether a message waits that may be read at the time `now` [s]."""
        if self._waiting is None:
            return False
        self._allowed = min(BURST, self._allowed + RATE * (now - self._last))
        self._last = now
        return self._allowed >= 1.0

    def read(self) -> bool:
        """
        Read the message that waits; return whether there was one.

        :raises InputError: if it cannot be used; the content stays as it was.
        """
        if self._waiting is None:
            return False
        (octets, came), self._waiting = self._waiting, None
        self._allowed -= 1.0
        self.content = self._read(octets)
        self.came = came
        return True
