# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The node: subscriptions, publishers, services and a timer around a `CalibrationSession`.

The session makes all decisions, except one: the node adapts its subscriptions to what publishers offer.
"""

from __future__ import annotations

import functools
import logging
import sys
import time
from typing import Any, Callable, Mapping, Sequence

import rclpy
from rclpy.clock import Clock, ClockChange, ClockType, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from std_srvs.srv import Trigger

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import DEFECT, InputError, printable
from dlo_calibration.files.intake import OUTPUT_TYPES
from dlo_calibration.messages.codec import INPUT_TYPES, rclpy_types
from dlo_calibration.messages.stamp_order import MARGIN
from dlo_calibration.ros.inbox import Inbox
from dlo_calibration.ros.parameters import OptionsNode
from dlo_calibration.ros.session import CalibrationSession
from dlo_calibration.ros.situation import Pace

LOG = logging.getLogger('dlo_calibration')  # where the rest of the package logs its notices
ANSWER = 0.1  # s for waiting messages before a request is answered, of 0.2 s for the whole
SLICE = 0.02  # s of collecting between two looks at the queues, which overflow in 0.1 s in a flood
TICK = 0.05  # s between two ticks of the session, short enough for its shortest period (progress)


def spin(args: Sequence[str], should_stop: Callable[[], bool],
         make_simulator: SimulatorFactory = make_chosen_simulator) -> int:
    """
    Run the node until `should_stop` returns true; the caller handles the signals.

    :param args: command line without the program's name.
    :returns: exit code: 0; 2, with one line on stderr, if an argument or a parameter cannot be used.
    """
    node, executor = None, None
    try:
        unknown = remove_ros_args(['calibrator', *args])[1:]
        if unknown:
            raise InputError('command line', ' '.join(unknown), 'only --ros-args ...',
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
    # rclpy raises the last two for a bad command line, and has no public names for them.
    except (InputError, rclpy_implementation.RCLError, rclpy_implementation.UnknownROSArgsError) as error:
        sys.stderr.write(f'calibrator: {printable(" ".join(str(error).split()))}\n')
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
        """Pass one notice on."""
        self._tell(record.getMessage())


class CalibratorNode(OptionsNode[Options]):
    """
    The node `calibrator`; it is the `Graph` of its session.

    :param make_simulator: builds the engine, in the worker's thread.
    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value.
    """

    def __init__(self, make_simulator: SimulatorFactory = make_chosen_simulator, **arguments: Any) -> None:
        super().__init__('calibrator', Options, **arguments)
        self._notices = _Notices(self.warn)
        LOG.addHandler(self._notices)
        types = rclpy_types()
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        # Progress is not latched: a late subscriber has no use for an old one.
        self._outputs = {name: self.create_publisher(types.find(kind), f'~/{name}',
                                                     QoSProfile(depth=10) if name == 'progress' else latched)
                         for name, kind in OUTPUT_TYPES.items()}
        self._input_classes = {kind: types.find(name) for kind, name in INPUT_TYPES.items()}
        self.session = CalibrationSession(self, types, make_simulator)
        self._inbox = Inbox()
        self._working = False
        self._namesakes = Pace()  # wanted: one is there, and was told
        self._more = self.create_guard_condition(self._work)
        self._closed = False
        self._incompatible: set[str] = set()  # inputs that a best-effort publisher cannot reach
        self._inputs = {kind: self._subscribe(kind, ReliabilityPolicy.RELIABLE) for kind in INPUT_TYPES}
        for name in ('start', 'stop', 'reset'):
            self.create_service(Trigger, f'~/{name}', functools.partial(self._serve, name))
        # A steady clock: with use_sim_time and no /clock, a timer on the node's own clock would never fire.
        self.create_timer(TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._jump: TimeJump | None = None  # of the node's clock, back
        # rclpy calls nobody, or crashes, where this is not kept.
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-MARGIN)),
            post_callback=self._on_jump)
        self.info('collecting trials; call ~/start to calibrate')

    def close(self) -> None:
        """End the session and destroy the node; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        self._jumps.unregister()
        LOG.removeHandler(self._notices)
        try:
            for kind, subscription in self._inputs.items():
                self._drain(kind, subscription)
            while len(self._inbox):
                kind, octets = self._inbox.take()
                if octets is not None:
                    self.session.keep(kind, octets)
            self.session.drop(self._inbox.take_dropped())
            self.session.close()
        except (InvalidHandle, RuntimeError) as error:  # the context was shut down by somebody else
            self.get_logger().debug(repr(error))
        finally:
            self.destroy_node()

    def changed(self, names: Sequence[str]) -> None:
        """Log that new values have to wait, if a calibration is under way."""
        if self.session.calibrating:
            self.info(f'{", ".join(names)}: takes effect at the next start')

    def refuse(self, text: str) -> None:
        """Tell why something was refused, in the log and in ``~/status``."""
        self.session.refuse(text)

    # Subscriptions

    def _subscribe(self, kind: str, reliability: ReliabilityPolicy) -> Any:
        # The queue holds a burst of goal chains while another callback works, and at most 320 MB.
        return self.create_subscription(
            self._input_classes[kind], f'~/{kind}', functools.partial(self._hear, kind),
            QoSProfile(depth=1000, reliability=reliability), raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=functools.partial(self._on_incompatible_qos, kind),
                message_lost=functools.partial(self._on_message_lost, kind),
                matched=functools.partial(self._on_matched, kind)))

    def _hear(self, kind: str, octets: bytes, info: Mapping[str, Any]) -> None:
        self._after_jump()
        self._inbox.put(kind, octets, info['publication_sequence_number'])
        self._drain(kind, self._inputs[kind])
        self._work()

    def _work(self, seconds: float = SLICE) -> None:
        """Collect waiting messages for some time, and see to it that the others are collected soon."""
        self._working = True
        until = time.monotonic() + seconds
        try:
            while len(self._inbox) and time.monotonic() < until:
                kind, octets = self._inbox.take()
                if octets is None:
                    done, answer = self.session.request(kind)
                    if done:
                        self.info(answer)
                else:
                    self.session.hear(kind, octets, flush=False)
        finally:
            self._working = False
            self.session.flush()
        self.session.behind = len(self._inbox) > 0
        if self.session.behind:
            self._more.trigger()

    def _on_message_lost(self, kind: str, event: Any) -> None:
        if not self._inbox.numbered(kind):  # else the numbers tell it, and more
            self._inbox.drop(kind, event.total_count_change)

    def _on_matched(self, kind: str, event: Any) -> None:
        if event.current_count == 0:
            self._drain(kind, self._inputs[kind])
            self._inbox.forget_publishers(kind)
            self._more.trigger()

    def _on_incompatible_qos(self, kind: str, event: Any) -> None:
        if event.last_policy_kind == QoSPolicyKind.RELIABILITY:
            self._incompatible.add(kind)  # replaced at the next tick, as its own callback cannot destroy it
        else:
            self.warn(f'{kind}: no messages arrive from a publisher whose quality of service does not match; '
                      'publish with reliable or best-effort reliability and default deadlines')

    def _subscribe_best_effort(self) -> None:
        """Subscribe with best effort where a reliable subscription cannot reach a publisher."""
        while self._incompatible:
            kind = self._incompatible.pop()
            old = self._inputs[kind]
            self._inputs[kind] = self._subscribe(kind, ReliabilityPolicy.BEST_EFFORT)
            self._drain(kind, old)
            self.destroy_subscription(old)
            self.info(f'{kind}: a publisher offers best effort only, so the node subscribes with best effort')

    def _drain(self, kind: str, subscription: Any) -> None:
        """Put the messages in a subscription's queue into the inbox."""
        until = time.monotonic() + SLICE  # a publisher may be as fast as this loop
        with subscription.handle:
            while time.monotonic() < until \
                    and (taken := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                self._inbox.put(kind, taken[0], taken[1]['publication_sequence_number'])

    # Services, the timer and the clock

    def _serve(self, name: str, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.hear_waiting()
        if name == 'stop' or not len(self._inbox):
            response.success, response.message = self.session.request(name)
        else:
            response.success, response.message = True, \
                f'{len(self._inbox)} messages came before; {name} follows when they are read'
            self._inbox.put_request(name)
        return response

    def _tick(self) -> None:
        try:
            self._after_jump()
            self._subscribe_best_effort()
            self.session.drop(self._inbox.take_dropped())
            self._look_for_namesakes()
            self.session.tick()
        except Exception as error:  # a callback that raises would end the node
            self.session.fail(f'{error!r}; {DEFECT}')

    def _look_for_namesakes(self) -> None:
        """Tell, once, that another node has the same name; look once a second, as it may come later."""
        if time.monotonic() - self._namesakes.last < 1.0:
            return
        self._namesakes.last = time.monotonic()
        names = self.get_node_names_and_namespaces()
        several = names.count((self.get_name(), self.get_namespace())) > 1
        if several and not self._namesakes.wanted:
            self.refuse(f'node: got another node named {self.get_fully_qualified_name()}, which hears and '
                        'answers the same, expected one; start one of them with another name, '
                        '--ros-args -r __node:=NAME')
        self._namesakes.wanted = several

    def _on_jump(self, jump: TimeJump) -> None:
        if jump.clock_change == ClockChange.ROS_TIME_NO_CHANGE:
            self._jump = jump

    def _after_jump(self) -> None:
        """Begin another session if the node's clock went back; not in the callback, inside the clock."""
        if self._jump is not None:
            jump, self._jump, now = self._jump, None, self.stamp()
            self.session.clock_went_back(now - jump.delta.nanoseconds, now)

    # The graph of the session

    def stamp(self) -> int:
        """Return the time for the header of a message [ns]."""
        return int(self.get_clock().now().nanoseconds)

    def topic(self, name: str) -> str:
        """Return the full name of one of the node's topics, before any remapping."""
        return f'{self.get_fully_qualified_name()}/{name}'

    def decode(self, kind: str, octets: bytes) -> Any:
        """Return the message that came on an input topic."""
        return deserialize_message(octets, self._input_classes[kind])

    def encode(self, name: str, message: Any) -> bytes:
        """Return the bytes of a message for an output topic."""
        return serialize_message(message)

    def publish(self, name: str, octets: bytes) -> None:
        """Publish bytes on an output topic."""
        self._outputs[name].publish(octets)

    def hear_waiting(self) -> None:
        """Pass on the messages that wait, as far as that takes less than the time for an answer."""
        if self._working:
            return
        for kind, subscription in self._inputs.items():
            self._drain(kind, subscription)
        self._work(ANSWER)

    def info(self, text: str) -> None:
        """Log a text."""
        self.get_logger().info(_lines(text))

    def warn(self, text: str) -> None:
        """Log a warning."""
        self.get_logger().warning(_lines(text))

    def error(self, text: str) -> None:
        """Log an error."""
        self.get_logger().error(_lines(text))


def _lines(text: str) -> str:
    """Return the lines of a text, each printable: what came from outside stands in some of them."""
    return '\n'.join(map(printable, text.split('\n')))
