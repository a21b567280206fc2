# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
CalibrationSession: what the node knows, and what it does with a message, a request or the passing of time.

It imports no rclpy: what it needs of the graph is a `Graph`, which the node is.
Whatever goes wrong ends in the log and in ``~/status``, and the node stays.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
import time
from typing import Any, Callable, Protocol

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.live_information import LiveInformation
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.progress import Progress
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.worker import Failure, Notice, Worker
from dlo_calibration.errors import DloCalibrationError, InputError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.files.result import description_document
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.messages.codec import INITIAL, INPUT_TYPES, MessageTypes, read
from dlo_calibration.messages.collector import KEPT, TrialCollector
from dlo_calibration.ros import diagnostics
from dlo_calibration.ros.diagnostics import OUTPUT_TYPES
from dlo_calibration.ros.markers import markers
from dlo_calibration.ros.recorder import Recorder

PROGRESS_PERIOD = 0.1  # s between two progress messages, at least
MARKERS_PERIOD = 1.0  # s between two messages of markers while trials come in, at least
MARKERS_SHARE = 0.1  # s more of it per trial, so that a long session is not recorded again and again
STREAM_PERIOD = 2.0  # s between two looks at what trials tell, while messages keep coming
QUIET = 0.5  # s without action or goal chain, after which the last trial counts as complete
PATIENCE = 10.0  # s that the end waits for the worker
WAIT = 'wait for it, or call ~/stop first'
DEFECT = 'this is a defect of dlo_calibration, please report it'


class Graph(Protocol):
    """What a session needs of the node that it belongs to."""

    def options(self) -> Options:
        """Return the options in force."""

    def stamp(self) -> int:
        """Return the time for the header of a message [ns]."""

    def topic(self, name: str) -> str:
        """Return the full name of one of the node's topics."""

    def decode(self, kind: str, octets: bytes) -> Any:
        """Return the message that came on an input topic; raise anything where the bytes are damaged."""

    def encode(self, name: str, message: Any) -> bytes:
        """Return the CDR bytes of a message for an output topic."""

    def publish(self, name: str, octets: bytes) -> None:
        """Publish bytes on an output topic."""

    def hear_waiting(self) -> None:
        """Pass on the messages that wait in the queues of the input topics."""

    def info(self, text: str) -> None:
        """Log a text."""

    def warn(self, text: str) -> None:
        """Log a warning."""

    def error(self, text: str) -> None:
        """Log an error."""


@dataclass
class _Calibration:
    """
    A calibration under way.

    :param sent: when its progress was sent last [s].
    """

    options: Options
    progress: Progress
    sent: float = float('-inf')


@dataclass
class _Pace:
    """
    Something that is done again where there is a reason, but not too often.

    :param wanted: there is a reason.
    :param last: when it was done last [s].
    """

    wanted: bool = False
    last: float = float('-inf')


@dataclass
class _Memory:
    """
    What a reset forgets, beside the trials.

    :param detail: of the state, e.g. why it failed.
    :param told: refusals that the user knows.
    :param heard: when the last action or goal chain came [s].
    :param started: a calibration was started, so that none need start by itself.
    :param status: content of the last ``~/status``.
    :param result: of the last calibration.
    :param information: what the newest trial tells that was appraised.
    """

    state: str = 'collecting'
    detail: str = ''
    last_refusal: str = ''
    told: deque[str] = field(default_factory=lambda: deque(maxlen=KEPT))
    heard: float = float('-inf')
    started: bool = False
    status: dict[str, Any] = field(default_factory=dict)
    result: CalibrationResult | None = None
    information: TrialInformation | None = None
    markers: _Pace = field(default_factory=_Pace)
    appraisal: _Pace = field(default_factory=_Pace)


