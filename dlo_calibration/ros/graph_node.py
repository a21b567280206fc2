# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
GraphNode: what the nodes have in common: parameters, topics, a timer, and the interface for a session.

It adapts its subscriptions to what publishers offer, warns of another node with its name, and ends cleanly.
"""

from __future__ import annotations

import functools
import logging
import sys
import time
from typing import Any, Callable, Generic, Iterator, Mapping, Sequence, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from std_srvs.srv import Trigger

from dlo_calibration.calibration.options import Declaration, DeclaredOptions
from dlo_calibration.errors import DEFECT, InputError, printable
from dlo_calibration.messages.codec import rclpy_types
from dlo_calibration.ros.node_session import NO_TEXTS, NodeSession

#: Beginnings of the names of the parameters that rclpy declares itself.
ROS_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')

Chosen = TypeVar('Chosen', bound=DeclaredOptions)


class OptionsNode(Node, Generic[Chosen]):
    """
    A node with the options of a class as parameters.

    :param kind: the class.
    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value.
    """

    def __init__(self, name: str, kind: type[Chosen], **arguments: Any) -> None:
        self._kind = kind
        self._declared: Mapping[str, Declaration] = {
            declaration.name: declaration for declaration in kind.declarations()}
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **arguments)
        try:
            self._declare()
        except BaseException:
            self.destroy_node()
            raise

    def options(self) -> Chosen:
        """Return the options in force."""
        return self._kind.of({name: _plain(self.get_parameter(name).value) for name in self._declared})

    def changed(self, names: Sequence[str], options: Chosen) -> None:
        """
        Do nothing; a subclass may override it to learn which parameters get new values.

        :param options: with the new values.
        :raises InputError: if the subclass refuses them.
        """

    def refuse(self, text: str) -> None:
        """Log why something was refused; a subclass may report it elsewhere, too."""
        self.get_logger().warning(text)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters together, as `rclpy.node.Node` does; a refusal is reported by `refuse`."""
        try:
            self._checked({**self.options().flat(), **{
                p.name: _plain(p.value) for p in parameter_list if not p.name.startswith(ROS_PARAMETERS)}})
        except InputError as error:
            self.refuse(str(error))
            return SetParametersResult(successful=False, reason=str(error))
        return super().set_parameters_atomically(parameter_list)

    def _declare(self) -> None:
        """Declare the parameters; those that the user gave replace what rclpy declared without a range."""
        given = {name: _plain(parameter.value)
                 for name, parameter in self.get_parameters_by_prefix('').items()
                 if not name.startswith(ROS_PARAMETERS)}
        chosen = self._checked(given)
        for name in given:
            self.undeclare_parameter(name)
        for name, value in chosen.flat().items():
            self.declare_parameter(name, NO_TEXTS if value == [] else value,
                                   _descriptor(self._declared[name]), ignore_override=True)
        self.add_pre_set_parameters_callback(self._as_declared)
        self.add_on_set_parameters_callback(self._check)

    def _check(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        new = {p.name: _plain(p.value) for p in parameters if p.name in self._declared}
        try:
            options = self._checked({**self.options().flat(), **new})
            if new:
                self.changed(list(new), options)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _checked(self, flat: Mapping[str, Any]) -> Chosen:
        """Return options; raise InputError for a bad value, or for values that contradict each other."""
        options = self._kind.of(flat)
        options.check_together()
        return options

    def _as_declared(self, parameters: list[Parameter]) -> list[Parameter]:
        """
        Convert parameters to the types of their declarations.

        `ros2 param set` sends an integer for 1, a text for a list of one, and for [] a list of other things.
        """
        return [_in_type_of(self._declared[p.name], p) if p.name in self._declared else p for p in parameters]


def _plain(value: Any) -> Any:
    """Convert a parameter's value for options: an array to a list, NO_TEXTS to an empty list."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return [] if list(value) == NO_TEXTS else list(value)


def _in_type_of(declaration: Declaration, given: Parameter) -> Parameter:
    """Convert a parameter to the type of its declaration, if that does not change its meaning."""
    if isinstance(declaration.default, float) and given.type_ == Parameter.Type.INTEGER:
        return Parameter(given.name, Parameter.Type.DOUBLE, float(given.value))
    if isinstance(declaration.default, tuple) and _plain(given.value) == []:
        return Parameter(given.name, Parameter.Type.STRING_ARRAY, NO_TEXTS)
    if isinstance(declaration.default, tuple) and given.type_ == Parameter.Type.STRING:
        return Parameter(given.name, Parameter.Type.STRING_ARRAY, [given.value])
    return given


def _descriptor(declaration: Declaration) -> ParameterDescriptor:
    """Return the descriptor of an option, for ROS tools."""
    unit = f' [{declaration.unit}]' if declaration.unit else ''
    descriptor = ParameterDescriptor(description=declaration.description + unit)
    if declaration.choices:
        descriptor.additional_constraints = f'one of {", ".join(declaration.choices)}'
    if declaration.minimum is not None and declaration.maximum is not None:
        low, high = declaration.minimum, declaration.maximum
        if isinstance(declaration.default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))]
        else:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return descriptor


LOG = logging.getLogger('dlo_calibration')  # of the rest of the package
TICK = 0.05  # s between two ticks of the session, short enough for its shortest period (progress)
# s for which a thread that calibrates or draws keeps the interpreter's lock.  A callback gives it up twenty
# times, and waits as often: Python's own 0.005 s would make that 0.1 s.
SWITCH = 0.0005
SLICE = 0.02  # s of work between two looks at the queues, which overflow in 0.1 s in a flood
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


class _WarningHandler(logging.Handler):
    """Passes the package's warnings on to the node's log."""

    def __init__(self, warn: Callable[[str], None]) -> None:
        super().__init__()
        self._warn = warn

    def emit(self, record: logging.LogRecord) -> None:
        """Pass one warning on."""
        self._warn(record.getMessage())


class GraphNode(OptionsNode[Chosen]):
    """
    A node that is the `NodeInterface` of its session.

    A subclass makes the session, and says how it takes messages.

    :param kind: the class of its options.
    :param inputs: name of each input topic -> its type.
    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value.
    :cvar queue: how many messages wait on an input topic.
    :cvar latched: inputs that are published latched.
    :ivar reactions: name of an event of a subscription -> what reacts to it, with the input and the event.
    """

    queue = 10
    latched: Sequence[str] = ()

    def __init__(self, name: str, kind: type[Chosen], inputs: Mapping[str, str], **arguments: Any) -> None:
        super().__init__(name, kind, start_parameter_services=False, **arguments)
        self._handler = _WarningHandler(self.warn)
        LOG.addHandler(self._handler)
        self.types = rclpy_types()
        self.classes = {kind: self.types.find(type_name) for kind, type_name in inputs.items()}
        self.inputs: dict[str, Any] = {}  # subscriptions
        self.reactions: dict[str, Callable[[str, Any], None]] = {
            'incompatible_qos': self.on_incompatible_qos}
        self.outputs: dict[str, Any] = {}
        self._incompatible: set[str] = set()  # inputs that a best-effort publisher cannot reach
        self._namesake_seen, self._looked = False, float('-inf')  # when it was looked for last [s]
        self.session: NodeSession[Any] | None = None
        self._closed = False
        # A steady clock: with use_sim_time and no /clock, a timer on the node's own clock would never fire.
        self.create_timer(TICK, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def close(self) -> None:
        """End the session and destroy the node; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        LOG.removeHandler(self._handler)
        try:
            self.end()
        except (InvalidHandle, RuntimeError) as error:  # the context was shut down by somebody else
            self.get_logger().debug(repr(error))
        finally:
            self.destroy_node()

    # What a subclass does

    def end(self) -> None:
        """End the session."""
        if self.session is not None:
            self.session.close()

    def act(self) -> None:
        """Do what is due now; called many times a second."""
        if self.session is not None:
            self.session.tick()

    def take(self, kind: str, octets: bytes, info: Mapping[str, Any]) -> None:
        """Take a message that came, with what rclpy says of it."""
        if self.session is not None:
            self.session.hear(kind, octets)

    def hear_waiting(self) -> None:
        """Take the messages that wait."""
        for kind in self.inputs:
            self.drain(kind)

    def serve(self, name: str, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Answer a request by its name, as the callback of its service."""
        assert self.session is not None
        response.success, response.message = self.session.request(name)
        return response

    def hear(self, kind: str, octets: bytes, info: Mapping[str, Any]) -> None:
        """Take a message, as the callback of its subscription."""
        self.take(kind, octets, info)

    # Reports

    def refuse(self, text: str) -> None:
        """Report a refusal in the log and in ``~/status``."""
        if self.session is None:
            self.warn(text)
        else:
            self.session.refuse(text)

    def fail(self, text: str) -> None:
        """Report a failure in ``~/status`` and in the log."""
        if self.session is None:
            self.error(text)
        else:
            self.session.fail(text)

    # Topics

    def subscription(self, kind: str, reliability: ReliabilityPolicy) -> Any:
        """Subscribe to an input topic; where a publisher offers less, `on_incompatible_qos` is called."""
        durability = DurabilityPolicy.TRANSIENT_LOCAL if kind in self.latched else DurabilityPolicy.VOLATILE
        events = {name: functools.partial(react, kind) for name, react in self.reactions.items()}
        return self.create_subscription(
            self.classes[kind], f'~/{kind}', functools.partial(self.hear, kind),
            QoSProfile(depth=self.queue, reliability=reliability, durability=durability), raw=True,
            event_callbacks=SubscriptionEventCallbacks(**events))

    def drain(self, kind: str) -> None:
        """Take the messages in a subscription's queue."""
        for octets, info in _waiting(self.inputs[kind], SLICE):
            self.take(kind, octets, info)

    def offer(self, name: str, kind: str, *, latched: bool = True) -> None:
        """Create the publisher of an output topic, of a type such as ``std_msgs/msg/String``."""
        self.outputs[name] = self.create_publisher(self.types.find(kind), f'~/{name}',
                                                    LATCHED if latched else QoSProfile(depth=10))

    def serve_parameters(self) -> None:
        """Offer the services of the parameters; called last, as no request is answered before."""
        ParameterService(self)  # its callbacks keep it

    def subscribe(self, *kinds: str) -> None:
        """Subscribe to input topics."""
        for kind in kinds:
            self.inputs[kind] = self.subscription(kind, ReliabilityPolicy.RELIABLE)

    def on_incompatible_qos(self, kind: str, event: Any) -> None:
        """React to a publisher that cannot reach a subscription: subscribe anew, or warn."""
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
            old, new = self.inputs[kind], self.subscription(kind, ReliabilityPolicy.BEST_EFFORT)
            self.drain(kind)
            self.inputs[kind] = new
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
        """Refuse another node of the same name, once; check every second, as it may start later."""
        if time.monotonic() - self._looked < 1.0:
            return
        self._looked = time.monotonic()
        names = self.get_node_names_and_namespaces()
        several = names.count((self.get_name(), self.get_namespace())) > 1
        if several and not self._namesake_seen:
            self.refuse(f'node: another node is named {self.get_fully_qualified_name()}, and hears and '
                        'answers the same; expected one; start one of them with another name, '
                        '--ros-args -r __node:=NAME')
        self._namesake_seen = several

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
        self.outputs[name].publish(octets)

    def info(self, text: str) -> None:
        """Log a text."""
        self.get_logger().info(_lines(text))

    def warn(self, text: str) -> None:
        """Log a warning."""
        self.get_logger().warning(_lines(text))

    def error(self, text: str) -> None:
        """Log an error."""
        self.get_logger().error(_lines(text))


def _waiting(subscription: Any, seconds: float) -> Iterator[tuple[bytes, Mapping[str, Any]]]:
    """Yield the messages in a subscription's queue, each with its info, for some seconds at most."""
    until = time.monotonic() + seconds  # a publisher may be as fast as this loop
    with subscription.handle:
        while time.monotonic() < until \
                and (message := subscription.handle.take_message(subscription.msg_type, True)) is not None:
            yield message


def _lines(text: str) -> str:
    """Return a text whose lines are each safe to show, as some quote what came from outside."""
    return '\n'.join(map(printable, text.split('\n')))
