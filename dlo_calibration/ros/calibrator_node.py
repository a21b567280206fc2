# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The node `calibrator`: subscriptions, publishers, services and a timer around a `CalibrationSession`.

The session makes all decisions.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from dataclasses import replace
import functools
import time
from typing import Any, Mapping, Sequence

import numpy as np
from rclpy.clock import ClockChange, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time
from std_srvs.srv import Trigger

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import INPUT_TYPES, OUTPUT_TYPES, WRENCH
from dlo_calibration.messages.collector import MARGIN
from dlo_calibration.model.pose import NUMBERS, Pose
from dlo_calibration.ros.calibrator_options import CalibratorOptions
from dlo_calibration.ros.graph_node import GraphNode, SLICE
from dlo_calibration.ros.session import CalibrationSession

LIMIT = 64_000_000  # bytes that wait: 100,000 chains of 40 points, and little of the 1 GB of a small robot
OVERHEAD = 200  # bytes of a waiting message, besides its content
PUBLISHERS = 64  # on a topic; those that were silent for longest are forgotten


class Inbox:
    """
    Messages that came and wait to be collected, and requests between them.

    A message was dropped if its publisher's next one has a number beyond the next: the queue below rclpy
    keeps only the newest ones.  Those before its first one are not counted: they may have been sent before
    the node listened.  rclpy hides the publisher; continuing the nearest lower number still gives the right
    total.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[str, bytes | None]] = deque()
        self._size = 0
        self._last: dict[str, list[int]] = defaultdict(list)
        self._dropped: Counter[str] = Counter()

    def __len__(self) -> int:
        """Return how many messages and requests wait."""
        return len(self._waiting)

    def put(self, kind: str, octets: bytes, number: int | None) -> None:
        """Take a message with the `number` that its publisher gave it; None: it gives none."""
        if number is not None:
            self.drop(kind, self._gap(self._last[kind], number))
        size = len(octets) + OVERHEAD
        if self._size + size > LIMIT and self._waiting:
            self.drop(kind, 1)
            return
        self._waiting.append((kind, octets))
        self._size += size

    def put_request(self, name: str) -> None:
        """Take a request that refers to all messages before it."""
        self._waiting.append((name, None))

    def take(self) -> tuple[str, bytes | None]:
        """Return the oldest message, as kind and bytes, or request, as name and None."""
        kind, octets = self._waiting.popleft()
        if octets is not None:
            self._size -= len(octets) + OVERHEAD
        return kind, octets

    @property
    def first(self) -> tuple[str, bytes | None]:
        """The oldest message with the frame of the chains, or request; ('', None) if none waits."""
        return next((item for item in self._waiting if item[0] != WRENCH), ('', None))

    def drop(self, kind: str, count: int) -> None:
        """Count messages that were dropped."""
        if count:
            self._dropped[kind] += count

    def take_dropped(self) -> Counter[str]:
        """Return how many messages of each kind were dropped since the last call."""
        dropped, self._dropped = self._dropped, Counter()
        return dropped

    def numbered(self, kind: str) -> bool:
        """Return whether publishers number the messages of a kind."""
        return bool(self._last[kind])

    def forget_publishers(self, kind: str) -> None:
        """Forget the numbers of a kind, as all of its publishers have gone."""
        self._last[kind].clear()

    @staticmethod
    def _gap(last: list[int], number: int) -> int:
        """Return how many messages are missing before one with this number."""
        before = max((earlier for earlier in last if earlier < number), default=None)
        if before is None:
            before = number - 1  # a publisher that is new
            del last[:len(last) + 1 - PUBLISHERS]
        else:
            last.remove(before)
        last.append(number)
        return number - before - 1


class TableFrame:
    """
    The pose for an option `frame_pose` that is the name of the table's frame.

    It is looked up once, for the frame of the first message: the camera does not move.

    :param node: listens to ``/tf`` and ``/tf_static`` from the first name on.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._buffer: Any = None
        self._listener: Any = None
        self._name: str | None = None
        self.pose: Pose | None = None

    @property
    def missing(self) -> bool:
        """Whether the pose is needed and not known yet."""
        return self._name is not None and self.pose is None

    def choose(self, options: CalibratorOptions) -> None:
        """
        Use the options from now on.

        :raises InputError: if they name a frame, and tf2_ros is not installed.
        """
        if options.table_frame is not None and self._buffer is None:
            try:
                from tf2_ros import Buffer, TransformListener
            except ImportError:
                raise InputError('parameter frame_pose', f'the name {options.table_frame!r}',
                                 f'the numbers {NUMBERS}, as tf2_ros is not installed',
                                 'give the pose, or install tf2_ros (ros-jazzy-tf2-ros-py)') from None
            self._buffer = Buffer()
            self._listener = TransformListener(self._buffer, self._node)
        self._name, self.pose = options.table_frame, None

    def applied(self, options: CalibratorOptions) -> CalibratorOptions:
        """Return the options with the pose in place of the name; none while it is missing."""
        if options.table_frame is None:
            return options
        return replace(options, frame_pose='' if self.pose is None else str(self.pose))

    def look_up(self, frame: str) -> str:
        """Look up where the `frame` of the chains is in the table's; return a sentence about it."""
        from tf2_ros import TransformException

        try:
            transform = self._buffer.lookup_transform(self._name, frame, Time()).transform
        except TransformException as error:
            return (f'parameter frame_pose: no transform from {frame!r} to {self._name!r}; expected one '
                    f'on /tf or /tf_static; messages wait for it: publish it, or set the pose ({error})')
        place, turn = transform.translation, transform.rotation
        self.pose = Pose(np.array([place.x, place.y, place.z]), np.array([turn.x, turn.y, turn.z, turn.w]))
        return f'{frame!r} is at {self.pose} in {self._name!r}, from tf2: that is frame_pose'


