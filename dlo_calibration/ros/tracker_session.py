# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
TrackerSession: the state of the node `tracker`, and its reactions to images, requests and time.

It imports no rclpy: it reaches ROS through a `NodeInterface`, which the node implements.
A thread of its own tracks.  It always takes the newest image; those that come meanwhile are dropped.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import struct
import threading
import time
from typing import Any, Callable, Mapping, Sequence, Union

import numpy as np

from dlo_calibration.calibration.options import declared, DeclaredOptions, MACHINE
from dlo_calibration.capture.filming import Filming
from dlo_calibration.errors import DEFECT, InputError
from dlo_calibration.files.image_topic import image
from dlo_calibration.messages.codec import action_trajectory, chain_cloud, MessageTypes, NANOSECONDS
from dlo_calibration.messages.encoder import action_message, BEFORE
from dlo_calibration.model.chain import Chain, Floats, MOST_POINTS
from dlo_calibration.observation.episodes import Episode, without_lifted
from dlo_calibration.ros.diagnostics import LOST, STOPPED, tracker_status, TRACKING, WAITING
from dlo_calibration.ros.node_session import FAILED, NodeInterface, NodeSession, NodeState, refusal_text
from dlo_calibration.vision.lens import Lens, lens_of
from dlo_calibration.vision.observer import depths, drawn, ImageView, jpeg_of, Observer
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.pose import scale_from_points
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.view import BoardFinder, first_lens
from dlo_calibration.workspace.worker import Background, Failure

IMAGE, COMPRESSED, INFO, DEPTH = 'image', 'image/compressed', 'camera_info', 'depth'
CHAIN, INITIAL, ACTION, OVERLAY = 'chain', 'initial_chain', 'action', 'overlay/compressed'
INPUT_TYPES: Mapping[str, str] = {
    IMAGE: 'sensor_msgs/msg/Image',
    COMPRESSED: 'sensor_msgs/msg/CompressedImage',
    INFO: 'sensor_msgs/msg/CameraInfo',
    DEPTH: 'sensor_msgs/msg/Image',
}
OUTPUT_TYPES: Mapping[str, str] = {
    CHAIN: 'sensor_msgs/msg/PointCloud2',
    INITIAL: 'sensor_msgs/msg/PointCloud2',
    ACTION: 'trajectory_msgs/msg/MultiDOFJointTrajectory',
    OVERLAY: 'sensor_msgs/msg/CompressedImage',
    'status': 'diagnostic_msgs/msg/DiagnosticArray',
}
PATIENCE = 0.5  # s that closing waits for the thread
WAIT = 0.1  # s after which the thread looks again whether to end
SAME = 0.05  # s between an image and its depth, at most
DEPTHS = 3  # that are kept; the one nearest to an image is its own
LATE = 0.1  # s by which a depth may come later than its image
OVERLAYS = 5.0  # pictures with the line, in a second
OVERLAY_WIDTH = 640  # px
SETTLED = 1.0  # s without motion after which an action is looked for
MOVED = 0.004  # m in SETTLED; a DLO that moves more is not settled
KEPT = 60.0  # s that are remembered while nothing was done
LONGEST = 300.0  # s of an action


@dataclass(frozen=True)
class TrackerOptions(DeclaredOptions):
    """Everything that a user of the node can set."""

    points: str = declared(
        '', "rough clicks along the DLO in the first image: 'u,v u,v ...' in pixels, from one end to the "
        'other; empty: nothing is tracked until they are set', of=MACHINE)
    scale: str = declared(
        '', "four or more pixels and where they are on the table: 'u,v=x,y u,v=x,y ...', pixels and metres, "
        'for a camera that stands still; empty: the printed board lies beside the DLO', of=MACHINE)
    count: int = declared(21, 'number of points of a chain', minimum=3, maximum=MOST_POINTS, of=MACHINE)
    frame_id: str = declared('table', 'frame_id of the chains, whose origin is that of the board', of=MACHINE)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.clicks()
        self.places()

    def clicks(self) -> Floats:
        """
        Return the pixels (k, 2) of the clicks.

        :raises InputError: where the parameter has another form.
        """
        return _numbers('points', self.points, 'u,v', 2)

    def places(self) -> tuple[Floats, Floats]:
        """Return the pixels (k, 2) of the scale and their places (k, 2) [m]; raise InputError likewise."""
        numbers = _numbers('scale', self.scale.replace('=', ','), 'u,v=x,y', 4)
        return numbers[:, :2], numbers[:, 2:]


