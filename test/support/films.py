# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Films: renders images of a DLO that moves, of which everything is known.

It shows what `photographs` shows, several times as fast: the ground is one picture of the table, seen through
a homography; a DLO and hands are thick lines, painted from the lowest to the highest.  The camera's lens has
no distortion.
"""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from photographs import _capsules as capsules_of
from photographs import _ground, _lay, _linear, GRAIN, Look, SKIN

FINENESS = 0.0003  # m of one pixel of the table
SUB = 2  # pixels to a pixel of the picture, while lines are painted
LAYERS = np.array([1.0, 0.93, 0.84, 0.72, 0.58, 0.42, 0.24])  # of the radius: each brighter than the last one
SHADOW = 2  # pixels of the picture to one of a shadow
FILTER = 0.4  # standard deviation of a pixel's share of what it shows, in pixels
SQUARES = np.square(np.arange(256, dtype=np.float32) / 255)  # of what a picture stores: light
WIDER = 1.4  # px by which OpenCV paints a smooth line of an even thickness wider


@dataclass(frozen=True, eq=False)
class Tag:
    """
    A tag that somebody holds.

    :param image: (h, w) uint8.
    :param corners: (4, 3) [m], from the upper left one clockwise.
    """

    image: np.ndarray
    corners: np.ndarray


@dataclass(frozen=True, eq=False)
class Instant:
    """
    What an image shows.

    :param curve: (n, 3) [m]; None: no DLO.
    :param hands: of `photographs.Hand`.
    """

    camera: object
    curve: np.ndarray | None
    hands: tuple = ()
    tags: tuple[Tag, ...] = field(default=())


class Renderer:
    """
    Renders images of one table.

    :param look: what it looks like; sheets lie on it.
    :param radius: of the DLO [m].
    :param low: corner (x, y) of the part of the table that is shown [m].
    :param high: and the corner opposite.
    """

    def __init__(self, look, radius, low=(-0.4, -0.6), high=(1.0, 0.6), seed=0):
        self._look, self._radius = look, radius
        self._generator = np.random.default_rng(seed)
        self._low = np.array(low)
        width, height = np.ceil((np.array(high) - low) / FINENESS).astype(int)
        x = low[0] + FINENESS * np.arange(width, dtype=np.float32)
        y = high[1] - FINENESS * np.arange(height, dtype=np.float32)
        places = np.stack(np.meshgrid(x, y), axis=2)
        tile = _ground(look, self._generator, 1024)
        table = cv2.remap(tile, places * np.float32(1 / GRAIN) + np.float32(512), None, cv2.INTER_LINEAR,
                          borderMode=cv2.BORDER_REFLECT)
        for sheet in look.sheets:
            _lay(table, sheet, places)
        self._table, self._filtered = table, False
        self._empty = None, None  # a camera, and the light from the empty table in it
        #: from pixels of the table's picture to its places
        self._placed = np.array([[FINENESS, 0, low[0]], [0, -FINENESS, high[1]], [0, 0, 1]])
        azimuth, elevation = look.lamp
        self._lamp = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                               np.sin(elevation)])
        self._noise = self._generator.standard_normal((1200, 2100, 3), dtype=np.float32) * look.noise

    def restart(self, seed=0):
        """Begin a film whose noise does not depend on the films before."""
        self._generator = np.random.default_rng(seed)

    def image(self, instants):
        """Return an image (h, w, 3) uint8, exposed at one or more instants."""
        mean = sum(self._light(instant) for instant in instants) / len(instants)
        if self._look.blur:
            mean = cv2.GaussianBlur(mean, (0, 0), self._look.blur)
        mean = cv2.sqrt(np.clip(mean, 0, 1)) * np.float32(255)
        height, width = mean.shape[:2]
        top, left = self._generator.integers(0, 100, 2)
        mean += self._noise[top:top + height, left:left + width]
        return cv2.convertScaleAbs(np.clip(mean, 0, 255, out=mean))

    def _light(self, instant):
        """Return the linear image (h, w, 3) at an instant."""
        camera = instant.camera
        width, height = camera.size
        seen = camera.matrix @ np.column_stack(
            [camera.rotation[:, :2], -camera.rotation @ camera.position]) @ self._placed
        self._filter(camera)
        if camera != self._empty[0]:
            table = cv2.warpPerspective(self._table, seen, camera.size, flags=cv2.INTER_LINEAR,
                                        borderMode=cv2.BORDER_REPLICATE)
            self._empty = camera, cv2.LUT(table, SQUARES)
        image = self._empty[1].copy()
        capsules = capsules_of(instant.curve, self._radius, instant.hands)
        if len(capsules):
            self._shade(image, camera, capsules)
            self._paint(image, camera, capsules)
        for tag in instant.tags:
            side = tag.image.shape[0]
            corners = camera.project(tag.corners).astype(np.float32)
            view = cv2.getPerspectiveTransform(
                np.float32([[0, 0], [side, 0], [side, side], [0, side]]) - np.float32(0.5), corners)
            flat = np.square(tag.image.astype(np.float32) / 255) * np.float32(0.8)
            fineness = side / float(np.linalg.norm(corners[0] - corners[1]))
            flat = cv2.GaussianBlur(flat, (0, 0), FILTER * fineness, borderType=cv2.BORDER_REPLICATE)
            painted = cv2.warpPerspective(flat, view, (width, height))
            cover = cv2.warpPerspective(np.ones_like(flat), view, (width, height))
            image *= 1 - cover[..., None]
            image += painted[..., None]
        return image

    def _filter(self, camera):
        """Filter the picture of the table for pixels as those of the first camera: they take all light."""
        if not self._filtered:
            fineness = np.linalg.norm(camera.position) / camera.focal_length / FINENESS
            table = cv2.GaussianBlur(self._table, (0, 0), FILTER * max(fineness, 1.0))
            self._table = np.rint(np.sqrt(np.clip(table, 0, 1)) * 255).astype(np.uint8)
            self._filtered = True

    def _shade(self, image, camera, capsules):
        """Take light away from the table below a DLO and hands."""
        height, width = image.shape[:2]
        size = width // SHADOW, height // SHADOW
        for direction, strength in ((self._lamp, self._look.shadow), (np.array([0, 0, 1.0]), 0.35)):
            for kind in (False, True):
                some = capsules[(capsules[:, 8] == SKIN) == kind]
                if not len(some):
                    continue
                mask = np.zeros(size[::-1], np.uint8)
                ends = []
                for points in (some[:, :3], some[:, 3:6]):
                    fallen = points - points[:, 2:] / direction[2] * direction
                    ends.append((camera.project(fallen) + 0.5) / SHADOW - 0.5)
                wide = self._widths(camera, some) / SHADOW
                _lines(mask, ends[0], ends[1], wide, [255] * len(some))
                metres = np.median((some[:, 2] + some[:, 5]) / 2)
                blur = max(0.8, 0.3 * metres * np.median(wide / (2 * some[:, 6])))
                left, top, wide, high = cv2.boundingRect(mask)
                reach = 4 * blur
                left, right = (int(np.clip(x, 0, size[0])) for x in (left - reach, left + wide + reach + 1))
                top, bottom = (int(np.clip(y, 0, size[1])) for y in (top - reach, top + high + reach + 1))
                if right <= left or bottom <= top:
                    continue
                dark = cv2.GaussianBlur(mask[top:bottom, left:right], (0, 0), blur)
                dark = cv2.resize(dark, None, fx=SHADOW, fy=SHADOW).astype(np.float32)
                part = image[SHADOW * top:SHADOW * bottom, SHADOW * left:SHADOW * right]
                part *= 1 - np.float32(strength / 255) * dark[..., None]

    def _paint(self, image, camera, capsules):
        """Paint a DLO and hands."""
        starts, ends = camera.project(capsules[:, :3]), camera.project(capsules[:, 3:6])
        wide = self._widths(camera, capsules)
        height, width = image.shape[:2]
        margin = wide.max() + 2
        both = np.concatenate([starts, ends])
        left, top = np.clip(np.floor(both.min(axis=0) - margin), 0, (width - 1, height - 1)).astype(int)
        right, bottom = np.clip(np.ceil(both.max(axis=0) + margin), (left + 1, top + 1),
                                (width, height)).astype(int)
        size = (right - left) * SUB, (bottom - top) * SUB
        coloured = np.zeros((size[1], size[0], 3), np.uint8)
        cover = np.zeros((size[1], size[0]), np.uint8)
        starts, ends = ((points - (left, top) + 0.5) * SUB - 0.5 for points in (starts, ends))
        wide = wide * SUB
        base = self._colours(capsules)
        heights = (capsules[:, 2] + capsules[:, 5]) / 2
        # A strand is painted whole before the next one above it; its layers must not cover each other.
        level = np.floor(heights / (1.5 * self._radius)) + 1000 * (capsules[:, 8] == SKIN)
        for value in np.unique(level):
            rows = np.flatnonzero(level == value)
            _lines(cover, starts[rows], ends[rows], wide[rows], [255] * len(rows))
            for share in LAYERS:
                up = np.sqrt(1 - share * share)
                light = (1 - self._look.shadow) * (0.55 + 0.45 * up) + self._look.shadow * (0.25 + 0.75 * up)
                painted = base[rows] * light
                if share < 0.4:
                    painted = painted + 0.15 * self._look.highlight * (capsules[rows, 8:9] != SKIN)
                painted = np.rint(np.sqrt(np.clip(painted, 0, 1)) * 255).tolist()
                _lines(coloured, starts[rows], ends[rows], np.maximum(wide[rows] * share, 1), painted)
        small = (right - left, bottom - top)
        share = cv2.resize(cover, small, interpolation=cv2.INTER_AREA).astype(np.float32)[..., None] / 255
        light = cv2.resize(cv2.LUT(coloured, SQUARES), small, interpolation=cv2.INTER_AREA)
        part = image[top:bottom, left:right]
        part *= 1 - share
        part += light

    def _colours(self, capsules):
        """Return linear colours (n, 3) of capsules."""
        look, arc = self._look, capsules[:, 7]
        colours = np.tile(_linear(look.colour), (len(capsules), 1))
        if look.pattern != 'plain':
            colours[np.sin(arc / look.pitch * 2 * np.pi) > 0.4] = _linear(look.second_colour)
        colours[capsules[:, 8] == SKIN] = _linear((0.87, 0.66, 0.56))
        return colours

    def _widths(self, camera, capsules):
        """Return the widths (n,) of capsules [px]."""
        depth = ((capsules[:, :3] + capsules[:, 3:6]) / 2 - camera.position) @ camera.rotation[2]
        return 2 * capsules[:, 6] * camera.focal_length / np.maximum(depth, 0.05)


def _lines(image, starts, ends, wide, colours):
    """Paint lines with round ends."""
    for a, b, width, colour in zip(np.rint(np.clip(starts, -9000, 9000) * 16).astype(int).tolist(),
                                   np.rint(np.clip(ends, -9000, 9000) * 16).astype(int).tolist(),
                                   np.maximum(2 * np.rint((wide - WIDER) / 2), 1).astype(int).tolist(),
                                   colours, strict=True):
        cv2.line(image, a, b, colour, width, cv2.LINE_AA, 4)


def depth_image(camera, curve, radius):
    """Return the depth (h, w) along the optical axis [m] of a DLO, (n, 3), and of the table."""
    width, height = camera.size
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([u, v, np.ones_like(u)], axis=2) @ np.linalg.inv(camera.matrix).T @ camera.rotation
    depth = (-camera.position[2] / rays[..., 2]).astype(np.float32)
    middle = (curve[:-1] + curve[1:]) / 2
    ahead = (middle - camera.position) @ camera.rotation[2]
    pixels = np.rint(camera.project(curve) * 16).astype(int)
    for k in np.argsort(-ahead):  # the farthest first
        wide = round(2 * radius * camera.focal_length / ahead[k])
        cv2.line(depth, pixels[k].tolist(), pixels[k + 1].tolist(), float(ahead[k] - radius), max(wide, 1),
                 cv2.LINE_8, 4)
    return depth


def write_film(path, images, rate=30.0, code='mp4v'):
    """Write images (h, w, 3) RGB as a film."""
    writer = None
    for image in images:
        if writer is None:
            writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*code), rate,
                                     image.shape[1::-1])
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()


def plain_look(**changed):
    """Return the look of a dark red DLO on a bright table."""
    return replace(Look(ground_contrast=0.1, blur=0.7, noise=2.0), **changed)
