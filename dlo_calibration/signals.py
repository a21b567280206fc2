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
import time
from types import FrameType
from typing import Any

from dlo_calibration.writing import remove_unfinished

SIGNALS = (signal.SIGINT, signal.SIGTERM)  # from Ctrl-C; from `kill` and `ros2 launch`
PATIENCE = 0.5  # s that the main thread has to call the handler of a signal


def end_at_signals(program: str) -> None:
    """
    From now on, let a signal end the process at once, with a line on stderr and `exit_code`.

    Python calls a handler only when the main thread returns from C.  A stranger's file may keep a C library
    busy for hours, so a thread waits for signals, too: SQLite, libxml2 and Pillow let it run meanwhile.

    Child processes that simulate end with this one.
    """
    def handle(number: int, frame: FrameType | None) -> None:
        for other in SIGNALS:
            signal.signal(other, signal.SIG_IGN)  # a second one would end it again, with a second line
        end(number)

    def end(number: int) -> None:
        remove_unfinished()
        try:
            os.write(2, f'{program}: interrupted\n'.encode())  # sys.stderr may be in use at this moment
        except OSError:
            pass  # nobody listens
        os._exit(exit_code(number))

    def watch() -> None:
        while True:
            number = os.read(receiver, 1)[0]
            if signal.getsignal(number) is handle:
                time.sleep(PATIENCE)
                if signal.getsignal(number) is handle:  # it has not been called
                    end(number)

    receiver, sender = os.pipe()
    os.set_blocking(sender, False)
    signal.set_wakeup_fd(sender, warn_on_full_buffer=False)  # gets the number of each signal at once
    threading.Thread(target=watch, daemon=True).start()
    for number in SIGNALS:
        signal.signal(number, handle)


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