def _numbers(name: str, text: str, form: str, count: int) -> Floats:
    try:
        rows = [[float(number) for number in word.split(',')] for word in text.split()]
        if any(len(row) != count for row in rows) or not np.isfinite(rows).all():
            raise ValueError
    except ValueError as error:
        raise InputError(f'parameter {name}', repr(text), f"'{form} {form} ...'", 'correct it') from error
    return np.array(rows, float).reshape(-1, count)


@dataclass(frozen=True, eq=False)
class Sight:
    """
    What the thread saw in an image.

    :param stamp: of the image [ns].
    :param points: (count, 3) [m]; NaN where not seen.
    :param overlay: the picture with the line as JPEG; None: not this time.
    :param episodes: that ended, with the times of the images.
    """

    stamp: int
    view: ImageView
    points: Floats
    overlay: bytes | None
    episodes: tuple[Episode, ...]
    problems: tuple[str, ...]
    seconds: float


Event = Union[Sight, InputError, Failure, None]


class Watch:
    """
    What the thread of the tracker does: it takes the newest image, tracks, and looks for actions.

    It belongs to that thread, from `take` to `take`.

    :param options: that were valid when it began.
    """

    def __init__(self, options: TrackerOptions) -> None:
        self._options = options
        self._filming = Filming()
        self._observer: Observer | None = None
        self._zero = 0  # stamp of the first image [ns]
        self._drawn = float('-inf')  # [s]
        self._rest: list[tuple[float, Floats]] = []  # the last SETTLED seconds
        self._moving = False
        self._told = 0.0  # until when episodes were told [s]

    def take(self, stamp: int, pixels: Pixels, lens: Lens | None, depth: Floats | None) -> Sight:
        """
        Take the next image.

        :raises InputError: in the first image, where there is no DLO along the clicks, or no scale.
        """
        began = time.perf_counter()
        if self._observer is None:
            observer = Observer(self._scale(pixels, lens))
            view = observer.start(0.0, pixels, self._options.clicks())
            self._observer, self._zero = observer, stamp
        else:
            view = self._observer.next((stamp - self._zero) / NANOSECONDS, pixels)
        points = self._filming.add(view, depth)
        if depth is None:
            for pose in view.poses.values():
                points = without_lifted(points, pose.positions[0], self._filming.radius)
        rows = np.linspace(0, len(points) - 1, self._options.count)
        points = points[np.rint(rows).astype(int)] if self._options.count <= len(points) else np.stack(
            [np.interp(rows, np.arange(len(points)), axis) for axis in points.T], axis=1)
        episodes, problems = self._episodes(view.time, points)
        overlay = None
        if view.time - self._drawn >= 1.0 / OVERLAYS:
            overlay, self._drawn = jpeg_of(drawn(pixels, view, OVERLAY_WIDTH)), view.time
        return Sight(stamp, view, points, overlay, episodes, problems, time.perf_counter() - began)

    def _scale(self, pixels: Pixels, lens: Lens | None) -> Scale | BoardFinder:
        size = pixels.shape[1], pixels.shape[0]
        seen, places = self._options.places()
        if len(seen):
            return scale_from_points(seen, places, size, lens)
        return BoardFinder(first_lens(pixels) if lens is None else lens.resized(size))

    def _episodes(self, now: float, points: Floats) -> tuple[tuple[Episode, ...], tuple[str, ...]]:
        """Return what has ended: when the DLO has settled after it moved."""
        self._rest.append((now, points))
        while self._rest[0][0] < now - SETTLED:
            self._rest.pop(0)
        away = np.linalg.norm(points - self._rest[0][1], axis=1)
        far = bool(np.isfinite(away).any() and np.nanquantile(away, 0.9) > MOVED)
        settled = self._moving and not far and self._rest[-1][0] - self._rest[0][0] > 0.8 * SETTLED
        self._moving = far or self._moving and not settled
        if not settled:
            if self._filming.times[-1] - self._filming.times[0] > (LONGEST if self._moving else KEPT):
                self._filming.forget(now - KEPT / 2.0)
            return (), ()
        found, problems = self._filming.episodes(self._options.count)
        new = tuple(episode for episode in found if max(hand.end for hand in episode.hands) > self._told)
        self._told = now
        self._filming.forget(now - 3.0 * SETTLED)
        return new, problems


