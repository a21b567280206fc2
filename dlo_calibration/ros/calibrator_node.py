# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The node: topics, services and parameters around a collector and a worker.

Nothing is computed here.  Whatever goes wrong ends in the log and in ``~/status``,
and the node stays.
"""

from __future__ import annotations

from collections import deque
import functools
import logging
import sys
import time
from typing import Any, Callable, Sequence

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import MultiDOFJointTrajectory
from visualization_msgs.msg import MarkerArray

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.live_information import Appraiser
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.progress import Progress
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.worker import Failure, Notice, Worker
from dlo_calibration.errors import DloCalibrationError, InputError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.files.result import description_document
from dlo_calibration.inference.trial_information import Gain
from dlo_calibration.messages import codec
from dlo_calibration.messages.codec import ACTION, GOAL, INITIAL, INPUT_TYPES
from dlo_calibration.messages.collector import KEPT, TrialCollector
from dlo_calibration.ros import diagnostics
from dlo_calibration.ros.diagnostics import OUTPUT_TYPES
from dlo_calibration.ros.markers import markers
from dlo_calibration.ros.parameters import OptionsNode
from dlo_calibration.ros.recorder import Recorder

LOG = logging.getLogger('dlo_calibration')  # notices of the rest of the package
DEPTH = 2000  # messages that may wait while another callback works: a burst of goal chains
#: topic -> class, quality of service
INPUTS = {
    INITIAL: (PointCloud2, QoSProfile(depth=DEPTH)),
    ACTION: (MultiDOFJointTrajectory, QoSProfile(depth=DEPTH)),
    GOAL: (PointCloud2, QoSProfile(depth=DEPTH)),
}
BEST_EFFORT = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
OUTPUTS = {
    'progress': (DiagnosticArray, QoSProfile(depth=10)),
    'result': (DiagnosticArray, LATCHED),
    'dlo_description': (String, LATCHED),
    'status': (DiagnosticArray, LATCHED),
    'markers': (MarkerArray, LATCHED),
}

#: What a bad command line raises; nothing public has them.
ARGUMENT_ERRORS = (rclpy_implementation.RCLError, rclpy_implementation.UnknownROSArgsError)

TICK = 0.05  # s between two looks at the worker
PROGRESS_PERIOD = 0.1  # s between two progress messages, at least
MARKERS_PERIOD = 1.0  # s between two messages of markers while trials come in, at least
MARKERS_SHARE = 0.1  # s more of it per trial, so that a long session is not recorded again and again
STREAM_PERIOD = 2.0  # s between two looks at what trials tell, while messages keep coming
QUIET = 0.5  # s without action or goal chain, until a last trial counts as complete for start_after_trials
WAIT = 'wait for it, or call ~/stop first'
DEFECT = 'this is a defect of dlo_calibration, please report it'
PATIENCE = 10.0  # s that the end waits for the worker


def spin(args: Sequence[str], should_stop: Callable[[], bool],
         make_simulator: SimulatorFactory = make_chosen_simulator) -> int:
    """
    Run the node until `should_stop`; handles no signal itself.

    :param args: command line without the program's name.
    :returns: exit code: 0, or 2 for what cannot be used, after one line on stderr.
    """
    node, executor = None, None
    try:
        strange = remove_ros_args(['calibrator', *args])[1:]
        if strange:
            raise InputError('command line', ' '.join(strange), 'only --ros-args ...',
                             'set a parameter with --ros-args -p NAME:=VALUE')
        if should_stop():
            return 0
        rclpy.init(args=list(args), signal_handler_options=SignalHandlerOptions.NO)
        node = CalibratorNode(make_simulator)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not should_stop() and rclpy.ok():
            executor.spin_once(timeout_sec=TICK)
    except ExternalShutdownException:
        pass
    except (InputError, *ARGUMENT_ERRORS) as error:
        sys.stderr.write(f'calibrator: {" ".join(str(error).split())}\n')
        return 2
    finally:
        if executor is not None:
            executor.shutdown(timeout_sec=0)
        if node is not None:
            node.close()
        rclpy.try_shutdown()
    return 0


class _Notices(logging.Handler):
    """Passes the package's notices on to the node's log."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        super().__init__()
        self._tell = tell

    def emit(self, record: logging.LogRecord) -> None:
        """Pass one on."""
        self._tell(record.getMessage())


