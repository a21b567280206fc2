# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Signals: SIGINT and SIGTERM set a flag, and nothing is interrupted."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopFlag:
    """Becomes true, and stays so, when SIGINT or SIGTERM arrives."""

    def __init__(self) -> None:
        # A plain attribute: a handler may interrupt whoever holds a lock.
        self._raised = False
        self._before: dict[signal.Signals, Any] = {}

    def __call__(self) -> bool:
        """Tell whether to end."""
        return self._raised

    def listen(self) -> None:
        """Take the signals; only the main thread can, elsewhere this does nothing."""
        self._handle(self._raise)

    def __enter__(self) -> StopFlag:
        """Listen for as long as the block lasts."""
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.getsignal(number) for number in SIGNALS}
        self.listen()
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the signals to whoever had them before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def ignore(self) -> None:
        """Let later signals pass, so that nothing disturbs the interpreter's own end."""
        self._handle(signal.SIG_IGN)

    def _handle(self, handler: object) -> None:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                signal.signal(number, handler)  # type: ignore[arg-type]

    def _raise(self, number: int, frame: FrameType | None) -> None:
        self._raised = True
