# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Observer: what each image of a film shows: the DLO, where the camera is, and tags."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Mapping

import cv2
import numpy as np
from numpy.typing import ArrayLike

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.axis import measured_diameter
from dlo_calibration.vision.photograph import jpeg, MAXIMUM_PIXELS, Photograph, Pixels
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.sheet import NO_SHEET
from dlo_calibration.vision.tags import tag_poses, TagFinder, TagPose
from dlo_calibration.vision.tracer import LINE, OUTLINE, Trace
from dlo_calibration.vision.tracker import COUNT, Tracked, Tracker
from dlo_calibration.vision.view import BoardFinder

WIDEST = 1280  # px, of an image with the line
DARK = 12  # of 255; an image whose brightest hundredth is darker shows nothing
BRIGHT_SHARE = 99.0  # percentile
TAG_COLOUR = (60, 255, 60)


@dataclass(frozen=True, eq=False)
class ImageView:
    """
    What an image shows.

    :param time: [s].
    :param scale: of this image; None: unknown.
    :param tags: number of a tag -> its corners (4, 2) [px], and `poses` likewise.
    """

    time: float
    tracked: Tracked
    scale: Scale | None = None
    tags: Mapping[int, Floats] = field(default_factory=lambda: MappingProxyType({}))
    poses: Mapping[int, TagPose] = field(default_factory=lambda: MappingProxyType({}))

    def points(self, radius: float, depth: Floats | None = None) -> Floats:
        """
        Return the points (count, 3) of the DLO in the table's frame [m]; NaN where it is not seen.

        :param radius: of the DLO [m], which lies on the table.
        :param depth: (h, w) of each pixel along the optical axis [m], NaN or 0 where unknown; None: none was
            measured.
        """
        pixels = self.tracked.pixels
        points = np.full((len(pixels), 3), np.nan)
        seen = np.isfinite(pixels[:, 0])
        if self.scale is None or not seen.any():
            return points
        points[seen] = self.scale.points(pixels[seen], radius)
        if depth is not None:
            camera = self.scale.camera
            rays = points - camera
            ahead = rays @ self.scale.rotation[2]
            measured = np.full(len(pixels), np.nan)
            measured[seen] = _depths(depth, pixels[seen])
            points = camera + rays * ((measured + radius) / ahead)[:, None]
        return points

    def diameter(self) -> float:
        """Return the diameter of the DLO [m]; NaN where it is not seen or there is no scale."""
        seen = np.isfinite(self.tracked.pixels[:, 0])
        if self.scale is None or seen.sum() < 3:
            return float('nan')
        pixels = self.tracked.pixels[seen]
        trace = Trace(pixels, np.ones(len(pixels), bool), self.tracked.width, ())
        return measured_diameter(trace, self.scale)


def _depths(depth: Floats, pixels: Floats) -> Floats:
    """Return the depth (n,) [m] at pixels (n, 2): the median of those known in 3 x 3 pixels; NaN: none is."""
    height, width = depth.shape
    columns, rows = np.rint(pixels).astype(int).T
    around = np.stack([depth[np.clip(rows + down, 0, height - 1), np.clip(columns + right, 0, width - 1)]
                       for down in (-1, 0, 1) for right in (-1, 0, 1)])
    around = np.where(around > 0, around, np.nan)
    known = np.isfinite(around).any(axis=0)
    depths = np.full(len(pixels), np.nan)
    depths[known] = np.nanmedian(around[:, known], axis=0)
    return depths


class Observer:
    """
    Observes a DLO, the camera and tags from image to image, forwards or backwards in time.

    :param scale: of all images; or a `BoardFinder`, which finds that of each; None: unknown.
    :param count: of points along the DLO.
    """

    def __init__(self, scale: Scale | BoardFinder | None, count: int = COUNT) -> None:
        sheet = scale.sheet if isinstance(scale, BoardFinder) else NO_SHEET
        self._given, self._tracker, self._finder = scale, Tracker(count, sheet), TagFinder()
        self._time = 0.0

    def start(self, time: float, pixels: Pixels, clicks: ArrayLike) -> ImageView:
        """
        Find the DLO in the first image.

        :param time: of the image [s].
        :param pixels: (h, w, 3) red, green, blue.
        :param clicks: (k, 2) [px], rough, in order along the DLO.
        :raises InputError: where there is no DLO along the clicks, no board, or no light.
        """
        check_light(pixels)
        scale = self._scale(pixels)
        if scale is None and self._given is not None:
            raise InputError('board', 'none in the image in which the DLO is clicked',
                             'the printed board beside the DLO', 'lay it flat beside the DLO, wholly in the '
                             'picture, or begin at another instant')
        self._time = time
        return self._view(time, pixels, scale, self._tracker.start(pixels, clicks, scale))

    def next(self, time: float, pixels: Pixels) -> ImageView:
        """Find the DLO in the next image."""
        scale = self._scale(pixels)
        elapsed, self._time = abs(time - self._time), time
        return self._view(time, pixels, scale, self._tracker.next(pixels, elapsed, scale))

    def _scale(self, pixels: Pixels) -> Scale | None:
        return self._given.next(pixels) if isinstance(self._given, BoardFinder) else self._given

    def _view(self, time: float, pixels: Pixels, scale: Scale | None, tracked: Tracked) -> ImageView:
        if scale is None:
            return ImageView(time, tracked)
        tags = self._finder.find(pixels)
        poses = {number: pose for number, corners in tags.items()
                 if (pose := tag_poses(corners, scale)) is not None}
        return ImageView(time, tracked, scale, tags, poses)


