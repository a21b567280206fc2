# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Outlet: the messages that the calibrator sends; each is recorded before it is published."""

from __future__ import annotations

from typing import Any, Callable

from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.files.intake import OUTPUT_TYPES
from dlo_calibration.files.result import description_document
from dlo_calibration.messages.codec import MessageTypes
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.model.trial import Trial
from dlo_calibration.ros import diagnostics
from dlo_calibration.ros.graph import Graph
from dlo_calibration.ros.markers import alike, markers
from dlo_calibration.ros.recorder import Recorder
from dlo_calibration.ros.situation import Calibration, Pace, Situation

OF_CALIBRATION = ('progress', 'result', 'dlo_description')  # recorded in the session that was calibrated
PROGRESS_PERIOD = 0.1  # s between two progress messages: nobody reads faster, and each is recorded


class Outlet:
    """
    Sends progress, status and markers, each not too often.

    :param types: the message classes that `graph` encodes.
    :param clock: a monotonic clock [s].
    """

    status_period = 1.0  # s between two messages about no more than refusals and what a trial lacks

    def __init__(self, graph: Graph[Options], types: MessageTypes, recorder: Recorder,
                 clock: Callable[[], float]) -> None:
        self._graph, self._types, self._recorder, self._clock = graph, types, recorder, clock
        self._status: dict[str, Any] = {}  # content of the last message
        self._of: Situation | None = None  # what it was about
        self._sent = float('-inf')  # when it was sent [s]
        self._shown: tuple[CalibrationResult | None, tuple[Trial, ...]] = None, ()  # in the last markers

    def send(self, name: str, message: Any) -> None:
        """Record a message, then publish it: whatever a subscriber received is on the disk."""
        octets = self._graph.encode(name, message)
        record = self._recorder.of_calibration if name in OF_CALIBRATION else self._recorder.message
        record(self._graph.topic(name), OUTPUT_TYPES[name], octets)
        self._graph.publish(name, octets)

    def progress(self, calibration: Calibration, at_once: bool = False) -> None:
        """Send the newest evaluation, unless it has been sent."""
        progress = calibration.progress
        if progress.newest is None or progress.best is None or not (
                at_once or self._clock() - calibration.sent >= PROGRESS_PERIOD):
            return
        self.send('progress', diagnostics.progress(
            self._types, stamp=self._graph.stamp(), evaluation=progress.newest, best=progress.best,
            evaluations=progress.evaluations, simulations_per_second=progress.simulations_per_second,
            seconds_left=progress.seconds_left, spread=progress.spread))
        progress.newest, calibration.sent = None, self._clock()

    def status(self, situation: Situation, collector: TrialCollector, detail: str) -> None:
        """
        Send the status if it differs from the last one.

        :param detail: about the state.
        """
        content: dict[str, Any] = {
            'state': situation.state, 'trials': collector.count, 'last_refusal': situation.last_refusal,
            'incomplete': collector.incomplete, 'detail': detail,
            'information': situation.information, 'dropped': situation.dropped.told.total()}
        changed = {name for name, value in content.items() if value != self._status.get(name, content)}
        # What changes with each message of a stream is sent once a second.
        if situation is not self._of or changed and (
                changed - {'last_refusal', 'incomplete', 'dropped'}
                or self._clock() - self._sent >= self.status_period):
            self._status, self._of, self._sent = content, situation, self._clock()
            self.send('status', diagnostics.status(self._types, stamp=self._graph.stamp(), **content))

    def result(self, result: CalibrationResult, options: Options) -> None:
        """Send a result, and the description of the DLO that it gives."""
        self.send('result', diagnostics.result(self._types, result, self._graph.stamp()))
        self.send('dlo_description', self._types.build(
            OUTPUT_TYPES['dlo_description'], data=description_document(result, options.flat()).decode()))

    def markers(self, situation: Situation, collector: TrialCollector, at_once: bool) -> None:
        """Send the markers of all trials, unless the last ones show the same."""
        # Each message has the markers of all trials, and is recorded: the more trials, the fewer messages.
        now, period = self._clock(), 1.0 + 0.1 * collector.count
        if not at_once and not (
                situation.markers.wanted and collector.count and now - situation.markers.last >= period):
            return
        situation.markers = Pace(last=now)
        result, trials = situation.result, collector.trials
        if trials and result is self._shown[0] and alike(trials, self._shown[1]):
            return
        self._shown = result, trials
        self.send('markers', markers(self._types, trials, stamp=self._graph.stamp(),
                                     frame_id=collector.frame_id, result=result, pose=collector.pose))
