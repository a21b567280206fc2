# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Tracker: follows a DLO from image to image.

The tracer finds the line in the first image.  In each further one the line is expected where it moved to;
beside it, strips of the image say where it is now (`middle_line`); the elastic line through these places
(`elastic`) keeps its length, and bridges what is hidden.  At last the image is compared with the line: what
does not look like the DLO is not seen; a line that explains too little, or leaves too much unexplained, is
lost, unless it goes on there.  Which end, or which other part, a hand lifts, is guessed (`lift`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, label
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.vision.elastic import directions, Evidence, fitted
from dlo_calibration.vision.lift import Lift
from dlo_calibration.vision.middle_line import (
    along_line,
    arc_lengths,
    best_columns,
    edge_near,
    edges,
    end_near,
    evenly,
    evidence_of,
    learn_colours,
    odds,
    scores_of,
    straighten,
)
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.ridge import Singles
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.tracer import Tracer

Bools = NDArray[np.bool_]

COUNT = 61  # points along the DLO
STATIONS = (60, 130)  # of the line that is tracked, at least and at most
STATION = 0.9  # half widths between them
FAR = (9.0, 4.0, 2.4)  # half widths: how far each of the strips reaches beside the line
WIDER = 16.0  # the same of the first one, after the DLO was lost
STEPS = (0.25, 0.2, 0.08)  # half widths between the offsets of each of them
DRIFT = 0.15
SIGMA = (0.5, 0.3, 0.1)  # half widths: standard deviation of the places that each of them gives
STRETCH = 0.02  # of a segment's length: standard deviation; a part in the air looks longer
UNSCALED_STRETCH = 0.05  # the same in a picture without a scale
BEND = 0.01  # half widths, standard deviation of a change of second differences from image to image
KEPT = 0.9  # share of the bends that the line keeps from image to image where the DLO is not seen
FREE = (10.0, 1.5)  # half widths, deviation from where the line is expected: if an end is seen, or none
STILL = 0.02  # the same along a part that does not move, while another part is in the air
END = 0.1  # half widths, standard deviation of an end
HIDDEN = 0.1  # of the weight of the place that is seen best, below which one is hidden
SHORTEST = 0.4  # share by which a segment in the air can look shorter
MOVES = 0.12  # half widths from image to image, from which on a part moves
TOLERANCE = 0.006  # share of the length on a table that a line between two visible ends may lack
UNSCALED = 0.04  # the same in a picture without a scale
BLURRED = 3.0  # px that it may lack besides, as ends are blurred
BEYOND = 6.0  # half widths behind the last part that looks like the DLO, from which on its end is looked for
LONGEST_TIP = 14  # half widths by which the line may be too short
FAN = np.radians(np.arange(-50.0, 51.0, 10.0))  # directions in which the DLO may go on
REACHES = np.array([0.4, 0.8, 1.2, 1.6])  # half widths, where colours are read in each of them
OTHERS = 5e-4  # share of each colour, e.g. of 2000 colours of hands: a rare colour of the DLO may be theirs
SEEN = 0.35  # mean logarithm of the odds of a colour from which on the DLO is seen
SIDES = np.array([-2.6, -2.2, -1.8, 1.8, 2.2, 2.6])  # half widths beside the DLO, where the ground is seen
STRANGE = 16.0  # distance in L, a, b of what is behind an end, from which on it is probably covered
APART = 0.6  # half widths between the line and where the image shows it, from which on it is not seen
STRANGE_ALONE = 6.0  # the same, as a mean, where the other end is not seen
LEAST = 0.3  # share of the line that must be seen
UNEXPLAINED = 0.06  # of the DLO's area: more of its colour elsewhere than usual is too much
SHOWN = 0.2  # share of the DLO's area that has its colour in the first image, at least
ADAPTED = 0.05  # share by which what is usual follows each image
DAMPED = 0.7  # of the velocity that remains
REDUCED = 4.0  # px, width of the DLO in the picture in which colours are counted
ALIKE = 0.75  # share of the DLO's usual logarithm of the odds from which on a place there has its colour
SHEET_ALIKE = 0.1  # share of the sheet that has the DLO's colour, from which on it hides the DLO
COVER = (255, 0, 255)  # red, green, blue of such a sheet in the image that is searched
SEARCHES = 10  # images from one search of the whole picture to the next
ELSEWHERE = 'the DLO is also where the line is not: move it slowly, or start again with new clicks'
NO_END = "neither end is seen, and the sheet has the DLO's colour: lay it where the DLO does not come"
WHOLE = 0.8  # share of a line that must be seen where all of it was searched
BRIDGED = 6  # points that tell the direction of a line where it is hidden
WRONG_LENGTH = 0.05  # share of the length by which a line that is found again may differ


@dataclass(frozen=True, eq=False)
class Tracked:
    """
    Where a DLO is in an image.

    :param pixels: (count, 2) [px], evenly along the DLO: the same material points in each image; not a number
        where the DLO is not seen.
    :param width: of the DLO [px].
    :param reason: why the DLO is lost, one sentence; empty: it is not.
    """

    pixels: Floats
    width: float
    reason: str = ''

    def __post_init__(self) -> None:
        object.__setattr__(self, 'pixels', frozen_array(self.pixels))

    @property
    def lost(self) -> bool:
        """Whether the DLO is lost; then no point is a number."""
        return bool(self.reason)


@dataclass(frozen=True, eq=False)
class _Line:
    """
    A line in an image.

    :param line: (n, 2) [px], evenly along the DLO.
    :param seen: (n,).
    :param ends: whether both ends are seen.
    :param excess: share of the length by which the line between two visible ends is too long.
    :param lift: which part a hand seems to lift.
    """

    line: Floats
    seen: Bools
    ends: tuple[bool, bool]
    excess: float
    lift: Lift


class Tracker:
    """
    Follows a DLO from image to image, forwards or backwards in time.

    :param count: of points along the DLO.
    :param sheet: corners (k, 2) on the table [m] of a sheet of paper, which may have the DLO's colour; None:
        there is none, or no scale.
    """

    def __init__(self, count: int = COUNT, sheet: Floats | None = None) -> None:
        self._count, self._sheet, self._hides = count, sheet, False

    def start(self, pixels: Pixels, clicks: ArrayLike, scale: Scale | None = None) -> Tracked:
        """
        Find the DLO in the first image.

        :param pixels: (h, w, 3) RGB.
        :param clicks: (k, 2) [px], k >= 2, rough, in order along the DLO.
        :param scale: of this image; None: the length is that in the picture.
        :raises InputError: where there is no DLO along the clicks.
        """
        trace = Tracer(pixels).trace(clicks)
        self._scale, half = scale, trace.width / 2
        count = int(np.clip(arc_lengths(trace.pixels)[-1] / (STATION * half), *STATIONS))
        flat = trace.pixels if scale is None else scale.to_table(trace.pixels)
        arc = arc_lengths(flat)
        line = along_line(trace.pixels, arc, np.linspace(0.0, arc[-1], count))
        self._length = float(arc[-1])
        self._half = half / float(np.median(self._finenesses(line)))  # in units of the length
        strip = straighten(pixels, line, np.full(count, half), np.arange(-2.4, 2.41, 0.08))
        self._table = learn_colours(strip, 0.5, (1.4, 2.4), OTHERS)
        middle = straighten(pixels, line, np.full(count, half), np.linspace(-0.4, 0.4, 5))
        self._alike = ALIKE * float(np.median(odds(self._table, middle.lab).mean(axis=1)))
        sure = np.interp(np.linspace(0, 1, count), np.linspace(0, 1, len(trace.sure)), trace.sure) > 0.5
        self._line = _Line(line, sure, (True, True), 0.0, Lift.of(line, np.zeros(2)))
        self._velocity: Floats = np.zeros_like(line)
        self._lost_for = 0
        self._shown = 1.0
        self._hides = self._like_sheet(pixels)
        self._usual, shown = self._unexplained(self._without_sheet(pixels), line)
        # Where it is thin or blurred, less than its area has its colour.
        self._shown = max(shown, SHOWN)
        self._usual /= self._shown
        return self._tracked()

    def next(self, pixels: Pixels, elapsed: float, scale: Scale | None = None) -> Tracked:
        """
        Find the DLO in the next image.

        :param pixels: (h, w, 3) RGB.
        :param elapsed: time since the image before, also where that was earlier [s]; not below 0.
        :param scale: of this image; None: that of the image before.
        """
        if scale is not None and self._scale is not None and scale is not self._scale:
            line, rested = (scale.to_pixels(self._scale.points(points))
                            for points in (self._line.line, self._line.lift.rested))
            if np.isfinite(line).all() and np.isfinite(rested).all():
                self._line = replace(self._line, line=line, lift=replace(self._line.lift, rested=rested))
        if scale is not None:
            self._scale = scale  # while nothing of the board is seen, the last one is the best guess
        pixels = self._without_sheet(pixels)
        before = self._line.line
        found = self._followed(pixels, before + self._velocity * elapsed, WIDER if self._lost_for else FAR[0])
        reason = self._doubt(pixels, found)
        if reason:
            again = self._rejoined(pixels, found) if reason == ELSEWHERE else None
            if again is None and self._lost_for % SEARCHES == SEARCHES - 1:
                again = self._searched(pixels)
            if again is not None:
                found, reason = again, ''
        if reason:
            self._lost_for += 1
            self._velocity = np.zeros_like(before)
            if reason in (ELSEWHERE, NO_END):  # from there, it may reach the rest in the next image
                self._line = found
            return Tracked(np.full((self._count, 2), np.nan), self._width(), reason)
        if self._lost_for or elapsed <= 0:
            self._velocity = np.zeros_like(before)
        else:
            change = (found.line - before) / elapsed
            self._velocity = DAMPED * gaussian_filter1d(change, 2.0, axis=0)
        self._lost_for = 0
        self._line = found
        return self._tracked()

    def _outline(self) -> NDArray[np.int32] | None:
        """Return the corners (k, 2) of the sheet [px]; None: it is unknown where it is."""
        if self._sheet is None or self._scale is None:
            return None
        corners = self._scale.to_pixels(np.column_stack([self._sheet, np.zeros(len(self._sheet))]))
        return np.rint(corners).astype(np.int32) if np.isfinite(corners).all() else None

    def _like_sheet(self, pixels: Pixels) -> bool:
        """Tell whether so much of the sheet has the DLO's colour that it hides the DLO."""
        outline, (mask, factor) = self._outline(), self._mask(pixels)
        if outline is None:
            return False
        paper = cv2.fillPoly(np.zeros(mask.shape, np.uint8), [outline // factor], 1) > 0
        return bool(paper.any() and mask[paper].mean() > SHEET_ALIKE)

    def _without_sheet(self, pixels: Pixels) -> Pixels:
        """Return an image in which a sheet of the DLO's colour is covered by a colour that nothing has."""
        outline = self._outline() if self._hides else None
        if outline is None:
            return pixels
        return np.asarray(cv2.fillPoly(pixels.copy(), [outline], COVER), np.uint8)

    def _tracked(self) -> Tracked:
        place = np.linspace(0, len(self._line.line) - 1, self._count)
        points = along_line(self._line.line, np.arange(float(len(self._line.line))), place)
        low, high = np.floor(place).astype(int), np.ceil(place).astype(int)
        points[~(self._line.seen[low] & self._line.seen[high])] = np.nan
        return Tracked(points, self._width())

    def _width(self) -> float:
        return 2.0 * self._half * float(np.median(self._finenesses(self._line.line)))

    def _finenesses(self, line: Floats) -> Floats:
        """Return the pixels (n - 1,) to a unit of the length, of each segment of a line (n, 2)."""
        if self._scale is None:
            return np.ones(len(line) - 1)
        there = np.linalg.norm(np.diff(self._scale.points(line), axis=0), axis=1)
        here = np.linalg.norm(np.diff(line, axis=0), axis=1)
        ratios = here / np.maximum(there, 1e-12)
        ratios[~np.isfinite(ratios)] = np.nanmedian(ratios)
        return np.asarray(ratios)

    def _followed(self, pixels: Pixels, expected: Floats, far: float) -> _Line:
        """Return the line near where it is expected."""
        height, width = pixels.shape[:2]
        found, line, count = self._line, expected, len(expected)
        measured, quality = line, np.zeros(count)
        for stage, (reach, step, sigma) in enumerate(zip((far, *FAR[1:]), STEPS, SIGMA, strict=True)):
            fineness = self._finenesses(line)
            half = self._half * np.append(fineness, fineness[-1])
            offsets = step * np.arange(-float(round(reach / step)), round(reach / step) + 1)
            strip = straighten(pixels, line, half, offsets)
            index, quality = self._places(strip, stage, line, half)
            chosen = offsets[index]
            inside = ((line > 0) & (line < (width - 1, height - 1))).all(axis=1)
            quality = quality * inside
            if stage == len(FAR) - 1:
                chosen = gaussian_filter1d(quality * chosen, 1.0) / np.maximum(
                    gaussian_filter1d(quality, 1.0), 1e-3)
            measured = strip.at(chosen)
            usual = float(np.median(half))
            ends = [self._end(pixels, line[::order], half[::order], measured[::order], quality[::order])
                    for order in (1, -1)]
            found = self._elastic(line, measured, quality / (sigma * usual) ** 2, expected, ends, usual,
                                  fineness)
            line = found.line
        tangents = directions(line)
        normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
        apart = np.abs(((line - strip.at(chosen)) * normals).sum(axis=1)) / usual
        fineness = self._finenesses(line)
        half = self._half * np.append(fineness, fineness[-1])
        strip = straighten(pixels, line, half, np.linspace(-0.6, 0.6, 9))
        colours = gaussian_filter1d(odds(self._table, strip.lab).mean(axis=1, dtype=float), 1.0,
                                    mode='nearest')
        inside = ((line > -0.5) & (line < (width - 0.5, height - 0.5))).all(axis=1)
        seen = (colours > SEEN) & (apart < APART) & inside
        # One station alone is a coincidence.
        seen = gaussian_filter1d(seen.astype(float), 1.0, mode='nearest') > 0.5
        return replace(found, seen=seen & inside)

    def _places(self, strip: Any, stage: int, line: Floats, half: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Return the offset's index (n,) where the DLO is in a strip, and how sure that is (n,), 0 to 1."""
        logarithms = odds(self._table, strip.lab)
        self._without_others(logarithms, strip, line, half)
        logarithms = gaussian_filter1d(logarithms, 0.8, axis=0)
        step = float(strip.offsets[1] - strip.offsets[0])
        strength = edges(strip, 1.0)
        scores = scores_of(strip, evidence_of(strip, strength, logarithms), 1.0)
        scores = scores - np.float32(0.004 if stage else 0.01) * np.square(strip.offsets).astype(np.float32)
        index = best_columns(scores[None], DRIFT * min(1.0, step / 0.2))[0][0]
        reach = round(0.6 / step)
        around = np.clip(index[:, None] + np.arange(-reach, reach + 1), 0, len(strip.offsets) - 1)
        inside = np.take_along_axis(logarithms, around, axis=1).mean(axis=1, dtype=float)
        return index, np.clip((inside - 0.2) / 1.0, 0.0, 1.0) ** 2

    @staticmethod
    def _without_others(logarithms: Singles, strip: Any, line: Floats, half: Floats) -> None:
        """Take the colours of other strands of the DLO out of a strip."""
        reach = float(np.abs(strip.offsets).max() + 1.5) * half
        distance = np.linalg.norm(line[:, None] - line, axis=2)
        arc = arc_lengths(line)
        # Another strand is much farther along the line than through the air.
        apart: Bools = np.abs(arc[:, None] - arc) > 2.0 * distance + 4.0 * half[:, None]
        near = np.asarray(apart & (distance < reach[:, None]))
        for row in np.flatnonzero(near.any(axis=1)):
            others = line[near[row]]
            at = strip.line[row] + (strip.offsets * strip.half[row])[:, None] * strip.normals[row]
            explained = np.linalg.norm(at[:, None] - others, axis=2).min(axis=1) < 1.1 * half[row]
            logarithms[row, explained] = 0.0

    def _end(self, pixels: Pixels, line: Floats, half: Floats, measured: Floats,
             quality: Floats) -> tuple[Floats, float] | None:
        """
        Return the end near the first point of a line; None: it is not seen.

        :returns: the place (2,) [px], and the distance in L, a, b of what is behind it from what is beside
            it, which is large where something covers the DLO from there on.
        """
        h = float(half[0])
        # The DLO's last part, as far as it is seen.
        near = np.flatnonzero(quality[:30] > 0.3)
        if len(near) < 4:
            return None
        first = near[0]
        part = measured[first:first + 8]
        towards = part[0] - part[-1]
        towards = towards / max(float(np.linalg.norm(towards)), 1e-9)
        tip, towards = self._tip(pixels, part[0], towards, h)
        way = evenly(np.concatenate([tip[-1:] + BEYOND * h * towards, tip[::-1], measured[first:first + 14]]),
                     0.2 * h)
        height, width = pixels.shape[:2]
        arc = arc_lengths(way)
        inside = np.asarray(((way > 0) & (way < (width - 1, height - 1))).all(axis=1))
        if not inside[arc > (BEYOND - 3) * h].all():
            return None
        strip = straighten(pixels, way, np.full(len(way), h), np.linspace(-0.25, 0.25, 5))
        logarithms = odds(self._table, strip.lab).mean(axis=1, dtype=float)
        logarithms[~inside] = -1.0
        end = end_near(arc, logarithms, BEYOND * h, 5 * h + float(arc_lengths(tip)[-1]))
        if end is None:
            return None
        end = edge_near(arc, strip, end, 0.5 * h)
        # The ground beside the last part, and what is behind the end.
        beside = straighten(pixels, way, np.full(len(way), h), SIDES).lab
        last = (arc > end + 0.5 * h) & (arc < end + 5 * h)
        behind = strip.lab[(arc < end - 0.8 * h) & (arc > end - 3.0 * h)].reshape(-1, 3)
        if not len(behind) or not last.any():
            return None
        sides = [beside[last][:, part].reshape(-1, 3).mean(axis=0) for part in (slice(0, 3), slice(3, 6))]
        strange = min(float(np.linalg.norm(behind.mean(axis=0) - side)) for side in sides)
        return np.asarray(along_line(way, arc, [end])[0]), strange

    def _tip(self, pixels: Pixels, begin: Floats, towards: Floats, half: float) -> tuple[Floats, Floats]:
        """Follow the DLO's colour from a point (2,) [px]; return the points (n, 2) and the last direction."""
        points = [begin]
        for _ in range(LONGEST_TIP):
            turned = np.stack([np.cos(FAN), np.sin(FAN)], axis=1)
            ways = np.stack([turned @ (towards * (1, -1)), turned @ towards[::-1]], axis=1)
            at = (points[-1] + half * REACHES[:, None] * ways[:, None]).astype(np.float32)
            colours: Any = cv2.remap(pixels, at[..., 0], at[..., 1], cv2.INTER_LINEAR,
                                     borderMode=cv2.BORDER_REPLICATE)
            lab: Any = cv2.cvtColor(colours.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2Lab)
            logarithms = odds(self._table, lab).mean(axis=1, dtype=float)
            best = int(np.argmax(logarithms - FAN ** 2))
            if logarithms[best] < SEEN:
                break
            towards = ways[best]
            points.append(points[-1] + half * towards)
        return np.array(points), towards

    def _elastic(self, line: Floats, measured: Floats, across: Floats, expected: Floats,
                 ends: list[tuple[Floats, float] | None], half: float,
                 fineness: Floats) -> _Line:
        """Return the elastic line; what is seen of it is still that of the last image."""
        count = len(line)
        lengths = self._length / (count - 1) * fineness
        stretch = UNSCALED_STRETCH if self._scale is None else STRETCH
        known = Evidence(
            measured, across, expected, np.full(count, 1.0 / (FREE[0] * half) ** 2),
            0.2 / (FREE[0] * half) ** 2, lengths, 1.0 / (stretch * float(lengths.mean())) ** 2,
            1.0 / (BEND * half) ** 2, np.where(self._line.seen[1:-1], 1.0, KEPT),
            np.zeros((2, 2)), np.zeros(2))
        tolerance = UNSCALED if self._scale is None else TOLERANCE
        tolerance += BLURRED / float(arc_lengths(line)[-1])
        accepted = [end is not None for end in ends]
        places = np.array([line[k] if end is None else end[0] for k, end in zip((0, -1), ends, strict=True)])
        strange = [0.0 if end is None else end[1] for end in ends]
        covered = int(np.argmax(strange))
        lift = self._line.lift.behind([None if end is None else end[1] for end in ends])
        if (strange[covered] > STRANGE > strange[1 - covered]
                or not all(accepted) and lift.strange[covered] > STRANGE_ALONE):
            accepted[covered] = False
        while True:
            weights = np.where(accepted, 1.0 / (END * half) ** 2, 0.0)
            if not any(accepted):
                known = replace(known, along=np.full(count, 1.0 / (FREE[1] * half) ** 2))
            fit = fitted(line, replace(known, ends=places, end_weights=weights))
            if not all(accepted):
                return replace(self._line, line=fit, ends=(accepted[0], accepted[1]), excess=0.0, lift=lift)
            excess = float((np.linalg.norm(np.diff(fit, axis=0), axis=1) / fineness).sum() / self._length - 1)
            lift = lift.seen(fit, places, across > HIDDEN * across.max(), MOVES * half)
            # Behind an end that a hand holds is something else than beside it, and it may be in the air.
            if lift.raises or ((abs(excess) <= tolerance / 4) if lift.held else (excess >= -tolerance)):
                break
            # What covers an end makes the DLO look shorter, and so does an end that is held in the air; both
            # move.
            moved = np.linalg.norm(places - self._line.line[[0, -1]], axis=1)
            accepted[int(np.argmax(lift.strange if lift.held else moved))] = False
        found = replace(self._line, line=fit, ends=(True, True), excess=excess, lift=lift)
        if abs(excess) <= tolerance:
            return replace(found, lift=Lift.of(fit, lift.strange))
        known = replace(known, ends=places, end_weights=weights)
        if lift.raises:
            # A part in the air looks longer, or shorter where it rises towards the hand.
            share = lift.share(count - 1)
            looks = np.maximum(excess * share / share.mean(), -SHORTEST)
            return replace(found, line=fitted(fit, replace(known, lengths=lengths * (1.0 + looks))))
        # A part in the air looks longer: it is one that moves, or is hidden.
        normals = np.column_stack([-directions(line)[:, 1], directions(line)[:, 0]])
        change = np.abs(((fit - self._line.line) * normals).sum(axis=1))
        loose = (change > MOVES * half) | (across < HIDDEN * across.max())
        moving = gaussian_filter1d(loose.astype(float), 3.0, mode='nearest')
        still = np.where(moving > 0.05, known.along, 1.0 / (STILL * half) ** 2)
        return replace(found, line=fitted(fit, replace(known, along=still)))

    def _doubt(self, pixels: Pixels, found: _Line) -> str:
        """Return why a line is none, one sentence; empty: it is one."""
        height, width = pixels.shape[:2]
        if not np.isfinite(found.line).all():
            return 'the line could not be fitted: start again with new clicks'
        inside = ((found.line > 0) & (found.line < (width - 1, height - 1))).all(axis=1)
        if inside.mean() < LEAST:
            return 'the DLO has left the picture: show it again'
        if found.seen.mean() < LEAST:
            return 'too little of the DLO is seen: take hands out of the way, and move it slowly'
        if self._hides and not any(found.ends):
            return NO_END
        unexplained, _ = self._unexplained(pixels, found.line)
        if unexplained > self._usual + UNEXPLAINED:
            return ELSEWHERE
        # The picture of a camera in the hand shows more or less of other things.
        self._usual += ADAPTED * (unexplained - self._usual)
        return ''

    def _mask(self, pixels: Pixels) -> tuple[Bools, int]:
        """Return where the picture, reduced, has the DLO's colour, and by what it was reduced."""
        factor = max(1, int(self._width() / REDUCED))
        lab: Any = cv2.cvtColor(pixels[::factor, ::factor].astype(np.float32) / np.float32(255),
                                cv2.COLOR_RGB2Lab)
        # A mixture of colours, as of skin, has some pixels of the DLO's colour; the DLO has no others.
        side = max(2, round(0.6 * self._width() / factor))
        return np.asarray(cv2.blur(odds(self._table, lab), (side, side)) > self._alike), factor

    def _unexplained(self, pixels: Pixels, line: Floats) -> tuple[float, float]:
        """Return the areas with the DLO's colour elsewhere and at the line, as shares of the usual one."""
        elsewhere, own, factor = self._elsewhere(pixels, line)
        usual = self._shown * max(self._width() * float(arc_lengths(line)[-1]), 1.0) / factor ** 2
        return np.count_nonzero(elsewhere) / usual, own / usual

    def _elsewhere(self, pixels: Pixels, line: Floats) -> tuple[Bools, int, int]:
        """Return where else a reduced picture shows the DLO, how much the line does, and the reduction."""
        thick = self._width()
        mask, factor = self._mask(pixels)
        covered = np.zeros(mask.shape, np.uint8)
        points = np.rint(line / factor * 16).astype(np.int32)
        cv2.polylines(covered, [points], False, 1, round(2.5 * thick / factor + 2), cv2.LINE_8, 4)
        elsewhere: Any = (mask & (covered == 0)).astype(np.uint8)
        # What is thicker than the DLO, or not much longer than thick, is another thing, say a hand.
        kernel = np.ones((round(1.7 * thick / factor) + 1,) * 2, np.uint8)
        elsewhere &= 1 - cv2.morphologyEx(elsewhere, cv2.MORPH_OPEN, kernel)
        _, parts, each, _ = cv2.connectedComponentsWithStats(elsewhere)
        large = each[:, cv2.CC_STAT_AREA] * float(factor ** 2) > 2.0 * self._shown * thick ** 2
        large[0] = False
        return np.asarray(large[parts]), int(np.count_nonzero(mask & (covered == 1))), factor

    def _searched(self, pixels: Pixels) -> _Line | None:
        """Return the line found anywhere in the picture; None: there is none that is sure."""
        mask, factor = self._mask(pixels)
        rough = _largest_path(mask, factor)
        if rough is None:
            return None
        if np.linalg.norm(rough[0] - self._line.line[0]) + np.linalg.norm(rough[-1] - self._line.line[-1]) > (
                np.linalg.norm(rough[0] - self._line.line[-1])
                + np.linalg.norm(rough[-1] - self._line.line[0])):
            rough = rough[::-1]
        return self._checked(pixels, rough, WHOLE)

    def _rejoined(self, pixels: Pixels, found: _Line) -> _Line | None:
        """Return the line that goes on where its rest comes out of what hides it; None: none is sure."""
        elsewhere, _, factor = self._elsewhere(pixels, found.line)
        path = _largest_path(elsewhere, factor)
        if path is None or all(found.ends):
            return None
        order = -1 if found.ends[1] else 1
        line = found.line[::order]
        line = line[:np.flatnonzero(found.seen[::order])[-1] + 1]
        # The DLO ends where the path is farther away.
        if np.linalg.norm(path[0] - line[-1]) > np.linalg.norm(path[-1] - line[-1]):
            path = path[::-1]
        rest = self._length - self._long(line) - self._long(path)
        bridge = self._bridge(line[-BRIDGED:], path[:BRIDGED], rest)
        if bridge is None:
            return None
        return self._checked(pixels, np.concatenate([line, bridge, path])[::order], LEAST)

    def _long(self, line: Floats) -> float:
        return float(arc_lengths(line if self._scale is None else self._scale.points(line))[-1])

    def _bridge(self, before: Floats, after: Floats, length: float) -> Floats | None:
        """Return the smooth curve (n, 2) [px] of a length from one line to another; None: none has it."""
        share = np.linspace(0.0, 1.0, 22)[1:-1]
        gap = after[0] - before[-1]
        ways = [directions(part[[0, -1]])[0] for part in (before, after)]
        low, high = 0.0, 3.0
        for _ in range(20):
            middle = (low + high) / 2
            first, second = (middle * float(np.linalg.norm(gap)) * one for one in ways)
            curve = CubicHermiteSpline((0.0, 1.0), (before[-1], after[0]), (first, second))(share)
            excess = self._long(np.concatenate([before[-1:], curve, after[:1]])) / max(length, 1e-9) - 1
            low, high = (middle, high) if excess < 0 else (low, middle)
        return curve if abs(excess) < WRONG_LENGTH else None

    def _checked(self, pixels: Pixels, rough: Floats, least: float) -> _Line | None:
        """Return the line near a rough one (n, 2) [px], of which so much is seen; None: it is not sure."""
        smooth = gaussian_filter1d(evenly(rough, self._width() / REDUCED), 3.0, axis=0, mode='nearest')
        kept, count = self._line, len(self._line.line)
        arc = arc_lengths(smooth if self._scale is None else self._scale.points(smooth))
        if not abs(arc[-1] / self._length - 1) < 2 * WRONG_LENGTH:
            return None
        line = along_line(smooth, arc, np.linspace(0, arc[-1], count))
        self._line = _Line(line, np.ones(count, bool), (True, True), 0.0, Lift.of(line, np.zeros(2)))
        found = self._followed(pixels, line, FAR[1])
        if (self._doubt(pixels, found) or found.seen.mean() < least or not all(found.ends)
                or abs(found.excess) > WRONG_LENGTH):
            self._line = kept
            return None
        return found


def _largest_path(mask: Bools, factor: int) -> Floats | None:
    """Return the path (n, 2) [px] along the largest area of a mask that was reduced; None: there is none."""
    parts, number = label(mask, np.ones((3, 3)))
    if not number:
        return None
    sizes = np.bincount(parts.ravel())[1:]
    v, u = np.nonzero(parts == int(np.argmax(sizes)) + 1)
    path = _longest(u, v, mask)
    return path * factor if len(path) >= 8 else None


def _longest(u: NDArray[np.int64], v: NDArray[np.int64], mask: Bools) -> Floats:
    """Return the path (n, 2) between the two places of an area that are farthest apart within it."""
    depth = distance_transform_edt(mask)[v, u]
    index = np.full(mask.shape, -1)
    index[v, u] = np.arange(len(u))
    rows, columns, costs = [], [], []
    height, width = mask.shape
    for x, y in ((1, 0), (0, 1), (1, 1), (-1, 1)):
        inside = (u + x >= 0) & (u + x < width) & (v + y < height)
        other = index[(v + y)[inside], (u + x)[inside]]
        pairs = np.flatnonzero(inside)[other >= 0]
        other = other[other >= 0]
        rows.append(pairs)
        columns.append(other)
        costs.append(np.hypot(x, y) * (1.0 + 2.0 / np.minimum(depth[pairs], depth[other]) ** 2))
    graph = coo_matrix((np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))),
                       shape=(len(u), len(u))).tocsr()
    begin = 0
    for _ in range(2):
        far, before = dijkstra(graph, False, begin, return_predecessors=True)
        start, begin = begin, int(np.argmax(np.where(np.isfinite(far), far, -1.0)))
    path = [begin]
    while path[-1] != start and before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return np.column_stack([u[path], v[path]]).astype(float)
