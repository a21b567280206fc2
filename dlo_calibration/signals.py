# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Signals: SIGINT and SIGTERM end the program with one line, or set a flag.

Neither raises KeyboardInterrupt, which other libraries may take for an error of their own, and which
shows a traceback where nobody expects it.
"""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

from dlo_calibration.writing import remove_unfinished

SIGNALS = (signal.SIGINT, signal.SIGTERM)  # from Ctrl-C; from `kill` and `ros2 launch`


def end_at_signals(program: str) -> None:
    """
    From now on, let a signal end the process at once, with a line on stderr and `exit_code`.

    Child processes that simulate end with this one.
    """
    def end(number: int, frame: FrameType | None) -> None:
        for other in SIGNALS:
            signal.signal(other, signal.SIG_IGN)  # a second one would end it again, with a second line
        remove_unfinished()
        try:
            os.write(2, f'{program}: interrupted\n'.encode())  # sys.stderr may be in use at this moment
        except OSError:
            pass  # nobody listens
        os._exit(exit_code(number))

    for one in SIGNALS:
        signal.signal(one, end)


def exit_code(number: int) -> int:
    """Return the exit code of a program that a signal ended, by the shells' convention."""
    return 128 + number


class StopFlag:
    """A flag that becomes true, and stays true, when SIGINT or SIGTERM arrives."""

    def __init__(self) -> None:
        # Not a threading.Event: its lock may be held by the code that the handler interrupts.
        self._number = 0
        self._before: dict[signal.Signals, Any] = {}

    def __call__(self) -> bool:
        """Return whether a signal has arrived."""
        return self._number > 0

    @property
    def exit_code(self) -> int:
        """Exit code of a program that has nothing to report after the signal."""
        return exit_code(self._number)

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
        self._number = number
