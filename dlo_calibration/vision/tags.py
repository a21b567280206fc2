# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Tags: printed squares, each glued on what holds the DLO, say on a clothes peg, tongs or a robot's finger.

Tag 0 is on the first hand, tag 1 on the second one.  The frame of a tag: its origin is the middle of the
square, x goes to the right as printed, y upwards, z out of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.scale import Scale

TAGS = 8  # on the sheet: the most hands of an action
TAG_SIDE = 0.02  # m, of the black square; a white margin of QUIET surrounds it
TAG_CELLS = 7  # of a side: 5 bits and a border, so that no marker of the board (4 bits) is read as a tag
QUIET = 0.003  # m

NEAR = 2.5  # sides of a tag around where it was seen last, in which it is looked for first
EVERYWHERE = 5  # pictures from one search of the whole picture to the next, while all tags are seen nearby
SOUGHT = 15  # pictures after a tag was lost, in which the whole picture is searched
CELL, EDGE = 6, 0.5  # px of a cell in the picture with which a tag is aligned, and blur of its edges
ALIGNMENT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-5)
ALIKE = 0.9  # correlation with its printed picture of a tag whose code is not read
CORNER = 0.1  # px, standard deviation of a corner; only its ratio to TURN counts
TURN = np.deg2rad(15.0)  # by which a tag turns from one picture to the next
WINDOW = 0.08  # s, standard deviation of the times over which a path is smoothed
LONGEST_GAP = 0.4  # s in which a tag that is not seen moves on evenly

_ARUCO: Any = cv2.aruco  # of any version


def tag_cells(number: int) -> Pixels:
    """Return the cells (7, 7) of a tag, 0 black and 255 white."""
    draw = _ARUCO.generateImageMarker if hasattr(_ARUCO, 'generateImageMarker') else _ARUCO.drawMarker
    return np.asarray(draw(_tag_dictionary(), number, TAG_CELLS))


def _tag_dictionary() -> Any:
    """Return the dictionary of tags: its codes differ in at least 8 bits, and are not the board's."""
    return _ARUCO.getPredefinedDictionary(_ARUCO.DICT_5X5_50)


class TagFinder:
    """Finds tags from picture to picture: first near where they were seen last."""

    def __init__(self) -> None:
        self._last: dict[int, Floats] = {}  # corners (4, 2) [px]
        self._steps: dict[int, Floats] = {}  # since the picture before, likewise
        self._count = 0
        self._sought = 0  # until which picture

    def find(self, pixels: Pixels) -> dict[int, Floats]:
        """
        Return the corners (4, 2) [px] of each tag that is seen, from its upper left one clockwise.

        :param pixels: (h, w, 3) red, green, blue.
        """
        grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
        found: dict[int, Floats] = {}  # roughly
        for number, corners in self._last.items():
            reach = NEAR * float(np.ptp(corners, axis=0).max())
            left, top = np.maximum(np.floor(corners.min(axis=0) - reach), 0).astype(int)
            right, bottom = np.ceil(corners.max(axis=0) + reach).astype(int)
            near = _found(np.ascontiguousarray(grey[top:bottom, left:right]))
            if number in near:
                found[number] = near[number] + (left, top)
        if self._count % EVERYWHERE == 0 or len(found) < len(self._last) or self._count < self._sought:
            found = {**_found(grey), **found}
        self._count += 1
        before, self._last = self._last, {}
        for number, corners in found.items():
            aligned, alike = _aligned(grey, number, corners)
            self._last[number] = corners if aligned is None else aligned
            self._steps[number] = self._last[number] - before.get(number, self._last[number])
        for number, corners in before.items():
            if number not in found:
                # A small or blurred tag whose code is not read still looks like itself where it moves on.
                aligned, alike = _aligned(grey, number, corners + self._steps[number])
                if aligned is not None and alike > ALIKE:
                    self._steps[number] = aligned - corners
                    self._last[number] = aligned
        if len(self._last) < len(before):
            self._sought = self._count + SOUGHT
        return dict(self._last)


