# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
CalibrationSession: the state of the node `calibrator`, and its reactions to messages, requests and time.

It imports no rclpy: it reaches ROS through a `NodeInterface`, which the node implements.
Every error is reported in the log and in ``~/status``, and the node goes on working.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path
import time
from typing import Any, Callable, Mapping

from dlo_calibration.calibration.choice import choose
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.passport import Passport
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import InputError, safe_line, SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.files.result import description_document
from dlo_calibration.files.session import read_session
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.messages.codec import (
    action_trajectory,
    ChainMessage,
    GOAL,
    INITIAL,
    INPUT_TYPES,
    InputMessage,
    MessageTypes,
    NANOSECONDS,
    OUTPUT_TYPES,
    read,
    WRENCH,
    WrenchMessage,
)
from dlo_calibration.messages.collector import KEPT, StampOrder, TrialCollector, went_back
from dlo_calibration.messages.encoder import action_message
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.trial import Trial
from dlo_calibration.ros import diagnostics
from dlo_calibration.ros.advising import Advising
from dlo_calibration.ros.calibrator_options import CalibratorOptions
from dlo_calibration.ros.collecting import Collecting
from dlo_calibration.ros.markers import alike, markers, shown_obstacles
from dlo_calibration.ros.node_session import FAILED, NodeInterface, NodeSession, NodeState, refusal_text
from dlo_calibration.ros.recorder import Recorder
from dlo_calibration.ros.resting_place import RestingPlace
from dlo_calibration.workspace.live_information import Appraised, LiveInformation
from dlo_calibration.workspace.next_action import next_action, NextAction
from dlo_calibration.workspace.worker import CalibrationWarning, Failure, Progress, Worker


@dataclass
class Pace:
    """
    When to repeat something that is repeated if needed, but not too often.

    :param wanted: whether it is needed.
    :param last: time when it was done last [s].
    """

    wanted: bool = False
    last: float = float('-inf')


@dataclass
class Dropped:
    """
    Messages that were dropped.

    :param counts: how many of each kind.
    :param reported: how many of them have been reported, most recently at the time `last` [s].
    """

    counts: Counter[str] = field(default_factory=Counter)
    reported: Counter[str] = field(default_factory=Counter)
    last: float = float('-inf')

    def due(self, now: float, at_once: bool) -> list[str]:
        """Return the warnings that are due at the time `now` [s], at most once a second."""
        new = self.counts - self.reported
        if not new or not at_once and now - self.last <= 1.0:
            return []
        self.reported, self.last = Counter(self.counts), now
        return [f'{kind}: {count} message(s) were dropped, as they came faster than they can be read; '
                'publish fewer a second' for kind, count in new.items()]


@dataclass
class SessionState(NodeState):
    """
    What a reset forgets, besides the trials.

    :param refusals: the latest ones, which are not reported again.
    :param heard: time of the last action or goal chain [s].
    :param started: whether a calibration was started, so that `start_after_trials` starts none.
    :param result: of the last calibration.
    :param information: what the newest trial adds.
    :param markers: when to send the markers.
    :param renewal: when to renew `information`.
    """

    name: str = 'collecting'
    refusals: deque[str] = field(default_factory=lambda: deque(maxlen=KEPT))
    heard: float = float('-inf')
    started: bool = False
    result: CalibrationResult | None = None
    information: TrialInformation | None = None
    dropped: Dropped = field(default_factory=Dropped)
    markers: Pace = field(default_factory=Pace)
    renewal: Pace = field(default_factory=Pace)
    advising: Advising = field(default_factory=Advising)


@dataclass
class CalibrationUnderWay:
    """
    A calibration under way.

    :param state: of the session in which it started, which may have ended since.
    :param sent: time of its last progress message [s].
    """

    options: Options
    progress: Progress
    state: SessionState
    sent: float = float('-inf')