class CalibratorNode(OptionsNode):
    """
    The node `calibrator`.

    :param make_simulator: builds the engine, in the worker's thread.
    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value.
    """

    def __init__(self, make_simulator: SimulatorFactory = make_chosen_simulator, **arguments: Any) -> None:
        super().__init__('calibrator', **arguments)
        self._types = codec.rclpy_types()
        self._collector = TrialCollector(self.options())
        self._collected_with = self.options()
        self._make_simulator = make_simulator
        self._worker = Worker(make_simulator)
        self._appraiser = Appraiser(make_simulator)
        self._recorder = Recorder(self._fail_to_record, make_simulator)
        self._calibrating: Options | None = None  # options of the calibration under way
        self._progress = Progress(0, 0)
        self._progress_sent = 0.0
        self._forget()
        self._deaf: set[str] = set()
        self._closed = False
        self._notices = _Notices(self._warn)
        LOG.addHandler(self._notices)
        self._outputs = {name: self.create_publisher(kind, f'~/{name}', qos)
                         for name, (kind, qos) in OUTPUTS.items()}
        self._begin_session()
        self._report()
        self._inputs = {name: self._subscribe(name, qos) for name, (_, qos) in INPUTS.items()}
        for name, act in (('start', self._start), ('stop', self._stop), ('reset', self._reset)):
            self.create_service(Trigger, f'~/{name}', functools.partial(self._serve, act))
        # Steady: with use_sim_time and no /clock, a timer of the node's own clock would never fire.
        self.create_timer(TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.get_logger().info('collecting trials; call ~/start to calibrate')

    def close(self) -> None:
        """End the worker and the session, and destroy the node; closing twice does nothing."""
        if self._closed:
            return
        self._closed = True
        LOG.removeHandler(self._notices)
        self._worker.stop()
        self._appraiser.stop()
        try:
            if not (self._worker.join(PATIENCE) and self._appraiser.join(PATIENCE)):
                self._warn('the simulation under way does not end; it is left behind')
            self._take_events()
        except (InvalidHandle, RuntimeError) as error:  # the context was shut down by somebody else
            self.get_logger().debug(repr(error))
        finally:
            self._recorder.close()
            self.destroy_node()

    def changed(self, names: Sequence[str]) -> None:
        """Take note that parameters have new values."""
        if self._calibrating is not None:
            self.get_logger().info(f'{", ".join(names)}: takes effect at the next start')

    def refuse(self, text: str) -> None:
        """Tell why something was refused, in the log and in ``~/status``."""
        self._last_refusal = text
        self._told.append(text)
        self._warn(text)
        self._report()

    # Messages in

    def _subscribe(self, kind: str, qos: QoSProfile) -> Any:
        return self.create_subscription(
            INPUTS[kind][0], f'~/{kind}', functools.partial(self._hear, kind), qos, raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=functools.partial(self._meet_incompatible, kind)))

    def _meet_incompatible(self, kind: str, event: Any) -> None:
        if event.last_policy_kind == QoSPolicyKind.RELIABILITY:
            self._deaf.add(kind)  # the next tick replaces it, not its own callback
        else:
            self._warn(f'{kind}: a publisher cannot be heard, its quality of service does not match; '
                       'publish with reliable or best-effort reliability and default deadlines')

    def _hear_best_effort(self) -> None:
        """Replace subscriptions that a best-effort publisher cannot reach."""
        while self._deaf:
            kind = self._deaf.pop()
            old, self._inputs[kind] = self._inputs[kind], self._subscribe(kind, BEST_EFFORT)
            self._empty(kind, old)
            self.destroy_subscription(old)
            self.get_logger().info(f'{kind}: a publisher offers best effort only; listening so')

    def _empty(self, kind: str, subscription: Any) -> None:
        """Take what waits in a subscription's queue."""
        with subscription.handle:
            while (taken := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                self._hear(kind, taken[0])

    def _hear(self, kind: str, octets: bytes) -> None:
        """Record a message, then collect it or refuse it."""
        self._record(kind, INPUT_TYPES[kind], octets)
        if kind != INITIAL:
            self._last_heard = time.monotonic()
            self._unseen = self._unappraised = True
        try:
            try:
                message = deserialize_message(octets, INPUTS[kind][0])
            except Exception as error:  # whatever the decoder meets in damaged bytes
                raise InputError(kind, f'bytes that do not decode ({error!r})', f'a {INPUT_TYPES[kind]}',
                                 'check what publishes it') from error
            self._collector.add(codec.read(kind, message))
            for refusal in self._collector.take_news():
                self.refuse(str(refusal))
        except InputError as error:
            self.refuse(str(error))
        except Exception as error:  # a defect of ours must not take the session with it
            self.refuse(f'{kind}: could not be used ({error!r}); {DEFECT}')
        else:
            if self._calibrating is None:
                self._state, self._detail = 'collecting', ''

    # Services

    def _serve(self, act: Callable[[], str], _: Trigger.Request,
               response: Trigger.Response) -> Trigger.Response:
        try:
            response.message, response.success = act(), True
        except DloCalibrationError as error:
            response.message, response.success = str(error), False
        except Exception as error:
            response.message, response.success = f'{error!r}; {DEFECT}', False
        if response.success:
            self._report()
        else:
            self.refuse(response.message)
        return response

    def _start(self) -> str:
        if self._calibrating is not None:
            raise InputError('~/start', 'a calibration under way', 'none', WAIT)
        for kind, subscription in self._inputs.items():
            self._empty(kind, subscription)  # sent before the request, so it belongs to it
        options = self.options()
        if options != self._collected_with:
            self._collector = self._collector.with_options(options)
            self._collected_with = options
        told = set(self._told)
        for problem in self._collector.problems:
            if str(problem) not in told:
                self.refuse(str(problem))
        trials = self._collector.trials
        if not trials:
            lacks = self._collector.incomplete or 'an initial_chain, an action and a goal_chain'
            raise InputError('~/start', 'no complete trial', lacks, 'send it, then call ~/start again')
        self._make_simulator(options).close()  # refuses an engine or a scene that cannot be had
        self._recorder.start(options)
        self._started_by_itself = True  # whoever starts it, it need not start by itself any more
        self._calibrating, self._progress = options, Progress(options.evaluations, len(trials))
        self._state, self._detail = 'calibrating', ''
        self._appraiser.stop()
        self._unappraised = True  # what a calibration without a result leaves open
        self._worker.start(trials, options)
        return f'calibrating on {len(trials)} trial(s), {options.evaluations} evaluations'

    def _stop(self) -> str:
        if self._calibrating is None:
            raise InputError('~/stop', 'no calibration under way', 'one', 'call ~/start first')
        self._worker.stop()
        return 'the search ends now; the best so far will be the result'

    def _reset(self) -> str:
        if self._calibrating is not None:
            raise InputError('~/reset', 'a calibration under way', 'none', WAIT)
        self._recorder.end()
        self._appraiser.stop()
        self._collected_with = self.options()
        self._collector = TrialCollector(self._collected_with)
        self._forget()
        self._begin_session()
        self._show()
        return 'the trials are forgotten'

    def _forget(self) -> None:
        self._state, self._detail, self._last_refusal = 'collecting', '', ''
        self._told: deque[str] = deque(maxlen=KEPT)  # refusals
        self._last_heard = 0.0  # when the last action or goal chain came
        self._started_by_itself = False
        self._reported: dict[str, Any] = {}
        self._found: CalibrationResult | None = None
        self._unseen, self._seen = False, 0.0  # trials that the markers do not show yet; when they were sent
        self._unappraised, self._appraised = False, 0.0  # as the two before, for what trials tell
        self._gain: Gain | None = None  # of the newest trial that was appraised

    # The worker's events

    def _tick(self) -> None:
        try:
            self._hear_best_effort()
            self._take_events()
            self._recorder.tell()
            self._start_by_itself()
            self._appraise()
            self._show_new()
            self._report()
        except Exception as error:  # a callback that raises would end the node
            self._state, self._detail = 'failed', f'{error!r}; {DEFECT}'
            self.get_logger().error(self._detail)
            self._report()

    def _start_by_itself(self) -> None:
        wanted = self.get_parameter('start_after_trials').value
        if self._calibrating is not None or self._started_by_itself \
                or not 0 < wanted <= self._collector.count:
            return
        # A trial may have many goal chains; it is complete when the next one began, or nothing follows.
        if self._collector.count > wanted or time.monotonic() - self._last_heard > QUIET:
            self._started_by_itself = True
            try:
                self.get_logger().info(self._start())
            except InputError as error:
                self._state, self._detail = 'failed', str(error)
                self.refuse(str(error))

    def _take_events(self) -> None:
        for event in self._worker.waiting_events():
            if isinstance(event, Evaluation):
                self._progress.take(event)
            elif isinstance(event, Notice):
                self._detail = event.text
                self._warn(event.text)
            else:
                self._send_progress()
                self._finish(event)
        if time.monotonic() - self._progress_sent >= PROGRESS_PERIOD:
            self._send_progress()

    def _send_progress(self) -> None:
        """Send the newest evaluation, if it was not sent yet."""
        progress = self._progress
        if progress.newest is None or progress.best is None:
            return
        self._send('progress', diagnostics.progress(
            self._types, stamp=self._now(), evaluation=progress.newest, best=progress.best,
            evaluations=progress.evaluations, simulations_per_second=progress.simulations_per_second,
            seconds_left=progress.seconds_left, spread=progress.spread))
        progress.newest, self._progress_sent = None, time.monotonic()

    def _finish(self, event: CalibrationResult | Failure) -> None:
        options, self._calibrating = self._calibrating, None
        self._worker.join()
        if isinstance(event, Failure):
            self._state, self._detail = 'failed', event.text
            self.get_logger().error(f'calibration failed: {event.text}')
            if event.details:
                self.get_logger().error(event.details)
            self._report()
            return
        self._state, self._detail = 'done', event.stop_reason
        found = ', '.join(f'{name} {value:.1f}' for name, value in event.values.items())
        self.get_logger().info(f'calibrated: {found}; score {event.best.score:.1f}, mean error '
                               f'{event.errors.mean * 1e3:.2f} mm; {event.stop_reason}')
        for warning in event.warnings:
            self._warn(warning)
        self._send('result', diagnostics.result(self._types, event, self._now()))
        self._send('dlo_description', self._types.build('std_msgs/msg/String', data=description_document(
            event, None if options is None else options.flat()).decode()))
        if options is not None:
            self._recorder.result(event, options)
        self._found = event
        self._show()
        self._report()

    def _appraise(self) -> None:
        """Take what trials turned out to tell; have new ones appraised, unless a calibration is under way."""
        for gain in self._appraiser.waiting_gains():
            self._gain = gain
        now = time.monotonic()
        quiet = now - self._last_heard > QUIET
        if self._unappraised and self._calibrating is None and self._collector.count \
                and not self._appraiser.alive and (quiet or now - self._appraised > STREAM_PERIOD):
            self._unappraised, self._appraised = not quiet, now
            self._appraiser.start(self._collector.trials, self.options(), self._found, whole=quiet)

    # Messages out

    def _report(self) -> None:
        """Send the status, where it differs from the last one."""
        content: dict[str, Any] = {
            'state': self._state, 'trials': self._collector.count, 'last_refusal': self._last_refusal,
            'incomplete': self._collector.incomplete, 'detail': self._detail, 'gain': self._gain}
        if content != self._reported:
            self._reported = content
            self._send('status', diagnostics.status(self._types, stamp=self._now(), **content))

    def _show_new(self) -> None:
        """Send the markers of trials that came in since the last time, not too often."""
        period = MARKERS_PERIOD + MARKERS_SHARE * self._collector.count
        if self._unseen and self._collector.count and time.monotonic() - self._seen >= period:
            self._show()

    def _show(self) -> None:
        self._unseen, self._seen = False, time.monotonic()
        self._send('markers', markers(self._types, self._collector.trials, stamp=self._now(),
                                      frame_id=self._collector.frame_id, result=self._found))

    def _send(self, name: str, message: Any) -> None:
        octets = serialize_message(message)
        self._record(name, OUTPUT_TYPES[name], octets)  # first: what anybody heard is on the disk
        self._outputs[name].publish(octets)

    def _record(self, name: str, kind: str, octets: bytes) -> None:
        """Record a message under the node's own name for its topic, whatever that is remapped to."""
        self._recorder.message(f'{self.get_fully_qualified_name()}/{name}', kind, octets)

    def _begin_session(self) -> None:
        self._recorder.begin(self.options())
        if self._recorder.folder is not None:
            self.get_logger().info(f'recording to {self._recorder.folder}')

    def _fail_to_record(self, text: str) -> None:
        self._last_refusal = text
        self.get_logger().error(text)
        self._report()

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)
