# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""KeyedList: messages, or what was made of them, in the order of their keys."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from operator import attrgetter
from typing import Self, TypeVar

from dlo_calibration.messages.codec import Key

KEY = attrgetter('key')
Entry = TypeVar('Entry')  # a message, or what was made of it, with its key


class KeyedList(list[Entry]):
    """Entries sorted by key, at most one for each key."""

    def at(self, key: Key) -> Entry | None:
        """Return the entry with a key, if there is one."""
        place = bisect_left(self, key, key=KEY)
        return self[place] if place < len(self) and KEY(self[place]) == key else None

    def before(self, key: Key) -> Entry | None:
        """Return the last entry before a key, if there is one."""
        place = bisect_left(self, key, key=KEY)
        return self[place - 1] if place else None

    def after(self, key: Key) -> Entry | None:
        """Return the first entry after a key, if there is one."""
        place = bisect_right(self, key, key=KEY)
        return self[place] if place < len(self) else None

    def count_after(self, key: Key) -> int:
        """Return the number of entries after a key."""
        return len(self) - bisect_right(self, key, key=KEY)

    def between(self, key: Key, until: Key | None) -> slice:
        """Return the places after a key and before another one; None: to the end."""
        return slice(bisect_right(self, key, key=KEY),
                     len(self) if until is None else bisect_left(self, until, key=KEY))

    def put(self, key: Key, entry: Entry | None) -> Entry | None:
        """Replace the entry with a key, or delete it for None; return the previous one, if there was one."""
        place, previous = bisect_left(self, key, key=KEY), self.at(key)
        self[place:place + (previous is not None)] = [] if entry is None else [entry]
        return previous

    def parted(self, key: Key) -> tuple[Self, Self]:
        """Return the entries before a key, and those from it on."""
        place = bisect_left(self, key, key=KEY)
        return type(self)(self[:place]), type(self)(self[place:])
