# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Events: what the open pages are told as it happens, by server-sent events."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from aiohttp import web

from dlo_calibration.calibration.plain import known
from dlo_calibration.capture.guard import protect, Refused

MOST_PAGES = 20  # that listen at once
SILENCE = 15.0  # s, after which a comment shows both sides that the other is there


class Events:
    """Tells open pages; one that is slow misses all but the newest event of a name."""

    def __init__(self) -> None:
        self._waiting: dict[int, dict[str, bytes]] = {}  # by page: the newest event of each name
        self._news: dict[int, asyncio.Event] = {}
        self._closed = False

    def tell(self, name: str, value: Any) -> None:
        """Tell all pages; for several values at once, `value` is a list."""
        values = value if isinstance(value, list) else [value]
        data = [json.dumps(known(one), allow_nan=False) for one in values]
        octets = ''.join(f'event: {name}\ndata: {one}\n\n' for one in data).encode()
        for page, waiting in self._waiting.items():
            waiting[name] = octets
            self._news[page].set()

    def close(self) -> None:
        """End all answers."""
        self._closed = True
        for one in self._news.values():
            one.set()

    async def answer(self, request: web.Request) -> web.StreamResponse:
        """Answer a page that listens, until it ends."""
        if len(self._waiting) >= MOST_PAGES:
            raise Refused(409, f'{MOST_PAGES} pages are open already; close some')
        page = id(request)
        waiting, news = self._waiting.setdefault(page, {}), self._news.setdefault(page, asyncio.Event())
        answer = web.StreamResponse(headers={'Content-Type': 'text/event-stream'})
        protect(answer)
        try:
            await answer.prepare(request)
            await answer.write(b': connected\n\n')
            while not self._closed:
                try:
                    await asyncio.wait_for(news.wait(), SILENCE)
                except TimeoutError:
                    await answer.write(b': still here\n\n')
                    continue
                news.clear()
                while waiting:
                    await answer.write(waiting.pop(next(iter(waiting))))
        except ConnectionResetError:  # the page was closed
            pass
        finally:
            del self._waiting[page], self._news[page]
        return answer
