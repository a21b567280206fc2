# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""CaptureGraph: the ROS graph for the capture page: images of topics, and trials for a calibrator."""

from __future__ import annotations

from dataclasses import replace
import json
import re
import threading
import time
from typing import Any, Callable, Sequence

from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import built, INPUT_TYPES, NANOSECONDS, OUTPUT_TYPES, rclpy_types
from dlo_calibration.messages.encoder import trial_messages
from dlo_calibration.model.trial import Trial
from dlo_calibration.page.graph import TopicImage
from dlo_calibration.vision.photograph import decoded

IMAGE, COMPRESSED, INFO = (f'sensor_msgs/msg/{name}' for name in ('Image', 'CompressedImage', 'CameraInfo'))
DISCOVERY = 1.0  # s from joining the graph until its topics are known
PATIENCE = 5.0  # s for an image, a calibrator, or its answer
FRAME = 'world'


class CaptureGraph:
    """Takes part in the ROS graph from the first use on; its methods may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._context: Any = None
        self._node: Any = None
        self._executor: Any = None
        self._latest = 0  # stamp of the newest message that was sent [ns]

    def topics(self) -> list[dict[str, str]]:
        """Return name and type of each topic with images."""
        with self._lock:
            self._join()
            return [{'name': name, 'type': kind} for name, kind in sorted(self._kinds().items())
                    if kind in (IMAGE, COMPRESSED)]

    def image(self, topic: str) -> TopicImage:
        """
        Return the newest image of a topic, and the lens from the camera's CameraInfo.

        :raises InputError: if none comes.
        """
        with self._lock:
            self._join()
            kinds = self._kinds()
            if kinds.get(topic) not in (IMAGE, COMPRESSED):
                raise InputError(f'topic {topic}', kinds.get(topic, 'no such topic'), 'a topic with images',
                                 'choose one of the list')
            # Compressed images are one level below the raw ones (image_transport).
            camera, _, image = topic.removesuffix('/compressed').rpartition('/')
            about = f'{camera}/camera_info'
            wanted = [topic, about] if kinds.get(about) == INFO else [topic]
            heard = self._heard({name: kinds[name] for name in wanted})
        if topic not in heard:
            raise InputError(f'topic {topic}', f'no image within {PATIENCE:.0f} s', 'a camera that publishes',
                             'check that it does, and with which quality of service')
        message = heard[topic]
        picture = bytes(message.data) if kinds[topic] == COMPRESSED else decoded(f'image on {topic}', message)
        return TopicImage(picture, _lens(heard.get(about), 'rect' in image))

    def send(self, trials: Sequence[Trial], namespace: str) -> str:
        """
        Send trials to a calibrator; return how many it has then, and what it refused.

        :param namespace: the full name of its node.
        :raises InputError: if no calibrator listens there.
        """
        name = '/' + namespace.strip('/')
        if not re.fullmatch(r'(/[A-Za-z_][A-Za-z0-9_]*)+', name):
            raise InputError('namespace', repr(namespace), 'the full name of a node, e.g. /calibrator',
                             'correct it')
        with self._lock:
            self._join()
            return self._send(trials, name)

    def close(self) -> None:
        """Leave the graph."""
        with self._lock:
            if self._context is not None:
                self._executor.shutdown(timeout_sec=0)
                self._node.destroy_node()
                self._context.try_shutdown()
                self._context = None

    def _join(self) -> None:
        """Join the graph, unless the page takes part in it already."""
        if self._context is not None:
            return
        try:
            import rclpy
            from rclpy.context import Context
            from rclpy.executors import SingleThreadedExecutor
            from rclpy.node import Node
            from rclpy.signals import SignalHandlerOptions

            context = Context()
            rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
            self._node = Node('dlo_capture', context=context, enable_rosout=False,
                              start_parameter_services=False)
            self._executor = SingleThreadedExecutor(context=context)
        except Exception as error:  # parts of ROS may be missing, or its settings wrong
            raise InputError('ROS', f'{type(error).__name__}: {error}', 'an installation that works',
                             'source it, and start the page again') from error
        self._executor.add_node(self._node)
        self._context = context
        self._spin(lambda: False, DISCOVERY)

    def _kinds(self) -> dict[str, str]:
        """Return the type of each topic."""
        return {name: kinds[0] for name, kinds in self._node.get_topic_names_and_types() if len(kinds) == 1}

    def _spin(self, ready: Callable[[], bool], patience: float) -> bool:
        """Take part until `ready`, for at most `patience` [s]; return whether it is."""
        until = time.monotonic() + patience
        while not ready() and time.monotonic() < until:
            self._executor.spin_once(timeout_sec=0.02)
        return ready()

    def _heard(self, topics: dict[str, str]) -> dict[str, Any]:
        """Return the first message of each topic, given with its type, that comes in time."""
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        heard: dict[str, Any] = {}
        find = rclpy_types().find
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # any publisher can reach it
        subscriptions = [self._node.create_subscription(
            find(kind), name, lambda message, name=name: heard.setdefault(name, message), qos)
            for name, kind in topics.items()]
        try:
            self._spin(lambda: len(heard) == len(topics), PATIENCE)
        finally:
            for subscription in subscriptions:
                self._node.destroy_subscription(subscription)
        return heard

    def _send(self, trials: Sequence[Trial], name: str) -> str:
        from rclpy.qos import DurabilityPolicy, QoSProfile

        types = rclpy_types()
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        heard: list[Any] = []
        status = self._node.create_subscription(types.find(OUTPUT_TYPES['status']), f'{name}/status',
                                                heard.append, latched)
        publishers = {
            kind: self._node.create_publisher(types.find(type_name), f'{name}/{kind}', QoSProfile(depth=1000))
            for kind, type_name in INPUT_TYPES.items()}
        try:
            if not self._spin(lambda: bool(heard) and all(
                    publisher.get_subscription_count() for publisher in publishers.values()), PATIENCE):
                raise InputError(f'node {name}', 'no calibrator that listens', 'one that is running',
                                 'start it with: ros2 run dlo_calibration calibrator')
            before = int(_value(heard[-1], 'trials') or 0)
            for message in self._stamped(trials):
                publishers[message.kind].publish(built(types, message))
            self._spin(lambda: int(_value(heard[-1], 'trials') or 0) >= before + len(trials), PATIENCE)
            count, refusal = int(_value(heard[-1], 'trials') or 0), _value(heard[-1], 'last_refusal')
        finally:
            self._node.destroy_subscription(status)
            for publisher in publishers.values():
                self._node.destroy_publisher(publisher)
        text = f'sent {len(trials)}: {name} had {before} trials, and has {count} now'
        return text if count >= before + len(trials) or not refusal else f'{text}; it refused: {refusal}'

    def _stamped(self, trials: Sequence[Trial]) -> list[Any]:
        """Return the messages of trials, stamped later than all sent before, so that trials do not mix."""
        messages = trial_messages(trials, FRAME)
        later = max(time.time_ns(), self._latest + NANOSECONDS) - messages[0].stamp
        stamped = [replace(message, stamp=message.stamp + later) for message in messages]
        self._latest = stamped[-1].stamp
        return stamped


def _value(message: Any, key: str) -> str:
    """Return a value of the first status of a message; empty if there is none."""
    return str(next((pair.value for pair in message.status[0].values if pair.key == key), ''))


def _lens(info: Any, rectified: bool) -> bytes | None:
    """
    Return a ROS camera calibration file from a CameraInfo; None if the camera is not calibrated.

    :param rectified: the image is free of distortion; then the projection matrix holds (image_proc).
    """
    if info is None or not info.k[0] > 0 or (rectified and not info.p[0] > 0):
        return None
    values = [info.p[k] for k in (0, 1, 2, 4, 5, 6, 8, 9, 10)] if rectified else info.k
    matrix = [float(value) for value in values]
    distortion = [0.0] * 5 if rectified or not len(info.d) else [float(x) for x in info.d]
    return json.dumps({  # JSON is YAML, too
        'image_width': int(info.width), 'image_height': int(info.height), 'camera_name': 'camera',
        'camera_matrix': {'rows': 3, 'cols': 3, 'data': matrix},
        'distortion_model': 'plumb_bob' if rectified or not info.distortion_model else info.distortion_model,
        'distortion_coefficients': {'rows': 1, 'cols': len(distortion), 'data': distortion}}).encode()
