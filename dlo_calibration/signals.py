# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Signals: SIGINT and SIGTERM set a flag instead of interrupting the program."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)  # from Ctrl-C; from `kill` and `ros2 launch`


class StopFlag:
    """A flag that becomes true, and stays true, when SIGINT or SIGTERM arrives."""

    def __init__(self) -> None:
        # Not a threading.Event: its lock may be held by the code that the handler interrupts.
        self._raised = False
        self._before: dict[signal.Signals, Any] = {}

    def __call__(self) -> bool:
        """Tell whether a signal has arrived."""
        return self._raised

    def listen(self) -> None:
        """Handle the signals from now on; only the main thread can, so this does nothing elsewhere."""
        self._handle(self._raise)

    def __enter__(self) -> StopFlag:
        """Handle the signals until the block ends."""
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.getsignal(number) for number in SIGNALS}
        self.listen()
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the handlers from before the block."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def ignore(self) -> None:
        """Ignore later signals, so that they cannot disturb the interpreter's shutdown."""
        self._handle(signal.SIG_IGN)

    def _handle(self, handler: object) -> None:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                signal.signal(number, handler)  # type: ignore[arg-type]

    def _raise(self, number: int, frame: FrameType | None) -> None:
        self._raised = True
