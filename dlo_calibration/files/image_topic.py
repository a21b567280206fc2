# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Image topic: the images of a camera in a recorded session are a film, too; raw or compressed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import NANOSECONDS
from dlo_calibration.vision.film import Frame
from dlo_calibration.vision.photograph import decoded, MINIMUM_SIDE, Pixels, read_photograph

RAW, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
PIECE = 4.0  # s of images that are in memory at once, to play them backwards
EXPECTED = 'a recorded session (an MCAP file or a rosbag2 folder) with a topic of images'


def image(thing: str, message: Any) -> Pixels:
    """
    Return the pixels of a message, (h, w, 3) red, green, blue.

    :param thing: what it is called in errors.
    :raises InputError: where it cannot be decoded.
    """
    if hasattr(message, 'encoding'):
        return decoded(thing, message)
    return read_photograph(bytes(message.data), thing).pixels


@dataclass(frozen=True)
class ImageTopic:
    """
    The images on one topic of a recorded session, with what a `Film` offers.

    :param size: width and height [px].
    :param duration: from the first to the last image [s].
    :param frame_rate: mean [1/s].
    """

    path: Path
    topic: str
    size: tuple[int, int]
    duration: float
    frame_rate: float
    first: int  # stamp of the first image [ns]

    def frames(self, start: float = 0.0, end: float = math.inf) -> Iterator[Frame]:
        """Give the images with start <= time < end [s], by the stamps in their headers."""
        # A bag is ordered by when messages came, a little later than their stamps.
        begin = self.first + round(max(start - 1.0, 0.0) * NANOSECONDS)
        stop = None if math.isinf(end) else self.first + round((end + PIECE) * NANOSECONDS)
        with _opened(self.path) as reader:
            connections = _connections(self.path, reader, self.topic)
            for connection, log_time, octets in reader.messages(connections, stop=stop):
                if log_time < begin:
                    continue
                message = reader.deserialize(octets, connection.msgtype)
                time = (_stamp(message) - self.first) / NANOSECONDS
                if start <= time < end:
                    pixels = image(f'image on {self.topic}', message)
                    if pixels.shape[1::-1] == self.size:
                        yield Frame(time, pixels)

    def backwards(self, start: float = math.inf) -> Iterator[Frame]:
        """Give the images before a time [s], the last one first."""
        end = min(start, self.duration + 1e-6)
        while end > 0.0:
            begin = max(end - PIECE, 0.0)
            yield from reversed(list(self.frames(begin, end)))
            end = begin


def read_image_topic(path: Path, topic: str) -> ImageTopic:
    """
    Open the images on a topic.

    :raises InputError: where there are none, or they cannot be read.
    """
    stamps = []
    size = None
    with _opened(path) as reader:
        connections = _connections(path, reader, topic)
        for connection, _, octets in reader.messages(connections):
            message = reader.deserialize(octets, connection.msgtype)
            stamps.append(_stamp(message))
            if size is None:
                pixels = image(f'image on {topic}', message)
                size = pixels.shape[1], pixels.shape[0]
    if size is None or len(stamps) < 2 or min(size) < MINIMUM_SIDE:
        raise InputError(f'session {path}', f'{len(stamps)} images on {topic}',
                         f'some seconds of images of at least {MINIMUM_SIDE} pixels a side',
                         'name another topic')
    duration = (max(stamps) - min(stamps)) / NANOSECONDS
    lapse = float(np.median(np.diff(np.sort(stamps)))) / NANOSECONDS
    return ImageTopic(path, topic, size, duration, 1.0 / max(lapse, 1e-3), min(stamps))


def _stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a session; whatever the library meets in a damaged file becomes an InputError."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import get_typestore, Stores

    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            yield reader
    except (InputError, GeneratorExit):
        raise
    except Exception as error:
        raise InputError(f'session {path}', ' '.join(f'{type(error).__name__}: {error}'.split())[:200],
                         EXPECTED, 'name a recording with --image TOPIC, or a film without it') from error


def _connections(path: Path, reader: Any, topic: str) -> list[Any]:
    """Return the connections of a topic of images."""
    images = [connection for connection in reader.connections if connection.msgtype in (RAW, COMPRESSED)]
    some = [connection for connection in images if connection.topic == topic]
    if not some:
        names = ', '.join(sorted({connection.topic for connection in images})) or 'no images'
        raise InputError(f'session {path}', f'no images on {topic}', f'one of its topics of images ({names})',
                         'give that with --image')
    return some