def _found(grey: Pixels) -> dict[int, Floats]:
    """Return the corners (4, 2) [px] of each tag; OpenCV has another interface since 4.7."""
    if min(grey.shape) < 2 * TAG_CELLS:
        return {}
    new = hasattr(_ARUCO, 'ArucoDetector')
    options = _ARUCO.DetectorParameters() if new else _ARUCO.DetectorParameters_create()
    # Cells of three or four pixels, whose edges are grey, are read in their middles.
    options.perspectiveRemovePixelPerCell = 8
    options.perspectiveRemoveIgnoredMarginPerCell = 0.25
    if new:
        corners, numbers, _ = _ARUCO.ArucoDetector(_tag_dictionary(), options).detectMarkers(grey)
    else:
        corners, numbers, _ = _ARUCO.detectMarkers(grey, _tag_dictionary(), parameters=options)
    return {int(number): corner.reshape(4, 2).astype(float)
            for number, corner in zip([] if numbers is None else np.ravel(numbers), corners, strict=True)
            if number < TAGS}


def _aligned(grey: Pixels, number: int, corners: Floats) -> tuple[Floats | None, float]:
    """
    Return the corners (4, 2) [px] of a tag to a few hundredths of a pixel, from rough ones.

    They are None where it is not found; the correlation of the picture with the tag follows, at most 1.

    The view of the whole printed tag that correlates best with the picture is found (Evangelidis and
    Psarakis, Parametric image alignment using enhanced correlation coefficient maximization, 2008): all
    edges between its cells count, and the brightness does not.
    """
    printed = np.kron(np.pad(tag_cells(number), 1, constant_values=255), np.ones((CELL, CELL)))
    template = cv2.GaussianBlur(printed.astype(np.float32), (0, 0), EDGE)
    places = (1 + TAG_CELLS * np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)) * CELL - np.float32(0.5)
    reach = float(np.ptp(corners, axis=0).max()) / 3.0
    left, top = np.maximum(np.floor(corners.min(axis=0) - reach), 0).astype(int)
    right, bottom = np.ceil(corners.max(axis=0) + reach).astype(int)
    # A lens blurs light, and the camera takes about the square root of it; without its inverse, the black
    # cells seem smaller by half a pixel.
    piece = np.square(np.ascontiguousarray(grey[top:bottom, left:right], np.float32))
    view = cv2.getPerspectiveTransform(places, (corners - (left, top)).astype(np.float32)).astype(np.float32)
    try:
        alike, view = cv2.findTransformECC(template, piece, view, cv2.MOTION_HOMOGRAPHY, ALIGNMENT, None, 1)
    except cv2.error:  # it does not converge, as where something covers a part of the tag
        return None, 0.0
    better = cv2.perspectiveTransform(places[:, None], view)[:, 0].astype(float) + (left, top)
    return (better, float(alike)) if np.abs(better - corners).max() < reach else (None, 0.0)


@dataclass(frozen=True, eq=False)
class TagPose:
    """
    The poses in which a tag may look as it is seen; a square seen from far has two.

    :param positions: (k, 3) of its middle in the table's frame [m].
    :param rotations: (k, 3, 3) from its frame to the table's.
    :param errors: (k,) root mean square of the corners' distances from where the pose has them [px].
    """

    positions: Floats
    rotations: Floats
    errors: Floats


def tag_poses(corners: Floats, scale: Scale, side: float = TAG_SIDE) -> TagPose | None:
    """
    Return the poses of a tag; None where no pose looks like that.

    :param corners: (4, 2) [px], as `TagFinder.find` returns them.
    :param scale: of the same picture.
    :param side: of the tag [m].
    """
    places = side / 2.0 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)
    seen = scale.lens.undistorted(corners)
    if not np.isfinite(seen).all():
        return None
    count, turns, moves, errors = cv2.solvePnPGeneric(
        places, seen[:, None], scale.lens.matrix, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    if not count:
        return None
    rotations = np.stack([scale.rotation.T @ cv2.Rodrigues(turn)[0] for turn in turns])
    positions = (np.stack([np.ravel(move) for move in moves]) - scale.translation) @ scale.rotation
    if not (np.isfinite(rotations).all() and np.isfinite(positions).all()):
        return None
    return TagPose(positions, rotations, np.ravel(errors))


@dataclass(frozen=True, eq=False)
class TagPath:
    """
    The smooth path of a tag.

    :param times: (n,) [s], of all pictures.
    :param positions: (n, 3) of its middle in the table's frame [m]; NaN where its pose is unknown.
    :param orientations: (n, 4) quaternions x y z w; NaN likewise.
    """

    times: Floats
    positions: Floats
    orientations: Floats

    def __post_init__(self) -> None:
        for name in ('times', 'positions', 'orientations'):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))