ANEW = 'collecting the messages so far anew, as options have changed'  # detail of the status
OF_CALIBRATION = ('progress', 'result', 'dlo_description')  # recorded in the session that was calibrated
PROGRESS_PERIOD = 0.1  # s between two progress messages, as each is recorded


class Outlet:
    """
    Records and sends messages; progress and markers not too often.

    :param types: the message classes that `graph` encodes.
    :param clock: a monotonic clock [s].
    """

    def __init__(self, graph: NodeInterface[CalibratorOptions], types: MessageTypes, recorder: Recorder,
                 clock: Callable[[], float]) -> None:
        self._graph, self._types, self._recorder, self._clock = graph, types, recorder, clock
        # In the last markers: the result, the trials and the scene.
        self._shown: tuple[CalibrationResult | None, tuple[Trial, ...], str] = None, (), ''

    def send(self, name: str, message: Any) -> None:
        """Record a message, then publish it: whatever a subscriber received is on the disk."""
        octets = self._graph.encode(name, message)
        record = self._recorder.of_calibration if name in OF_CALIBRATION else self._recorder.message
        record(self._graph.topic(name), OUTPUT_TYPES[name], octets)
        self._graph.publish(name, octets)

    def progress(self, calibration: CalibrationUnderWay, at_once: bool = False) -> None:
        """Send the newest evaluation, unless it has been sent."""
        progress = calibration.progress
        if progress.newest is None or not at_once and self._clock() - calibration.sent < PROGRESS_PERIOD:
            return
        self.send('progress', diagnostics.progress(self._types, progress, self._graph.stamp()))
        progress.newest, calibration.sent = None, self._clock()

    def result(self, result: CalibrationResult, options: Options) -> None:
        """Send a result, and the description of the DLO that it gives."""
        self.send('result', diagnostics.result(self._types, result, self._graph.stamp()))
        self.send('dlo_description', self._types.build(
            OUTPUT_TYPES['dlo_description'], data=description_document(
                result, options.flat(), Passport.new(options.measured_by)).decode()))

    def markers(self, state: SessionState, collector: TrialCollector, at_once: bool) -> None:
        """Send the markers of all trials, unless the last ones show the same."""
        # Each message has the markers of all trials, and is recorded: the more trials, the fewer messages.
        now, period = self._clock(), 1.0 + 0.1 * collector.count
        if not at_once and not (
                state.markers.wanted and collector.count and now - state.markers.last >= period):
            return
        state.markers = Pace(last=now)
        result, trials, scene = state.result, collector.trials, self._graph.options().scene
        if trials and result is self._shown[0] and alike(trials, self._shown[1]) and scene == self._shown[2]:
            return
        self._shown = result, trials, scene
        self.send('markers', markers(self._types, trials, stamp=self._graph.stamp(),
                                     frame_id=collector.frame_id, result=result, pose=collector.pose,
                                     obstacles=shown_obstacles(scene)))


QUIET = 0.5  # s without action or goal chain, after which the last trial counts as complete
PATIENCE = 10.0  # s that closing waits for each worker
UNDER_WAY = 1.0  # s for which messages from before a jump of the clock may still arrive