class TrackerSession(NodeSession[TrackerOptions]):
    """
    Tracks the DLO in the newest images, and publishes its chains, and what the hands did.

    It is not thread-safe.

    :param types: the message classes that `graph` encodes.
    :param clock: a monotonic clock [s].
    """

    def __init__(self, graph: NodeInterface[TrackerOptions], types: MessageTypes,
                 clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(graph, types, INPUT_TYPES, NodeState(WAITING), clock)
        self.requests = {'start': self._start, 'stop': self._stop}
        self._background: Background[Event] = Background('tracking')
        self._newest: dict[str, bytes] = {}
        self._depths: deque[bytes] = deque(maxlen=DEPTHS)
        self._came = threading.Condition()
        self._watch: Watch | None = None  # None: resting
        self._lens: Lens | None = None
        self._counts = {'images': 0, 'tracked': 0, 'dropped': 0, 'actions': 0}
        self._lost_since: int | None = None  # stamp [ns]
        self._rate = float('nan')  # images in a second that could be tracked
        self.begin(graph.options())
        self._report()

    def begin(self, options: TrackerOptions) -> None:
        """Find the DLO anew in the next image."""
        self._watch = Watch(options) if options.points else None
        self._state.name, self._state.detail = WAITING, ''
        self._lost_since = None

    def hear(self, kind: str, octets: bytes) -> None:
        """Take a message that came on an input topic; a newer one replaces it if it has to wait."""
        with self._came:
            if kind in (IMAGE, COMPRESSED):
                self._counts['images'] += 1
                self._counts['dropped'] += kind in self._newest and self._watch is not None
            if kind == DEPTH:
                self._depths.append(octets)
            else:
                self._newest[kind] = octets
            self._came.notify()

    def tick(self) -> None:
        """Do what is due now; the node calls this many times a second."""
        for event in self._background.waiting_events():
            self._take(event)
        if self._watch is not None and not self._background.alive and self._state.name != FAILED:
            self._background.begin(self._work)
        self._report_refusals()
        self._report()

    def close(self) -> None:
        """End the thread."""
        self._background.stop()
        self._background.join(PATIENCE)
        for text in self._state.counted.rest():
            self._graph.warn(text)

    # The thread

    def _work(self, should_stop: Callable[[], bool]) -> Event:
        """Track the newest image again and again."""
        while not should_stop():
            with self._came:
                self._came.wait_for(lambda: IMAGE in self._newest or COMPRESSED in self._newest, WAIT)
                if self._depths and not self._came.wait_for(self._depth_came, LATE):
                    self._depths.clear()  # no more of them come
                taken, self._newest = self._newest, {}
                kept = tuple(self._depths)
            watch = self._watch
            if watch is None:
                return None
            for kind in (INFO, IMAGE, COMPRESSED):
                if kind not in taken:
                    continue
                try:
                    message = self._decoded(kind, taken[kind])
                    if kind == INFO:
                        self._lens = _lens(message)
                    else:
                        stamp, depth = _stamp(taken[kind]), None
                        try:
                            depth = self._depth_at(stamp, kept)
                        except InputError as error:
                            self._background.events.put(error)
                        self._background.events.put(
                            watch.take(stamp, image(kind, message), self._lens, depth))
                except InputError as error:
                    self._background.events.put(error)
                except Exception as error:  # damaged messages can raise anything
                    self._background.events.put(InputError(kind, repr(error), 'a message that can be used',
                                                           DEFECT))
        return None

    def _depth_came(self) -> bool:
        """Return whether no depth that is still to come belongs to the newest image."""
        stamps = [_stamp(self._newest[kind]) for kind in (IMAGE, COMPRESSED) if kind in self._newest]
        return not stamps or _stamp(self._depths[-1]) >= max(stamps)

    def _depth_at(self, stamp: int, kept: Sequence[bytes]) -> Floats | None:
        """
        Return the depths at a time [ns]; None: none was measured then.

        :param kept: the newest messages of depths.
        """
        nearest = min(kept, key=lambda octets: abs(_stamp(octets) - stamp), default=None)
        if nearest is None or abs(_stamp(nearest) - stamp) > SAME * NANOSECONDS:
            return None
        if self._lens is None:  # an estimated focal length is off by some percent, and so are distances
            raise InputError(DEPTH, 'depths without camera_info', 'the calibration of the camera',
                             'let ~/camera_info be published, or remap it')
        return depths(DEPTH, self._decoded(DEPTH, nearest))

    # Events of the thread

    def _take(self, event: Event) -> None:
        if isinstance(event, Sight):
            try:
                self._publish(event)
            except Exception as error:  # it could not be published
                self.refuse(refusal_text(error, CHAIN))
        elif isinstance(event, InputError):
            if self._state.name == WAITING:
                self._state.detail = str(event)
            self.refuse(str(event))
        elif isinstance(event, Failure):
            self.fail(event.text, *filter(None, [event.text, event.details]))

    def _publish(self, sight: Sight) -> None:
        options = self._graph.options()
        lost = sight.view.tracked.lost
        self._rate = 1.0 / max(sight.seconds, 1e-6)
        if lost:
            self._lost_since = self._lost_since or sight.stamp
            self._state.name, self._state.detail = LOST, sight.view.tracked.reason
        else:
            self._lost_since = None
            self._counts['tracked'] += 1
            self._state.name, self._state.detail = TRACKING, ''
            if np.isfinite(sight.points[:, 0]).sum() * 2 >= len(sight.points):
                chain = Chain(sight.points)
                self._send(CHAIN, chain_cloud(self._types, chain, sight.stamp, options.frame_id))
        for episode in sight.episodes:
            self._act(episode, options.frame_id, sight)
        for problem in sight.problems:
            self.refuse(f'action: {problem}')
        if sight.overlay is not None:
            header = self._types.header(sight.stamp, options.frame_id)
            self._send(OVERLAY, self._types.build(OUTPUT_TYPES[OVERLAY], header=header, format='jpeg',
                                                  data=self._types.octets(sight.overlay)))

    def _act(self, episode: Episode, frame_id: str, sight: Sight) -> None:
        """Publish what hands did, and where the DLO was before."""
        zero = sight.stamp - round(sight.view.time * NANOSECONDS)
        start = zero + round(min(hand.start for hand in episode.hands) * NANOSECONDS)
        self._send(INITIAL, chain_cloud(self._types, episode.initial, start - BEFORE, frame_id))
        self._send(ACTION, action_trajectory(self._types, action_message(episode.hands, start, frame_id)))
        self._counts['actions'] += 1
        held = ', '.join(f'{hand.name} at {100 * place:.0f} %' for hand, place in zip(
            episode.hands, episode.places, strict=True))
        self._graph.info(f'action {self._counts["actions"]}: {held} of the length')

    # Requests

    def _start(self) -> str:
        options = self._graph.options()
        if not options.points:
            raise InputError('~/start', 'no points', 'the parameter points',
                             'set it to rough clicks along the DLO, in pixels of the image')
        self.begin(options)
        return 'the DLO is found in the next image'

    def _stop(self) -> str:
        if self._watch is None:
            raise InputError('~/stop', 'a tracker that rests', 'one that tracks', 'call ~/start first')
        self._watch = None
        self._state.name, self._state.detail = STOPPED, ''
        return 'the tracker rests'

    # Messages of the node

    def _report(self) -> None:
        """Send the status if it differs from the last one."""
        state, detail = self._state, self._state.detail
        if state.name == WAITING and not detail:
            detail = 'for ~/image or ~/image/compressed' if self._watch else 'for the parameter points'
        now = self._graph.stamp()
        lost = 0.0 if self._lost_since is None else max((now - self._lost_since) / NANOSECONDS, 0.0)
        content: dict[str, Any] = {
            'state': state.name, 'detail': detail, **self._counts, 'rate': self._rate, 'lost_for': lost,
            'last_refusal': state.last_refusal}
        if self._status_is_due(content, *self._counts, 'rate', 'lost_for', 'last_refusal'):
            self._send('status', tracker_status(self._types, now, content))

    def _send(self, name: str, message: Any) -> None:
        self._graph.publish(name, self._graph.encode(name, message))


def _stamp(octets: bytes) -> int:
    """Return the stamp [ns] of a message that begins with a header, in CDR; 0: it is too short."""
    if len(octets) < 12:
        return 0
    seconds, nanoseconds = struct.unpack_from('<iI' if octets[1] & 1 else '>iI', octets, 4)
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def _lens(info: Any) -> Lens | None:
    """Return the lens of a camera_info; None where the camera is not calibrated."""
    if not float(info.k[0]):
        return None
    return lens_of({'width': int(info.width), 'height': int(info.height), 'k': list(info.k),
                    'd': list(info.d), 'distortion_model': info.distortion_model}, INFO)
