# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The node `calibrator`: subscriptions, publishers, services and a timer around a `CalibrationSession`.

The session makes all decisions.
"""

from __future__ import annotations

import functools
import time
from typing import Any, Callable, Mapping, Sequence

from rclpy.clock import ClockChange, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.files.intake import OUTPUT_TYPES
from dlo_calibration.messages.codec import INPUT_TYPES
from dlo_calibration.messages.stamp_order import MARGIN
from dlo_calibration.ros import graph_node
from dlo_calibration.ros.graph_node import GraphNode, waiting
from dlo_calibration.ros.inbox import Inbox
from dlo_calibration.ros.session import CalibrationSession
from dlo_calibration.ros.table_frame import TableFrame

ANSWER = 0.1  # s for waiting messages before a request is answered, of 0.2 s for the whole
SLICE = 0.02  # s of collecting between two looks at the queues, which overflow in 0.1 s in a flood


def spin(args: Sequence[str], should_stop: Callable[[], bool],
         make_simulator: SimulatorFactory = make_chosen_simulator) -> int:
    """
    Run the node until `should_stop` returns true; the caller handles the signals.

    :param args: command line without the program's name.
    :returns: exit code: 0; 2, with one line on stderr, if an argument or a parameter cannot be used.
    """
    return graph_node.spin('calibrator', lambda: CalibratorNode(make_simulator), args, should_stop)


class CalibratorNode(GraphNode[Options]):
    """
    The node `calibrator`; it is the `Graph` of its session.

    :param make_simulator: builds the engine, in the worker's thread.
    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value.
    """

    def __init__(self, make_simulator: SimulatorFactory = make_chosen_simulator, **arguments: Any) -> None:
        super().__init__('calibrator', Options, INPUT_TYPES, **arguments)
        self._frame, self._changed = TableFrame(self), False
        try:
            self._frame.choose(super().options())
        except InputError:
            self.destroy_node()
            raise
        for name, kind in OUTPUT_TYPES.items():
            # Progress is not latched: a late subscriber has no use for an old one.
            self.offer(name, kind, latched=name != 'progress')
        self.session = CalibrationSession(self, self.types, make_simulator)
        self._inbox = Inbox()
        self._working, self._waited = False, ''
        self._more = self.create_guard_condition(self._work)
        self.subscribe(*INPUT_TYPES)
        for name in ('start', 'stop', 'reset', 'discard_last'):
            self.create_service(Trigger, f'~/{name}', functools.partial(self._serve, name))
        self._jump: TimeJump | None = None  # of the node's clock, back
        # rclpy calls nobody, or crashes, where this is not kept.
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-MARGIN)),
            post_callback=self._on_jump)
        self.serve_parameters()
        self.info('collecting trials; call ~/start to calibrate')

    def end(self) -> None:
        """End the session, with all messages that have come."""
        self._jumps.unregister()
        for kind, subscription in self.inputs.items():
            self.drain(kind, subscription)
        while len(self._inbox):
            kind, octets = self._inbox.take()
            if octets is not None:
                self.session.keep(kind, octets)
        self.session.drop(self._inbox.take_dropped())
        self.session.close()

    def options(self) -> Options:
        """Return the options in force; the pose of a named frame is looked up."""
        return self._frame.applied(super().options())

    def changed(self, names: Sequence[str], options: Options) -> None:
        """Log that new values have to wait, if a calibration is under way; take note of a named frame."""
        if 'frame_pose' in names:
            self._frame.choose(options)
        self._changed = True
        self._more.trigger()  # when they are in force
        if self.session.calibrating:
            self.info(f'{", ".join(names)}: takes effect at the next start')

    def refuse(self, text: str) -> None:
        """Tell why something was refused, in the log and in ``~/status``."""
        self.session.refuse(text)

    def fail(self, text: str) -> None:
        """Report a failure in ``~/status`` and in the log."""
        self.session.fail(text)

    # Subscriptions

    def subscription(self, kind: str, reliability: ReliabilityPolicy) -> Any:
        """Subscribe to an input topic."""
        # The queue holds a burst of goal chains while another callback works, and at most 320 MB.
        return self.create_subscription(
            self.classes[kind], f'~/{kind}', functools.partial(self._hear, kind),
            QoSProfile(depth=1000, reliability=reliability), raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=functools.partial(self.on_incompatible_qos, kind),
                message_lost=functools.partial(self._on_message_lost, kind),
                matched=functools.partial(self._on_matched, kind)))

    def _hear(self, kind: str, octets: bytes, info: Mapping[str, Any]) -> None:
        self._after_jump()
        self._inbox.put(kind, octets, info['publication_sequence_number'])
        self.drain(kind, self.inputs[kind])
        self._work()

    def _work(self, seconds: float = SLICE) -> None:
        """Collect waiting messages for some time, and see to it that the others are collected soon."""
        if not self._in_frame():
            return
        if self._changed:  # what comes next is judged with the new values
            self._changed = False
            self.session.change_options()
        self._working = True
        until = time.monotonic() + seconds
        try:
            while self._waiting and time.monotonic() < until:
                if self.session.collecting.left:
                    self.session.collect_anew()
                    continue
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
        self.session.behind = self._waiting > 0
        if self.session.behind:
            self._more.trigger()

    @property
    def _waiting(self) -> int:
        """How many messages wait to be collected, for the first time or anew."""
        return len(self._inbox) + self.session.collecting.left

    def _in_frame(self) -> bool:
        """Tell whether messages can be used: they wait while the pose of their frame is missing."""
        if not self._frame.missing:
            return True
        frame = self.session.collecting.collector.frame_id
        if not frame:  # as before the first message
            kind, octets = self._inbox.first
            if octets is None:
                return True
            try:
                frame = self.decode(kind, octets).header.frame_id
            except Exception:  # the session tells why
                return True
        words = self._frame.look_up(frame)
        if self._frame.missing:
            if words != self._waited:
                self.refuse(words)
            self._waited = words
            return False
        self.info(words)
        self._changed = True
        return True

    def _on_message_lost(self, kind: str, event: Any) -> None:
        if not self._inbox.numbered(kind):  # else the numbers tell it, and more
            self._inbox.drop(kind, event.total_count_change)

    def _on_matched(self, kind: str, event: Any) -> None:
        if event.current_count == 0:
            self.drain(kind, self.inputs[kind])
            self._inbox.forget_publishers(kind)
            self._more.trigger()

    def drain(self, kind: str, subscription: Any) -> None:
        """Put the messages in a subscription's queue into the inbox."""
        for octets, info in waiting(subscription, SLICE):
            self._inbox.put(kind, octets, info['publication_sequence_number'])

    # Services and the clock

    def _serve(self, name: str, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.hear_waiting()
        count, ready = self._waiting, self._in_frame()
        if name == 'stop' or ready and not count:
            response.success, response.message = self.session.request(name)
        else:
            why = f'{count} messages came before' if count else 'no pose of their frame came yet'
            response.success, response.message = True, f'{why}; {name} follows when they are read'
            self._inbox.put_request(name)
        return response

    def act(self) -> None:
        """Do what is due now."""
        self._after_jump()
        if self._frame.missing:
            self._work()
        self.session.drop(self._inbox.take_dropped())
        self.session.tick()

    def _on_jump(self, jump: TimeJump) -> None:
        if jump.clock_change == ClockChange.ROS_TIME_NO_CHANGE:
            self._jump = jump

    def _after_jump(self) -> None:
        """Begin another session if the node's clock went back; not in the callback, inside the clock."""
        if self._jump is not None:
            jump, self._jump, now = self._jump, None, self.stamp()
            self.session.clock_went_back(now - jump.delta.nanoseconds, now)

    def hear_waiting(self) -> None:
        """Pass on the messages that wait, as far as that takes less than the time for an answer."""
        if self._working:
            return
        for kind, subscription in self.inputs.items():
            self.drain(kind, subscription)
        self._work(ANSWER)
