# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Background: a thread for long work, which puts frozen events on a queue."""

from __future__ import annotations

from dataclasses import dataclass
import queue
import threading
import traceback
from typing import Callable, Generic, Iterator, TypeVar, Union

from dlo_calibration.errors import DloCalibrationError


@dataclass(frozen=True)
class Failure:
    """
    Work that ended without a result.

    :param text: one line that says why.
    :param details: the traceback if the reason is a defect of the program; else empty.
    """

    text: str
    details: str = ''


@dataclass(frozen=True)
class Notice:
    """
    Something that the user should know immediately, and that does not end the work.

    :param text: one line, e.g. about a process that died.
    """

    text: str


Event = TypeVar('Event')


class Background(Generic[Event]):
    """
    Does one piece of work at a time in a thread of its own.

    `events` receives what the work tells, in order, and at the end exactly one event: what the work
    returns, or a `Failure`.

    :param name: of the work, e.g. ``calibration``.
    """

    def __init__(self, name: str) -> None:
        self.events: queue.SimpleQueue[Union[Event, Failure]] = queue.SimpleQueue()
        self._name = name
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def alive(self) -> bool:
        """Tell whether the thread is running; afterwards, events may still be waiting."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def stopped(self) -> bool:
        """Tell whether the last work was asked to end with the best so far."""
        return self._stop.is_set()

    def begin(self, work: Callable[[Callable[[], bool]], Event]) -> None:
        """
        Begin to work.

        :param work: gets a function that tells whether to end with the best so far.
        :raises DloCalibrationError: while it is working already.
        """
        if self.alive:
            raise DloCalibrationError(f'a {self._name} is under way already')
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, args=(work, self._stop.is_set), name=self._name,
                                        daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ask the work to end with the best so far, and return immediately."""
        self._stop.set()

    def waiting_events(self) -> Iterator[Union[Event, Failure]]:
        """Yield the waiting `events`, without waiting for more."""
        while True:
            try:
                yield self.events.get_nowait()
            except queue.Empty:
                return

    def join(self, timeout: float | None = None) -> bool:
        """Wait until the thread has ended, `timeout` [s] at most; return whether it has."""
        if self._thread is not None:
            self._thread.join(timeout)
        return not self.alive

    def _work(self, work: Callable[[Callable[[], bool]], Event], should_stop: Callable[[], bool]) -> None:
        event: Union[Event, Failure]
        try:
            event = work(should_stop)
        except DloCalibrationError as error:
            event = Failure(str(error))
        except BaseException as error:  # a thread that dies silently leaves the user waiting for ever
            text = ' '.join(str(error).split())
            event = Failure(f'{type(error).__name__}: {text}' if text else type(error).__name__,
                            traceback.format_exc())
        self.events.put(event)
