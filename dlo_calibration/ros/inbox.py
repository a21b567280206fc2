# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Inbox: messages that came and wait to be collected; it counts those that were dropped."""

from __future__ import annotations

from collections import Counter, defaultdict, deque

LIMIT = 64_000_000  # bytes that wait: 100,000 chains of 40 points, and few beside the 1 GB of a small robot
OVERHEAD = 200  # bytes of a waiting message, besides its content
PUBLISHERS = 64  # on a topic; those that were silent for longest are forgotten


class Inbox:
    """
    Messages that came and wait to be collected, and requests between them.

    A message was dropped if its publisher's next one has a number beyond the next: the queue
    below rclpy keeps only the newest ones.  Those before its first one are not counted: nobody may have
    listened yet.  Which publisher sent a message is not told, but the sum over all publishers of a topic is
    right if each number continues the nearest one below it.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[str, bytes | None]] = deque()
        self._size = 0
        self._last: dict[str, list[int]] = defaultdict(list)
        self._dropped: Counter[str] = Counter()

    def __len__(self) -> int:
        """Return how many messages and requests wait."""
        return len(self._waiting)

    def put(self, kind: str, octets: bytes, number: int | None) -> None:
        """Take a message with the `number` that its publisher gave it; None: it gives none."""
        if number is not None:
            self.drop(kind, self._gap(self._last[kind], number))
        size = len(octets) + OVERHEAD
        if self._size + size > LIMIT and self._waiting:
            self.drop(kind, 1)
            return
        self._waiting.append((kind, octets))
        self._size += size

    def put_request(self, name: str) -> None:
        """Take a request that counts for all messages before it."""
        self._waiting.append((name, None))

    def take(self) -> tuple[str, bytes | None]:
        """Return the kind and bytes of the message, or the request and None, that waits for longest."""
        kind, octets = self._waiting.popleft()
        if octets is not None:
            self._size -= len(octets) + OVERHEAD
        return kind, octets

    @property
    def first(self) -> tuple[str, bytes | None]:
        """What `take` would return; ('', None) if nothing waits."""
        return self._waiting[0] if self._waiting else ('', None)

    def drop(self, kind: str, count: int) -> None:
        """Count messages that were dropped."""
        if count:
            self._dropped[kind] += count

    def take_dropped(self) -> Counter[str]:
        """Return how many messages of each kind were dropped since the last call."""
        dropped, self._dropped = self._dropped, Counter()
        return dropped

    def numbered(self, kind: str) -> bool:
        """Tell whether publishers number the messages of a kind."""
        return bool(self._last[kind])

    def forget_publishers(self, kind: str) -> None:
        """Forget the numbers of a kind, as all of its publishers have gone."""
        self._last[kind].clear()

    @staticmethod
    def _gap(last: list[int], number: int) -> int:
        """Return how many messages are missing before one with this number."""
        before = max((one for one in last if one < number), default=None)
        if before is None:
            before = number - 1  # a publisher that is new
            del last[:len(last) + 1 - PUBLISHERS]
        else:
            last.remove(before)
        last.append(number)
        return number - before - 1