ANSWER = 0.1  # s for waiting messages before a request is answered, of 0.2 s for the whole


class CalibratorNode(GraphNode[CalibratorOptions]):
    """
    The node `calibrator`; it is the `NodeInterface` of its session.

    :param make_simulator: builds the engine, in the worker's thread.
    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value.
    """

    queue = 1000  # holds a burst of goal chains while another callback works, and at most 320 MB

    def __init__(self, make_simulator: SimulatorFactory = make_chosen_simulator, **arguments: Any) -> None:
        super().__init__('calibrator', CalibratorOptions, INPUT_TYPES, **arguments)
        self._frame, self._changed = TableFrame(self), False
        try:
            self._frame.choose(super().options())
        except InputError:
            self.destroy_node()
            raise
        for name, kind in OUTPUT_TYPES.items():
            # Progress is not latched: a late subscriber has no use for an old one.
            self.offer(name, kind, latched=name != 'progress')
        self.session: CalibrationSession = CalibrationSession(self, self.types, make_simulator)
        self._inbox = Inbox()
        self._working, self._waited = False, ''
        self._more = self.create_guard_condition(self._work)
        self.reactions.update(message_lost=self._on_message_lost, matched=self._on_matched)
        self.subscribe(*INPUT_TYPES)
        for name in self.session.requests:
            self.create_service(Trigger, f'~/{name}', functools.partial(self.serve, name))
        self._jump: TimeJump | None = None  # of the node's clock, back
        # Without this reference, rclpy never calls back, or crashes.
        self._jumps = self.get_clock().create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-MARGIN)),
            post_callback=self._on_jump)
        self.serve_parameters()
        self.info('collecting trials; call ~/start to calibrate')

    def end(self) -> None:
        """End the session, with all messages that have come."""
        self._jumps.unregister()
        for kind in self.inputs:
            self.drain(kind)
        while len(self._inbox):
            kind, octets = self._inbox.take()
            if octets is not None:
                self.session.keep(kind, octets)
        self.session.drop(self._inbox.take_dropped())
        self.session.close()

    def options(self) -> CalibratorOptions:
        """Return the options in force; the pose of a named frame is looked up."""
        return self._frame.applied(super().options())

    def changed(self, names: Sequence[str], options: CalibratorOptions) -> None:
        """Apply new values before the next message; log that a calibration under way keeps the old ones."""
        if 'frame_pose' in names:
            self._frame.choose(options)
        self._changed = True
        self._more.trigger()  # when they are in force
        if self.session.calibrating:
            self.info(f'{", ".join(names)}: takes effect at the next start')

    # Subscriptions

    def take(self, kind: str, octets: bytes, info: Mapping[str, Any]) -> None:
        """Put a message into the inbox."""
        self._inbox.put(kind, octets, info['publication_sequence_number'])

    def hear(self, kind: str, octets: bytes, info: Mapping[str, Any]) -> None:
        """Take a message and those that wait behind it, and collect them."""
        self._after_jump()
        self.take(kind, octets, info)
        self.drain(kind)
        self._work()

    def _work(self, seconds: float = SLICE) -> None:
        """Collect waiting messages for some seconds; if more are left, call this again soon."""
        if not self._in_frame():
            return
        if self._changed:  # for the next messages
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
        """Number of messages to collect, for the first time or anew."""
        return len(self._inbox) + self.session.collecting.left

    def _in_frame(self) -> bool:
        """Return whether messages can be collected: they wait while the pose of their frame is unknown."""
        if not self._frame.missing:
            return True
        frame = self.session.collecting.collector.frame_id
        if not frame:  # as before the first message
            kind, octets = self._inbox.first
            if octets is None:
                return True
            try:
                frame = self.decode(kind, octets).header.frame_id
            except Exception:  # the session reports why
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
        if not self._inbox.numbered(kind):  # else the numbers give it, and more
            self._inbox.drop(kind, event.total_count_change)

    def _on_matched(self, kind: str, event: Any) -> None:
        if event.current_count == 0:
            self.drain(kind)
            self._inbox.forget_publishers(kind)
            self._more.trigger()

    # Services and the clock

    def serve(self, name: str, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Answer a request; one that follows messages waits for them."""
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
        """Begin another session if the clock went back; not in the callback, which runs inside the clock."""
        if self._jump is not None:
            jump, self._jump, now = self._jump, None, self.stamp()
            self.session.clock_went_back(now - jump.delta.nanoseconds, now)

    def hear_waiting(self) -> None:
        """Collect the messages that wait, for at most the time that an answer may take."""
        if self._working:
            return
        for kind in self.inputs:
            self.drain(kind)
        self._work(ANSWER)
