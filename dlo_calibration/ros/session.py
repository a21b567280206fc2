# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
CalibrationSession: what the node knows, and what it does with a message, a request or the passing of time.

It imports no rclpy: it reaches ROS through a `Graph`, which the node implements.
Every error is reported in the log and in ``~/status``, and the node goes on working.
"""

from __future__ import annotations

import time
from typing import Callable, Mapping

from dlo_calibration.calibration.automatic import choose
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.live_information import LiveInformation
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.progress import Progress
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.worker import Failure, Notice, Worker
from dlo_calibration.errors import DEFECT, DloCalibrationError, InputError, told
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.messages.codec import GOAL, INITIAL, INPUT_TYPES, MessageTypes, read
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.messages.stamp_order import StampOrder, went_back
from dlo_calibration.messages.trial_builder import Message
from dlo_calibration.report import sentences
from dlo_calibration.ros import diagnostics
from dlo_calibration.ros.collecting import Collecting
from dlo_calibration.ros.graph import decoded, Graph, why
from dlo_calibration.ros.outlet import Outlet
from dlo_calibration.ros.recorder import Recorder
from dlo_calibration.ros.situation import Calibration, Pace, Situation

QUIET = 0.5  # s without action or goal chain, after which the last trial counts as complete
PATIENCE = 10.0  # s that closing waits for each worker
UNDER_WAY = 1.0  # s for which messages from before a jump of the clock may still arrive


class CalibrationSession:
    """
    Collects trials, calibrates on request, and publishes progress, result, status and markers.

    It is not thread-safe.

    :param types: the message classes that `graph` encodes.
    :param make_simulator: builds the engine, in the worker's thread.
    :param clock: a monotonic clock [s].
    """

    def __init__(self, graph: Graph[Options], types: MessageTypes, make_simulator: SimulatorFactory,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self._graph, self._types, self._clock = graph, types, clock
        self._make_simulator = make_simulator
        self.collecting = Collecting(graph.options())
        self._worker = Worker(make_simulator)
        self._appraiser = LiveInformation(make_simulator)
        self._recorder = Recorder(self._fail_to_record, make_simulator)
        self._outlet = Outlet(graph, types, self._recorder, clock)
        self._situation = Situation()
        self._calibration: Calibration | None = None
        self._order = StampOrder()
        self._began = self._clock()
        self.behind = False  # whether messages wait; appraisals and markers would delay them
        self._begin_recording()
        self._report()

    @property
    def _collector(self) -> TrialCollector:
        return self.collecting.collector

    @property
    def calibrating(self) -> bool:
        """Tell whether a calibration is under way."""
        return self._calibration is not None

    def hear(self, kind: str, octets: bytes, flush: bool = True) -> None:
        """
        Record a message that came on an input topic, then collect it or refuse it.

        :param flush: False where `flush` follows soon.
        """
        message, problem = self._read(kind, octets)
        if message and self._order.clock_went_back(message):
            self._begin_anew(went_back(self._order.newest, message.stamp))
        if message and self._clock() - self._began < UNDER_WAY and self._order.left_over(message):
            self.refuse(f'{message}: got a stamp from before the clock went back, expected a later one; '
                        'it belongs to the former session')
            return
        self._recorder.message(self._graph.topic(kind), INPUT_TYPES[kind], octets, flush)
        if kind != INITIAL:
            self._situation.heard = self._clock()
            self._situation.markers.wanted = self._situation.appraisal.wanted = True
        problem = problem if message is None else self._collect(message)
        if problem:
            self.refuse(problem)
        elif not self.calibrating and (self._situation.state != 'done' or kind != GOAL):  # a tracker goes on
            self._situation.state, self._situation.detail = 'collecting', ''

    def drop(self, counts: Mapping[str, int]) -> None:
        """Take note of messages of some kinds that came, and were dropped."""
        self._situation.dropped.counts.update(counts)

    def keep(self, kind: str, octets: bytes) -> None:
        """Record a message, as no time is left to collect it."""
        self._recorder.message(self._graph.topic(kind), INPUT_TYPES[kind], octets, False)

    def flush(self) -> None:
        """Give the recorded messages to the operating system."""
        self._recorder.flush()

    def refuse(self, text: str) -> None:
        """Tell why something was refused, in the log and in ``~/status``; a repeated reason not each time."""
        text, situation = told(text), self._situation
        situation.refusals.append(text)
        situation.last_refusal = situation.counted.add(text)
        self._tell_refusals(situation.counted.due(self._clock()))

    def request(self, name: str) -> tuple[bool, str]:
        """Serve a request; return whether that succeeded, and the answer."""
        try:
            if name != 'stop' and self.calibrating:
                raise InputError(f'~/{name}', 'a calibration under way', 'none',
                                 'wait for it, or call ~/stop first')
            answer = {'start': self._start, 'stop': self._stop, 'reset': self._reset,
                      'discard_last': self._discard_last}[name]()
        except Exception as error:
            answer = str(error) if isinstance(error, DloCalibrationError) else f'{error!r}; {DEFECT}'
            self.refuse(answer)
            return False, answer
        self._report()
        return True, answer

    def tick(self) -> None:
        """Do what is due now; the node calls this many times a second, and answers others in between."""
        if not self.behind:
            self._show(at_once=False)
        self._take_events()
        self._recorder.tell()
        self._tell_refusals(self._situation.counted.due(self._clock()))
        self._tell_dropped()
        self._start_by_itself()
        self._appraise()
        self._report()

    def change_options(self) -> None:
        """Take note of the options in force; `collect_anew` collects the messages so far with them."""
        self.collecting.change(self._graph.options())

    def collect_anew(self) -> None:
        """Collect one message anew; others wait until none of `collecting` is left."""
        if self.collecting.step():
            self._tell_news()

    def _take_options(self) -> Options:
        """Return the options in force, with which all messages so far are collected."""
        self.change_options()
        while self.collecting.left:
            self.collect_anew()
        return self.collecting.options

    def fail(self, text: str, *log: str) -> None:
        """Report a failure in ``~/status`` and in the log; `log` has the lines of the log if they differ."""
        self._situation.state, self._situation.detail = 'failed', told(text)
        for line in log or (text,):
            self._graph.error(line)
        self._report()

    def close(self) -> None:
        """End the calibration, with its best evaluation so far as the result, then the recording."""
        self._worker.stop()
        self._appraiser.stop()
        try:
            self._tell_dropped(at_once=True)
            if not (self._worker.join(PATIENCE) and self._appraiser.join(PATIENCE)):
                self._graph.warn(f'a simulation did not end within {PATIENCE:.0f} s; it is abandoned')
            self._take_events()
            self._tell_refusals(self._situation.counted.rest())
        finally:
            self._recorder.close()

    # Messages of the robot

    def _read(self, kind: str, octets: bytes) -> tuple[Message | None, str]:
        """Return a message, or None and why it cannot be read."""
        try:
            return read(kind, decoded(self._graph, kind, INPUT_TYPES[kind], octets)), ''
        except Exception as error:  # a defect of this package must not end the session
            return None, why(error, kind)

    def _collect(self, message: Message) -> str:
        """Collect a message; return why it is refused, if it is."""
        try:
            self._order.check(message)
            self._order.add(message)
            self._collector.add(message)
            self._tell_news()
        except Exception as error:
            return why(error, message.kind)
        return ''

    def _tell_news(self) -> None:
        for refusal in (*self._collector.take_news(), *self._collector.take_doubts()):
            self.refuse(str(refusal))
        for early in self._collector.take_early():
            self._graph.info(f'{early.thing}: came before the first initial chain; not used')

    def clock_went_back(self, before: int, now: int) -> None:
        """Begin another session, as the node's clock went from one time [ns] back to another."""
        self._graph.hear_waiting()
        if self._clock() - self._began > UNDER_WAY:  # else the stamps of messages told it first
            self._begin_anew(went_back(before, now))

    def _begin_anew(self, why: str) -> None:
        """Begin another session because the clock went back."""
        self._order, self._began = self._order.after_jump(), self._clock()
        if self._situation.heard == float('-inf'):  # only initial chains came: there is no session to keep
            self.collecting = Collecting(self._graph.options())
            self._graph.warn(why)
            return
        count, folder = self._collector.count, self._recorder.folder
        place = f'in {folder}' if folder else 'forgotten'
        self._forget()
        self.refuse(f'{why}: a new session begins; the {count} trial(s) of the former one are {place}')

    # Requests

    def _start(self) -> str:
        self._graph.hear_waiting()  # messages sent before the request belong to this calibration
        options = self._take_options()
        known = set(self._situation.refusals)
        for problem in self._collector.problems:
            if str(problem) not in known:
                self.refuse(str(problem))
        trials = self._collector.trials
        if not trials:
            lacks = self._collector.incomplete or 'an initial_chain, an action and a goal_chain'
            raise InputError('~/start', 'no complete trial', lacks, 'send it, then call ~/start again')
        self._make_simulator(options).close()  # raises here if the engine or the scene cannot be used
        log = self._recorder.start(trials, options)
        situation = self._situation
        choice = choose(trials, options)
        progress = Progress(choice.options.evaluations, len(trials), log.evaluations if log else 0)
        self._calibration = Calibration(options, progress, situation)
        situation.started, situation.state, situation.detail = True, 'calibrating', log.resumed if log else ''
        self._appraiser.stop()
        situation.appraisal.wanted = True  # again after the calibration, as this one was stopped
        self._worker.start(trials, options, log)
        return ' '.join(filter(None, [
            f'calibrating on {len(trials)} trial(s), {progress.evaluations} evaluations.', choice.words]))

    def _start_by_itself(self) -> None:
        situation, wanted = self._situation, self._graph.options().start_after_trials
        if self.calibrating or self.collecting.left or situation.started \
                or not 0 < wanted <= self._collector.count:
            return
        # A trial may have many goal chains: it is complete when the next trial begins, or no message follows.
        if self._collector.count > wanted or self._clock() - situation.heard > QUIET:
            situation.started = True
            try:
                self._graph.info(self._start())
            except InputError as error:
                situation.state, situation.detail = 'failed', str(error)
                self.refuse(str(error))

    def _stop(self) -> str:
        if not self.calibrating:
            raise InputError('~/stop', 'no calibration under way', 'one', 'call ~/start first')
        self._worker.stop()
        return 'the search ends now; the best so far will be the result'

    def _reset(self) -> str:
        self._order = StampOrder()
        self._forget()
        return 'the trials are forgotten'

    def _discard_last(self) -> str:
        self._graph.hear_waiting()  # messages sent before the request belong to that trial
        self._take_options()
        before = self._collector.count
        self._recorder.taken_back(*self._collector.take_back())
        situation, count = self._situation, self._collector.count
        self._appraiser.stop()
        situation.state, situation.detail, situation.information = 'collecting', '', None
        situation.appraisal.wanted = True
        self._show()
        which = f'trial {before}' if count < before else 'the incomplete trial'
        return f'{which} is taken back; {count} trial(s) are left'

    def _forget(self) -> None:
        """Begin another session; a calibration under way goes on."""
        self._tell_dropped(at_once=True)
        self._recorder.end()
        self._appraiser.stop()
        self.collecting = Collecting(self._graph.options())
        self._tell_refusals(self._situation.counted.rest())
        self._situation = Situation(state='calibrating' if self.calibrating else 'collecting')
        self._began = self._clock()
        self._begin_recording()
        self._show()

    # Events of the worker, and appraisals of trials

    def _take_events(self) -> None:
        for event in self._worker.waiting_events():
            if isinstance(event, Notice):
                self._situation.detail = told(event.text)
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
        situation, options = self._situation, calibration.options
        situation.state, situation.detail = 'done', f'{sentences.verdict(event)} {event.stop_reason}'
        calibration.situation.result = event
        if situation is not calibration.situation:
            situation.detail += '; this is the result of the session before the clock went back'
        (self._graph.warn if event.unusable else self._graph.info)(sentences.verdict(event))
        self._graph.info(diagnostics.in_one_line(event))
        for warning in event.warnings:
            self._graph.warn(warning)
        self._outlet.result(event, options)
        if older := self._recorder.result(event, options):
            self._graph.info(older)
        self._recorder.finish(interrupted=self._worker.stopped)
        situation.markers = Pace(wanted=True)  # at the next tick
        self._report()

    def _appraise(self) -> None:
        """Take finished appraisals; start one if trials changed and no calibration is under way."""
        situation, now = self._situation, self._clock()
        for information in self._appraiser.waiting_information():
            situation.information = information
        quiet = now - situation.heard > QUIET
        # While messages keep coming, an appraisal every two seconds leaves the processor to other programs.
        if situation.appraisal.wanted and not self.behind and not self.calibrating and self._collector.count \
                and not self._appraiser.alive \
                and (quiet or now - situation.appraisal.last > 2.0):
            situation.appraisal = Pace(wanted=not quiet, last=now)
            self._appraiser.start(self._collector.trials, self._graph.options(), situation.result, quiet)

    # Messages of the node

    def _tell_dropped(self, at_once: bool = False) -> None:
        """Tell how many messages were dropped, if that number has changed, at most once a second."""
        if texts := self._situation.dropped.due(self._clock(), at_once):
            self._tell_refusals(texts)
            self._recorder.dropped(self._situation.dropped.told)

    def _report(self) -> None:
        """Send the status if it differs from the last one."""
        detail = self.collecting.words or self._situation.detail
        self._outlet.status(self._situation, self._collector, detail)

    def _show(self, at_once: bool = True) -> None:
        self._outlet.markers(self._situation, self._collector, at_once)

    def _begin_recording(self) -> None:
        self._recorder.begin(self._graph.options())
        if self._recorder.folder is not None:
            self._graph.info(f'recording to {self._recorder.folder}')

    def _tell_refusals(self, texts: list[str]) -> None:
        for text in texts:
            self._graph.warn(text)
        if texts:
            self._report()

    def _fail_to_record(self, text: str) -> None:
        self._situation.last_refusal = text
        self._graph.error(text)
        self._report()