def check_light(pixels: Pixels) -> None:
    """
    Refuse an image in which nothing can be seen.

    :raises InputError: where it is too dark.
    """
    if np.percentile(pixels[::4, ::4], BRIGHT_SHARE) < DARK:
        raise InputError('film', 'an image that is dark', 'an image in which the DLO can be seen',
                         'switch the light on, or begin at a later instant (--at)')


def drawn(pixels: Pixels, view: ImageView | None, widest: int = WIDEST) -> Pixels:
    """
    Return an image with the line of the DLO and the tags.

    :param view: None: nothing is known of this image.
    :param widest: [px]; a wider image is reduced.
    """
    height, width = pixels.shape[:2]
    share = min(1.0, widest / width)
    # Even sides, as encoders of films want them.
    size = (max(round(share * width) // 2 * 2, 2), max(round(share * height) // 2 * 2, 2))
    picture = pixels.copy() if size == (width, height) else cv2.resize(
        pixels, size, interpolation=cv2.INTER_AREA)
    if view is None:
        return picture
    thick = max(round(view.tracked.width * share / 6), 2)
    line = (view.tracked.pixels + 0.5) * share - 0.5
    seen = np.isfinite(line[:, 0])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(int)))
    for colour, extra in ((OUTLINE, 2), (LINE, 0)):
        for begin, end in edges.reshape(-1, 2):
            _polyline(picture, line[begin:end], colour, thick + extra, False)
    for corners in view.tags.values():
        _polyline(picture, (corners + 0.5) * share - 0.5, TAG_COLOUR, 2, True)
    return picture


def jpeg_of(pixels: Pixels) -> bytes:
    """Return pixels (h, w, 3), red, green, blue, as a JPEG file."""
    return jpeg(Photograph(pixels))


def depths(thing: str, message: Any) -> Floats:
    """
    Return the depths (h, w) [m] of a `sensor_msgs/msg/Image`; 0 or NaN where unknown.

    :param thing: what it is called in errors.
    :raises InputError: for another encoding than 16UC1 [mm] or 32FC1 [m], or too few octets.
    """
    kinds = {'16UC1': ('u2', 0.001), '32FC1': ('f4', 1.0)}
    if message.encoding not in kinds:
        raise InputError(thing, f'encoding {message.encoding!r}', '16UC1 (mm) or 32FC1 (m)',
                         'choose the topic of the aligned depth')
    code, unit = kinds[message.encoding]
    width, height, step = int(message.width), int(message.height), int(message.step)
    octets, size = np.frombuffer(message.data, np.uint8), np.dtype(code).itemsize
    if not 0 < width * height <= MAXIMUM_PIXELS or step < width * size or len(octets) < step * height:
        raise InputError(thing, f'{width} x {height} depths in {len(octets)} octets, {step} a row',
                         'all rows', 'check the driver of the camera')
    rows = np.ascontiguousarray(octets[:step * height].reshape(height, step)[:, :width * size])
    return rows.view(('>' if message.is_bigendian else '<') + code).astype(float) * unit


def _polyline(picture: Pixels, line: Floats, colour: tuple[int, int, int], thick: int, closed: bool) -> None:
    cv2.polylines(picture, [np.rint(line * 16).astype(np.int32)], closed, colour, thick, cv2.LINE_AA, 4)


class FilmWriter:
    """
    Writes images as an mp4 film.

    :param rate: of its images [1/s].
    :raises InputError: where OpenCV cannot write it.
    """

    def __init__(self, path: str, size: tuple[int, int], rate: float) -> None:
        self._writer: Any = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*'mp4v'), rate, size)
        if not self._writer.isOpened():
            raise InputError(f'film {path}', 'no encoder or no permission', 'a film that can be written',
                             'choose another --output')

    def write(self, pixels: Pixels) -> None:
        """Write the next image (h, w, 3) red, green, blue."""
        self._writer.write(cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))

    def close(self) -> None:
        """End the film."""
        self._writer.release()