def tag_path(times: Sequence[float], poses: Mapping[int, TagPose]) -> TagPath:
    """
    Return the path of a tag through pictures.

    Of the poses that look alike, those are taken with which it turns least.

    :param times: (n,) of all pictures, increasing [s].
    :param poses: index of each picture in which it is seen -> its poses there.
    """
    instants = np.asarray(times, float)
    positions, turns = np.full((len(instants), 3), np.nan), np.full((len(instants), 4), np.nan)
    shown = np.array(sorted(poses), int)
    if len(shown):
        chosen = _least_turning([poses[k] for k in shown])
        places = np.stack([poses[k].positions[choice] for k, choice in zip(shown, chosen, strict=True)])
        rotations = Rotation.from_matrix(np.stack(
            [poses[k].rotations[choice] for k, choice in zip(shown, chosen, strict=True)]))
        breaks = np.flatnonzero(np.diff(instants[shown]) > LONGEST_GAP) + 1
        for piece in np.split(np.arange(len(shown)), breaks):
            seen = instants[shown[piece]]
            inside = (instants >= seen[0]) & (instants <= seen[-1])
            smooth, turned = _smoothed(seen, places[piece], rotations[piece])
            at = instants[inside]
            positions[inside] = np.stack([np.interp(at, seen, axis) for axis in smooth.T], axis=1)
            turns[inside] = (Slerp(seen, turned)(at) if len(seen) > 1 else turned).as_quat()
    return TagPath(instants, positions, turns)


def _least_turning(poses: Sequence[TagPose]) -> NDArray[np.intp]:
    """Return the index of the pose of each picture, from the first to the last, with least cost (Viterbi)."""
    costs = 4.0 * np.square(poses[0].errors / CORNER)
    back = []
    for before, now in zip(poses[:-1], poses[1:], strict=True):
        cosines = (np.einsum('iab,jab->ij', before.rotations, now.rotations) - 1.0) / 2.0
        steps = costs[:, None] + np.square(np.arccos(np.clip(cosines, -1.0, 1.0)) / TURN)
        back.append(steps.argmin(axis=0))
        costs = steps.min(axis=0) + 4.0 * np.square(now.errors / CORNER)
    choice = [int(costs.argmin())]
    for step in reversed(back):
        choice.append(int(step[choice[-1]]))
    return np.array(choice[::-1])


def _smoothed(times: Floats, places: Floats, rotations: Rotation) -> tuple[Floats, Rotation]:
    """Return positions (n, 3) and rotations, each from the parabola through those of nearby times."""
    smooth, turns = places.copy(), rotations.as_quat()
    for k, time in enumerate(times):
        near = np.abs(times - time) <= 2.5 * WINDOW
        apart = (times[near] - time) / WINDOW
        degree = min(2, int(near.sum()) - 1)
        root = np.exp(-np.square(apart) / 4.0)
        basis = apart[:, None] ** np.arange(degree + 1)
        turned = (rotations[near] * rotations[k].inv()).as_rotvec()
        values = np.column_stack([places[near], turned])
        fitted = np.linalg.lstsq(basis * root[:, None], values * root[:, None], rcond=None)[0][0]
        smooth[k] = fitted[:3]
        turns[k] = (Rotation.from_rotvec(fitted[3:]) * rotations[k]).as_quat()
    return smooth, Rotation.from_quat(turns)