class CalibrationSession:
    """
    Collects trials, calibrates on request, and publishes what there is to say of it.

    Not to be shared between threads.

    :param types: the message classes that `graph` encodes.
    :param make_simulator: builds the engine, in the worker's thread.
    :param clock: gives seconds that never go back.
    """

    def __init__(self, graph: Graph, types: MessageTypes, make_simulator: SimulatorFactory,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self._graph, self._types, self._clock = graph, types, clock
        self._make_simulator = make_simulator
        self._collected_with = graph.options()
        self._collector = TrialCollector(self._collected_with)
        self._worker = Worker(make_simulator)
        self._appraiser = LiveInformation(make_simulator)
        self._recorder = Recorder(self._fail_to_record, make_simulator)
        self._memory = _Memory()
        self._calibration: _Calibration | None = None
        self._begin_recording()
        self._report()

    @property
    def calibrating(self) -> bool:
        """Tell whether a calibration is under way."""
        return self._calibration is not None

    def hear(self, kind: str, octets: bytes) -> None:
        """Record a message that came on an input topic, then collect it or refuse it."""
        memory = self._memory
        self._recorder.message(self._graph.topic(kind), INPUT_TYPES[kind], octets)
        if kind != INITIAL:
            memory.heard = self._clock()
            memory.markers.wanted = memory.appraisal.wanted = True
        try:
            try:
                message = self._graph.decode(kind, octets)
            except Exception as error:  # whatever the decoder meets in damaged bytes
                raise InputError(kind, f'bytes that do not decode ({error!r})', f'a {INPUT_TYPES[kind]}',
                                 'check what publishes it') from error
            self._collector.add(read(kind, message))
            for refusal in self._collector.take_news():
                self.refuse(str(refusal))
        except InputError as error:
            self.refuse(str(error))
        except Exception as error:  # a defect of ours must not take the session with it
            self.refuse(f'{kind}: could not be used ({error!r}); {DEFECT}')
        else:
            if not self.calibrating:
                memory.state, memory.detail = 'collecting', ''

    def refuse(self, text: str) -> None:
        """Tell why something was refused, in the log and in ``~/status``."""
        self._memory.last_refusal = text
        self._memory.told.append(text)
        self._graph.warn(text)
        self._report()

    def request(self, name: str) -> tuple[bool, str]:
        """Do what the service `start`, `stop` or `reset` asks for; return whether it did, and an answer."""
        try:
            answer = {'start': self._start, 'stop': self._stop, 'reset': self._reset}[name]()
        except Exception as error:
            answer = str(error) if isinstance(error, DloCalibrationError) else f'{error!r}; {DEFECT}'
            self.refuse(answer)
            return False, answer
        self._report()
        return True, answer

    def tick(self) -> None:
        """Do what is due by now; to be called many times a second."""
        self._take_events()
        self._recorder.tell()
        self._start_by_itself()
        self._appraise()
        period = MARKERS_PERIOD + MARKERS_SHARE * self._collector.count
        if self._memory.markers.wanted and self._collector.count \
                and self._clock() - self._memory.markers.last >= period:
            self._show()
        self._report()

    def fail(self, text: str, *log: str) -> None:
        """Tell in ``~/status`` that something failed, and in the log, in the words of `log` if given."""
        self._memory.state, self._memory.detail = 'failed', text
        for line in log or (text,):
            self._graph.error(line)
        self._report()

    def close(self) -> None:
        """End the calibration, whose best so far is the result, and the recording."""
        self._worker.stop()
        self._appraiser.stop()
        try:
            if not (self._worker.join(PATIENCE) and self._appraiser.join(PATIENCE)):
                self._graph.warn('the simulation under way does not end; it is left behind')
            self._take_events()
        finally:
            self._recorder.close()

    # Requests

    def _start(self) -> str:
        if self.calibrating:
            raise InputError('~/start', 'a calibration under way', 'none', WAIT)
        self._graph.hear_waiting()  # sent before the request, so it belongs to it
        options = self._graph.options()
        if options != self._collected_with:
            self._collector, self._collected_with = self._collector.with_options(options), options
        told = set(self._memory.told)
        for problem in self._collector.problems:
            if str(problem) not in told:
                self.refuse(str(problem))
        trials = self._collector.trials
        if not trials:
            lacks = self._collector.incomplete or 'an initial_chain, an action and a goal_chain'
            raise InputError('~/start', 'no complete trial', lacks, 'send it, then call ~/start again')
        self._make_simulator(options).close()  # refuses an engine or a scene that cannot be had
        self._recorder.start(options)
        self._calibration = _Calibration(options, Progress(options.evaluations, len(trials)))
        memory = self._memory
        memory.started, memory.state, memory.detail = True, 'calibrating', ''
        self._appraiser.stop()
        memory.appraisal.wanted = True  # what a calibration without a result leaves open
        self._worker.start(trials, options)
        return f'calibrating on {len(trials)} trial(s), {options.evaluations} evaluations'

    def _start_by_itself(self) -> None:
        memory, wanted = self._memory, self._graph.options().start_after_trials
        if self.calibrating or memory.started or not 0 < wanted <= self._collector.count:
            return
        # A trial may have many goal chains; it is complete when the next one began, or nothing follows.
        if self._collector.count > wanted or self._clock() - memory.heard > QUIET:
            memory.started = True
            try:
                self._graph.info(self._start())
            except InputError as error:
                memory.state, memory.detail = 'failed', str(error)
                self.refuse(str(error))

    def _stop(self) -> str:
        if not self.calibrating:
            raise InputError('~/stop', 'no calibration under way', 'one', 'call ~/start first')
        self._worker.stop()
        return 'the search ends now; the best so far will be the result'

    def _reset(self) -> str:
        if self.calibrating:
            raise InputError('~/reset', 'a calibration under way', 'none', WAIT)
        self._recorder.end()
        self._appraiser.stop()
        self._collected_with = self._graph.options()
        self._collector = TrialCollector(self._collected_with)
        self._memory = _Memory()
        self._begin_recording()
        self._show()
        return 'the trials are forgotten'

    # Events of the worker, and what trials tell

    def _take_events(self) -> None:
        for event in self._worker.waiting_events():
            if isinstance(event, Notice):
                self._memory.detail = event.text
                self._graph.warn(event.text)
            elif not isinstance(event, Evaluation):
                self._finish(event)
            elif self._calibration is not None:
                self._calibration.progress.take(event)
        if self._calibration is not None and self._clock() - self._calibration.sent >= PROGRESS_PERIOD:
            self._send_progress(self._calibration)

    def _finish(self, event: CalibrationResult | Failure) -> None:
        calibration, self._calibration = self._calibration, None
        assert calibration is not None
        self._send_progress(calibration)
        self._worker.join()
        if isinstance(event, Failure):
            self.fail(event.text, f'calibration failed: {event.text}', *filter(None, [event.details]))
            return
        memory, options = self._memory, calibration.options
        memory.state, memory.detail, memory.result = 'done', event.stop_reason, event
        found = ', '.join(f'{name} {value:.1f}' for name, value in event.values.items())
        self._graph.info(f'calibrated: {found}; score {event.best.score:.1f}, mean error '
                         f'{event.errors.mean * 1e3:.2f} mm; {event.stop_reason}')
        for warning in event.warnings:
            self._graph.warn(warning)
        self._send('result', diagnostics.result(self._types, event, self._graph.stamp()))
        self._send('dlo_description', self._types.build(
            OUTPUT_TYPES['dlo_description'], data=description_document(event, options.flat()).decode()))
        self._recorder.result(event, options)
        self._show()
        self._report()

    def _appraise(self) -> None:
        """Take what trials turned out to tell; have new ones appraised, unless a calibration is under way."""
        memory, now = self._memory, self._clock()
        for told in self._appraiser.waiting_information():
            memory.information = told
        quiet = now - memory.heard > QUIET
        if memory.appraisal.wanted and not self.calibrating and self._collector.count \
                and not self._appraiser.alive and (quiet or now - memory.appraisal.last > STREAM_PERIOD):
            memory.appraisal = _Pace(wanted=not quiet, last=now)
            self._appraiser.start(self._collector.trials, self._graph.options(), memory.result, whole=quiet)

    # What is told

    def _send_progress(self, calibration: _Calibration) -> None:
        """Send the newest evaluation, if it was not sent yet."""
        progress = calibration.progress
        if progress.newest is None or progress.best is None:
            return
        self._send('progress', diagnostics.progress(
            self._types, stamp=self._graph.stamp(), evaluation=progress.newest, best=progress.best,
            evaluations=progress.evaluations, simulations_per_second=progress.simulations_per_second,
            seconds_left=progress.seconds_left, spread=progress.spread))
        progress.newest, calibration.sent = None, self._clock()

    def _report(self) -> None:
        """Send the status, where it differs from the last one."""
        memory = self._memory
        content: dict[str, Any] = {
            'state': memory.state, 'trials': self._collector.count, 'last_refusal': memory.last_refusal,
            'incomplete': self._collector.incomplete, 'detail': memory.detail, 'told': memory.information}
        if content != memory.status:
            memory.status = content
            self._send('status', diagnostics.status(self._types, stamp=self._graph.stamp(), **content))

    def _show(self) -> None:
        """Send the markers of all trials."""
        self._memory.markers = _Pace(last=self._clock())
        self._send('markers', markers(self._types, self._collector.trials, stamp=self._graph.stamp(),
                                      frame_id=self._collector.frame_id, result=self._memory.result))

    def _send(self, name: str, message: Any) -> None:
        octets = self._graph.encode(name, message)
        # First: what anybody heard is on the disk.
        self._recorder.message(self._graph.topic(name), OUTPUT_TYPES[name], octets)
        self._graph.publish(name, octets)

    def _begin_recording(self) -> None:
        self._recorder.begin(self._graph.options())
        if self._recorder.folder is not None:
            self._graph.info(f'recording to {self._recorder.folder}')

    def _fail_to_record(self, text: str) -> None:
        self._memory.last_refusal = text
        self._graph.error(text)
        self._report()