class CalibrationSession(NodeSession[CalibratorOptions]):
    """
    Collects trials, calibrates on request, and publishes progress, result, status and markers.

    It is not thread-safe.

    :param types: the message classes that `graph` encodes.
    :param make_simulator: builds the engine, in the worker's thread.
    :param clock: a monotonic clock [s].
    """

    def __init__(self, graph: NodeInterface[CalibratorOptions], types: MessageTypes,
                 make_simulator: SimulatorFactory, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(graph, types, INPUT_TYPES, SessionState(), clock)
        self._state: SessionState
        self.requests = {'start': self._start, 'stop': self._stop, 'reset': self._reset,
                         'discard_last': self._discard_last}
        self._make_simulator = make_simulator
        self.collecting = Collecting(graph.options().of_calibration)
        self._worker = Worker(make_simulator)
        self._live_information = LiveInformation(make_simulator)
        self._recorder = Recorder(self._fail_to_record, make_simulator)
        self._outlet = Outlet(graph, types, self._recorder, clock)
        self._calibration: CalibrationUnderWay | None = None
        self._order = StampOrder()
        self._began = self._clock()
        self.behind = False  # whether messages wait; information and markers would delay them
        self._begin_recording()
        if folder := graph.options().resume:
            self._resume(Path(folder).expanduser())
        self._report()

    def _resume(self, folder: Path) -> None:
        """
        Hear the messages of an earlier session.

        :raises InputError: if it cannot be read.
        """
        session = read_session(folder)
        for record in session.inputs:
            self.hear(record.name, record.data, flush=False)
        self.flush()
        self._graph.info(f'{self._collector.count} trial(s) of {folder} are taken over')

    @property
    def _collector(self) -> TrialCollector:
        return self.collecting.collector

    @property
    def calibrating(self) -> bool:
        """Whether a calibration is under way."""
        return self._calibration is not None

    def hear(self, kind: str, octets: bytes, flush: bool = True) -> None:
        """
        Record a message that came on an input topic, then collect it or refuse it.

        :param flush: False where `flush` follows soon.
        """
        message, refusal = self._read(kind, octets)
        if message and self._order.clock_went_back(message):
            self._begin_anew(went_back(self._order.newest, message.stamp))
        if message and self._clock() - self._began < UNDER_WAY and self._order.left_over(message):
            self.refuse(f'{message}: a stamp from before the clock went back; expected a later one; '
                        'it belongs to the former session')
            return
        self._recorder.message(self._graph.topic(kind), INPUT_TYPES[kind], octets, flush)
        if kind == WRENCH or isinstance(message, WrenchMessage):  # a sensor goes on all the time
            if refusal := refusal if message is None else self._collect(message):
                self.refuse(refusal)
            return
        if kind != INITIAL:
            self._state.heard = self._clock()
            self._state.markers.wanted = self._state.renewal.wanted = True
        refusal = refusal if message is None else self._collect(message)
        if message and not refusal:
            chain = message.chain if isinstance(message, ChainMessage) else None
            pose = self._collector.pose
            self._state.advising.resting_place.take(message, pose.chain(chain) if pose and chain else chain)
        if refusal:
            self.refuse(refusal)
        elif not self.calibrating and (self._state.name != 'done' or kind != GOAL):  # a tracker goes on
            self._state.name, self._state.detail = 'collecting', ''

    def drop(self, counts: Mapping[str, int]) -> None:
        """Count messages that came and were dropped, by kind."""
        self._state.dropped.counts.update(counts)

    def keep(self, kind: str, octets: bytes) -> None:
        """Record a message without collecting it, as the node ends."""
        self._recorder.message(self._graph.topic(kind), INPUT_TYPES[kind], octets, False)

    def flush(self) -> None:
        """Give the recorded messages to the operating system."""
        self._recorder.flush()

    def refuse(self, text: str) -> None:
        """Report a refusal as other sessions do, and remember it."""
        self._state.refusals.append(safe_line(text))
        super().refuse(text)

    def tick(self) -> None:
        """Do what is due now; the node calls this many times a second, and answers others in between."""
        if not self.behind:
            self._show(at_once=False)
        self._take_events()
        self._recorder.report_failures()
        self._report_refusals()
        self._report_dropped()
        self._start_by_itself()
        self._renew_information()
        self._report()

    def change_options(self) -> None:
        """Use the options in force from now on; `collect_anew` collects the messages so far with them."""
        self._state.advising.asked = None  # other limits permit other actions
        self.collecting.change(self._graph.options().of_calibration)

    def collect_anew(self) -> None:
        """Collect one message anew; new messages wait until `collecting.left` is 0."""
        if self.collecting.step():
            self._report_news()

    def _take_options(self) -> Options:
        """Return the options in force, with which all messages so far are collected."""
        self.change_options()
        while self.collecting.left:
            self.collect_anew()
        return self.collecting.options

    def close(self) -> None:
        """End the calibration, with its best evaluation so far as the result, then the recording."""
        self._worker.stop()
        self._live_information.stop()
        try:
            self._report_dropped(at_once=True)
            if not (self._worker.join(PATIENCE) and self._live_information.join(PATIENCE)):
                self._graph.warn(f'a simulation did not end within {PATIENCE:.0f} s; it is abandoned')
            self._take_events()
            self._warn(self._state.counted.rest())
        finally:
            self._recorder.close()

    # Messages of the robot

    def _read(self, kind: str, octets: bytes) -> tuple[InputMessage | None, str]:
        """Return a message, or None and why it cannot be read."""
        try:
            return read(kind, self._decoded(kind, octets)), ''
        except Exception as error:  # a defect of this package must not end the session
            return None, refusal_text(error, kind)

    def _collect(self, message: InputMessage) -> str:
        """Collect a message; return why it is refused, if it is."""
        try:
            self._order.check(message)
            self._order.add(message)
            self._collector.add(message)
            self._report_news()
        except Exception as error:
            return refusal_text(error, message.kind)
        return ''

    def _report_news(self) -> None:
        for refusal in (*self._collector.take_refusals(), *self._collector.take_warnings()):
            self.refuse(str(refusal))
        for early in self._collector.take_early():
            self._graph.info(early)

    def clock_went_back(self, before: int, now: int) -> None:
        """Begin another session, as the node's clock went from one time [ns] back to another."""
        self._graph.hear_waiting()
        if self._clock() - self._began > UNDER_WAY:  # else the stamps of messages showed it first
            self._begin_anew(went_back(before, now))

    def _begin_anew(self, why: str) -> None:
        """Begin another session because the clock went back."""
        self._order, self._began = StampOrder(self._order), self._clock()
        self._state.advising.resting_place = RestingPlace()
        if self._state.heard == float('-inf'):  # only initial chains came: there is no session to keep
            self.collecting = Collecting(self._graph.options().of_calibration)
            self._graph.warn(why)
            return
        count, folder = self._collector.count, self._recorder.folder
        place = f'in {folder}' if folder else 'forgotten'
        self._forget()
        self.refuse(f'{why}: a new session begins; the {count} trial(s) of the former one are {place}')

    # Requests

    def _require_idle(self, name: str) -> None:
        if self.calibrating:
            raise InputError(f'~/{name}', 'a calibration under way', 'none',
                             'wait for it, or call ~/stop first')

    def _start(self) -> str:
        self._require_idle('start')
        self._graph.hear_waiting()  # messages sent before the request belong to this calibration
        options = self._take_options()
        reported = set(self._state.refusals)
        for refusal in map(str, (*self._collector.refusals, *self._collector.force_problems)):
            if refusal not in reported:
                self.refuse(refusal)
        trials = self._collector.trials
        if not trials:
            lacks = self._collector.incomplete or 'an initial_chain, an action and a goal_chain'
            raise InputError('~/start', 'no complete trial', lacks, 'send it, then call ~/start again')
        self._make_simulator(options).close()  # raises here if the engine or the scene cannot be used
        log = self._recorder.start(trials, options)
        state = self._state
        choice = choose(trials, options)
        progress = Progress(choice.options.evaluations, len(trials), log.evaluations if log else 0)
        self._calibration = CalibrationUnderWay(options, progress, state)
        state.started, state.name, state.detail = True, 'calibrating', log.resumed if log else ''
        self._live_information.stop()
        state.renewal.wanted, state.advising.asked = True, None  # after the calibration, as it was stopped
        self._worker.start(trials, options, log)
        return ' '.join(filter(None, [
            f'calibrating on {len(trials)} trial(s), at most {progress.evaluations} evaluations.',
            choice.words]))

    def _start_by_itself(self) -> None:
        state, wanted = self._state, self._graph.options().start_after_trials
        if self.calibrating or self.collecting.left or state.started \
                or not 0 < wanted <= self._collector.count:
            return
        # A trial may have many goal chains: it is complete when the next trial begins, or no message follows.
        if self._collector.count > wanted or self._clock() - state.heard > QUIET:
            state.started = True
            try:
                self._graph.info(self._start())
            except InputError as error:
                state.name, state.detail = FAILED, str(error)
                self.refuse(str(error))

    def _stop(self) -> str:
        if not self.calibrating:
            raise InputError('~/stop', 'no calibration under way', 'one', 'call ~/start first')
        self._worker.stop()
        return 'the search ends now; the best so far will be the result'

    def _reset(self) -> str:
        self._require_idle('reset')
        self._order = StampOrder()
        self._forget()
        return 'the trials are forgotten'

    def _discard_last(self) -> str:
        self._require_idle('discard_last')
        self._graph.hear_waiting()  # messages sent before the request belong to that trial
        self._take_options()
        before = self._collector.count
        self._recorder.taken_back(*self._collector.take_back())
        state, count = self._state, self._collector.count
        self._live_information.stop()
        state.name, state.detail, state.information = 'collecting', '', None
        state.advising.advice = state.advising.asked = None
        state.renewal.wanted = True
        self._show()
        which = f'trial {before}' if count < before else 'the incomplete trial'
        return f'{which} is taken back; {count} trial(s) are left'

    def _forget(self) -> None:
        """Begin another session; a calibration under way goes on."""
        self._report_dropped(at_once=True)
        self._recorder.end()
        self._live_information.stop()
        self.collecting = Collecting(self._graph.options().of_calibration)
        self._warn(self._state.counted.rest())
        self._status = {}  # the next one is about another session
        self._state = SessionState('calibrating' if self.calibrating else 'collecting')
        self._began = self._clock()
        self._begin_recording()
        self._show()

    # Events of the worker, and information about trials

    def _take_events(self) -> None:
        for event in self._worker.waiting_events():
            if isinstance(event, CalibrationWarning):
                self._state.detail = safe_line(event.text)
                self._graph.warn(event.text)
            elif not isinstance(event, Evaluation):
                self._finish(event)
            elif self._calibration is not None:
                self._calibration.progress.take(event)
        if self._calibration is not None:
            self._outlet.progress(self._calibration)

    def _finish(self, event: CalibrationResult | Failure) -> None:
        calibration, self._calibration = self._calibration, None
        assert calibration is not None
        self._outlet.progress(calibration, at_once=True)
        self._worker.join()
        if isinstance(event, Failure):
            self._recorder.finish(interrupted=True)
            self.fail(event.text, f'calibration failed: {event.text}', *filter(None, [event.details]))
            return
        state, options = self._state, calibration.options
        state.name, state.detail = 'done', f'{event.headline} {event.stop_reason}'
        calibration.state.result = event
        if state is not calibration.state:
            state.detail += '; this is the result of the session before the clock went back'
        (self._graph.warn if event.unusable else self._graph.info)(event.headline)
        self._graph.info(diagnostics.in_one_line(event))
        for warning in event.warnings:
            self._graph.warn(warning)
        self._outlet.result(event, options)
        if older := self._recorder.result(event, options):
            self._graph.info(older)
        self._recorder.finish(interrupted=self._worker.stopped)
        state.markers = Pace(wanted=True)  # at the next tick
        self._report()

    def _renew_information(self) -> None:
        """
        Take new information; renew it if trials have changed, and seek advice if the DLO rests elsewhere.

        None of that begins while a calibration is under way.
        """
        state, now = self._state, self._clock()
        for event in self._live_information.waiting_events():
            if isinstance(event, NextAction):
                self._advise(event)
            elif isinstance(event, TrialInformation) and self._is_about_newest(event):
                state.information = event
        since = now - state.renewal.last
        if self.behind or self.calibrating or self._live_information.alive or since < QUIET:
            return
        quiet, count = now - state.heard > QUIET, self._collector.count
        # While messages keep coming, a renewal every two seconds leaves the processor to other programs.
        due = state.renewal.wanted and count > 0 and (quiet or since > 2.0)
        options, then = self._graph.options(), None
        last = self._collector.trials[-1].goals[-1] if count and not self._collector.incomplete else None
        place = state.advising.resting_place.find(last, quiet, options.pause)
        if place is not None and state.name != 'done' and state.advising.is_due(count, place):
            state.advising.asked, then = (count, place), self._asking(place)
        elif not due:
            return
        state.renewal = Pace(wanted=state.renewal.wanted and not quiet, last=now)
        self._live_information.start(
            self._collector.trials, options.of_calibration, state.result, quiet, then)

    def _asking(self, place: Chain) -> Callable[[Appraised, Options, Callable[[], bool]], NextAction]:
        limits, make = self._graph.options().of_advice, self._make_simulator

        def ask(appraised: Appraised, options: Options, should_stop: Callable[[], bool]) -> NextAction:
            try:
                return next_action(appraised, options, limits, place, make, should_stop)
            except (InputError, SimulationError) as error:
                return NextAction.failed(options.space.free, str(error))

        return ask

    def _advise(self, advice: NextAction) -> None:
        """Publish advice; where something is wanted and no action is left, calibrate."""
        state, collector = self._state, self._collector
        state.advising.take(advice, collector.count, self._clock())
        pose, stamp = collector.pose, self._graph.stamp() or NANOSECONDS
        self._report()  # whoever gets the action finds its words there
        if advice.action is None:
            message = self._types.build(OUTPUT_TYPES['advice'], points=[], joint_names=[],
                                        header=self._types.header(stamp, collector.frame_id))
        else:
            action = advice.action if pose is None else pose.inverse.action(advice.action)
            message = action_trajectory(self._types, action_message(action.hands, stamp, collector.frame_id))
        self._outlet.send('advice', message)
        self._graph.info(f'next: {advice.words}')
        if advice.action is None and advice.complete and self._graph.options().wanted and collector.count \
                and not state.started:
            try:
                self._graph.info(self._start())
            except InputError as error:
                self.refuse(str(error))

    def _is_about_newest(self, information: TrialInformation | None) -> bool:
        """Tell whether information is about the newest trial; which others may follow."""
        return information is not None and information.trial == f'trial {self._collector.count}'

    # Messages of the node

    def _report_dropped(self, at_once: bool = False) -> None:
        """Warn of dropped messages if there are new ones, at most once a second."""
        if texts := self._state.dropped.due(self._clock(), at_once):
            self._warn(texts)
            self._recorder.dropped(self._state.dropped.reported)

    def _report(self) -> None:
        """Send the status if it differs from the last one."""
        state, collector = self._state, self._collector
        content: dict[str, Any] = {
            'state': state.name, 'trials': collector.count, 'last_refusal': state.last_refusal,
            'incomplete': collector.incomplete, 'detail': ANEW if self.collecting.left else state.detail,
            'dropped': state.dropped.reported.total(), **state.advising.told}
        about = state.information if self._is_about_newest(state.information) else None
        if self._status_is_due({**content, 'about': about}, 'last_refusal', 'incomplete', 'dropped'):
            self._outlet.send('status', diagnostics.status(self._types, self._graph.stamp(), content, about))

    def _show(self, at_once: bool = True) -> None:
        self._outlet.markers(self._state, self._collector, at_once)

    def _begin_recording(self) -> None:
        self._recorder.begin(self._graph.options().of_calibration)
        if self._recorder.folder is not None:
            self._graph.info(f'recording to {self._recorder.folder}')

    def _fail_to_record(self, text: str) -> None:
        self._state.last_refusal = text
        self._graph.error(text)
        self._report()
