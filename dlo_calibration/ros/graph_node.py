# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
GraphNode: a ROS node that is the `Graph` of a session; what the package's nodes have in common.

It adapts its subscriptions to what publishers offer, tells of namesakes, and ends cleanly.
"""

from __future__ import annotations

import logging
import sys
import time
from typing import Any, Callable, Iterator, Mapping, Sequence

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.parameter_service import ParameterService
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from dlo_calibration.errors import DEFECT, InputError, printable
from dlo_calibration.messages.codec import rclpy_types
from dlo_calibration.ros.parameters import Chosen, OptionsNode
from dlo_calibration.ros.situation import Pace

LOG = logging.getLogger('dlo_calibration')  # where the rest of the package logs its notices
TICK = 0.05  # s between two ticks of the session, short enough for its shortest period (progress)
# s for which a thread that calibrates or draws keeps the interpreter's lock.  A callback gives it up twenty
# times, and waits as often: Python's own 0.005 s would make that 0.1 s.
SWITCH = 0.0005
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def spin(program: str, make_node: Callable[[], GraphNode[Any]], args: Sequence[str],
         should_stop: Callable[[], bool]) -> int:
    """
    Run a node until `should_stop` returns true; the caller handles the signals.

    :param program: its name in errors.
    :param make_node: called when ROS is initialised.
    :param args: command line without the program's name.
    :returns: exit code: 0; 2, with one line on stderr, if an argument or a parameter cannot be used.
    """
    node, executor = None, None
    try:
        unknown = remove_ros_args([program, *args])[1:]
        if unknown:
            raise InputError('command line', ' '.join(unknown), 'only --ros-args ...',
                             'set a parameter with --ros-args -p NAME:=VALUE')
        if should_stop():
            return 0
        rclpy.init(args=list(args), signal_handler_options=SignalHandlerOptions.NO)
        node = make_node()
        sys.setswitchinterval(SWITCH)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not should_stop() and rclpy.ok():
            executor.spin_once(timeout_sec=TICK)
    except ExternalShutdownException:
        pass
    # rclpy raises the last two for a bad command line, and has no public names for them.
    except (InputError, rclpy_implementation.RCLError, rclpy_implementation.UnknownROSArgsError) as error:
        sys.stderr.write(f'{program}: {printable(" ".join(str(error).split()))}\n')
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


class GraphNode(OptionsNode[Chosen]):
    """
    A node that is the `Graph` of its session; a subclass makes the session, and says how it hears messages.

    :param kind: the class of its options.
    :param inputs: name of each input topic -> its type.
    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value.
    """

    def __init__(self, name: str, kind: type[Chosen], inputs: Mapping[str, str], **arguments: Any) -> None:
        super().__init__(name, kind, start_parameter_services=False, **arguments)
        self._notices = _Notices(self.warn)
        LOG.addHandler(self._notices)
        self.types = rclpy_types()
        self.classes = {kind: self.types.find(one) for kind, one in inputs.items()}
        self.inputs: dict[str, Any] = {}  # subscriptions
        self._outputs: dict[str, Any] = {}
        self._incompatible: set[str] = set()  # inputs that a best-effort publisher cannot reach
        self._namesakes = Pace()  # wanted: one is there, and was told
        self._closed = False
        # A steady clock: with use_sim_time and no /clock, a timer on the node's own clock would never fire.
        self.create_timer(TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def close(self) -> None:
        """End the session and destroy the node; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        LOG.removeHandler(self._notices)
        try:
            self.end()
        except (InvalidHandle, RuntimeError) as error:  # the context was shut down by somebody else
            self.get_logger().debug(repr(error))
        finally:
            self.destroy_node()

    # What a subclass does

    def end(self) -> None:
        """End the session."""
        raise NotImplementedError

    def act(self) -> None:
        """Do what is due now; called many times a second."""
        raise NotImplementedError

    def fail(self, text: str) -> None:
        """Report a failure."""
        raise NotImplementedError

    def subscription(self, kind: str, reliability: ReliabilityPolicy) -> Any:
        """Subscribe to an input topic; where a publisher offers less, `on_incompatible_qos` is called."""
        raise NotImplementedError

    def drain(self, kind: str, subscription: Any) -> None:
        """Take the messages in a subscription's queue."""
        raise NotImplementedError

    # Topics

    def offer(self, name: str, kind: str, *, latched: bool = True) -> None:
        """Create the publisher of an output topic, of a type such as ``std_msgs/msg/String``."""
        self._outputs[name] = self.create_publisher(self.types.find(kind), f'~/{name}',
                                                    LATCHED if latched else QoSProfile(depth=10))

    def serve_parameters(self) -> None:
        """Offer the services of the parameters: at last, as nobody answers them while the node is made."""
        ParameterService(self)  # its callbacks keep it

    def subscribe(self, *kinds: str) -> None:
        """Subscribe to input topics."""
        for kind in kinds:
            self.inputs[kind] = self.subscription(kind, ReliabilityPolicy.RELIABLE)

    def on_incompatible_qos(self, kind: str, event: Any) -> None:
        """Note, or tell, that a publisher cannot reach a subscription."""
        if event.last_policy_kind == QoSPolicyKind.RELIABILITY:
            self._incompatible.add(kind)  # replaced at the next tick, as its own callback cannot destroy it
        elif event.last_policy_kind == QoSPolicyKind.DURABILITY:
            self.warn(f'{kind}: no messages arrive from a publisher that does not latch them; publish with '
                      'durability transient local')
        else:
            self.warn(f'{kind}: no messages arrive from a publisher whose quality of service does not match; '
                      'publish with reliable or best-effort reliability and default deadlines')

    def _subscribe_best_effort(self) -> None:
        """Subscribe with best effort where a reliable subscription cannot reach a publisher."""
        while self._incompatible:
            kind = self._incompatible.pop()
            old = self.inputs[kind]
            self.inputs[kind] = self.subscription(kind, ReliabilityPolicy.BEST_EFFORT)
            self.drain(kind, old)
            self.destroy_subscription(old)
            self.info(f'{kind}: a publisher offers best effort only, so the node subscribes with best effort')

    # The timer

    def _tick(self) -> None:
        try:
            self._subscribe_best_effort()
            self._look_for_namesakes()
            self.act()
        except Exception as error:  # a callback that raises would end the node
            self.fail(f'{error!r}; {DEFECT}')

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

    # The graph of the session

    def stamp(self) -> int:
        """Return the time for the header of a message [ns]."""
        return int(self.get_clock().now().nanoseconds)

    def topic(self, name: str) -> str:
        """Return the full name of one of the node's topics, before any remapping."""
        return f'{self.get_fully_qualified_name()}/{name}'

    def decode(self, kind: str, octets: bytes) -> Any:
        """Return the message that came on an input topic."""
        return deserialize_message(octets, self.classes[kind])

    def encode(self, name: str, message: Any) -> bytes:
        """Return the bytes of a message for an output topic."""
        return serialize_message(message)

    def publish(self, name: str, octets: bytes) -> None:
        """Publish bytes on an output topic."""
        self._outputs[name].publish(octets)

    def info(self, text: str) -> None:
        """Log a text."""
        self.get_logger().info(_lines(text))

    def warn(self, text: str) -> None:
        """Log a warning."""
        self.get_logger().warning(_lines(text))

    def error(self, text: str) -> None:
        """Log an error."""
        self.get_logger().error(_lines(text))


def waiting(subscription: Any, seconds: float) -> Iterator[tuple[bytes, Mapping[str, Any]]]:
    """Take the messages in a subscription's queue, with what is known of each, for some time at most."""
    until = time.monotonic() + seconds  # a publisher may be as fast as this loop
    with subscription.handle:
        while time.monotonic() < until \
                and (taken := subscription.handle.take_message(subscription.msg_type, True)) is not None:
            yield taken


def _lines(text: str) -> str:
    """Return the lines of a text, each printable: what came from outside stands in some of them."""
    return '\n'.join(map(printable, text.split('\n')))
