# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Tracker: follows a DLO from image to image.

The tracer finds the line in the first image, where its `appearance` is learned.  In each further image the
line is near where it is expected (`followed_line`).  It ends where the DLO does (`line_end`), keeps its
length, bridges what is hidden (`elastic_line`), and goes straight on where a loop closes (`loop`).  A line
that explains too little, or leaves too much unexplained, is lost, unless the parts that the whole picture
shows (`line_search`) can be joined (`joined_line`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d, label
from scipy.spatial import cKDTree

from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.vision.appearance import Appearance, Bools
from dlo_calibration.vision.dlo_image import DloImage
from dlo_calibration.vision.elastic import directions
from dlo_calibration.vision.elastic_line import TrackedLine
from dlo_calibration.vision.followed_line import FAR, followed
from dlo_calibration.vision.ground import Ground
from dlo_calibration.vision.joined_line import IN_AIR, joined, WRONG_LENGTH
from dlo_calibration.vision.lift import Lift
from dlo_calibration.vision.line_search import area, coloured, paths, REDUCED, reduction, shown_places
from dlo_calibration.vision.loop import straight_on
from dlo_calibration.vision.middle_line import along_line, arc_lengths, evenly
from dlo_calibration.vision.photograph import Pixels
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.sheet import COVER, NO_SHEET, Sheet
from dlo_calibration.vision.tracer import Tracer

COUNT = 61  # points along the DLO
STATIONS = (60, 130)  # of the line that is tracked, at least and at most
STATION = 0.9  # half widths between them
WIDER = 16.0  # half widths: how far the first strip reaches beside the line, after the DLO was lost
LEAST = 0.3  # share of the line that must be seen
UNEXPLAINED = 0.06  # of the DLO's area: more of its colour elsewhere than usual is too much
LEAST_PART = 3.0  # widths long: what is shorter may be a finger
SHOWN = 0.2  # share of the DLO's area that has its colour in the first image, at least
ADAPTED = 0.05  # share by which what is usual follows each image
DAMPED = 0.7  # of the velocity that remains
SHEET_ALIKE = 0.1  # share of a part of the sheet that has the DLO's colour, from which on it hides the DLO
SEARCHES = 10  # images from one search of the whole picture to the next
ELSEWHERE = 'the DLO is also where the line is not: move it slowly, or start again with new clicks'
COVERED = 0.7  # share of the curves between parts of the DLO where something covers the ground, at least
GAP = 0.05  # share of the line: in a longer gap, a hand may hide more or less of the DLO than the line has
TIP = 4  # stations at an end that may not be seen, though the end is
LAST = 4  # stations at an end, whose direction goes on beyond it
PARTS = 4  # of the DLO between what hides it, at most, from which the line is assembled


@dataclass(frozen=True, eq=False)
class Tracked:
    """
    Where a DLO is in an image.

    :param pixels: (count, 2) [px], evenly along the DLO: the same material points in each image; not a number
        where the DLO is not seen, nor beyond a longer part that a hand hides while the end there is not seen.
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


class Tracker:
    """
    Follows a DLO from image to image, forwards or backwards in time.

    :param count: of points along the DLO.
    :param sheet: on the table, of which parts may have the DLO's colour.
    """

    def __init__(self, count: int = COUNT, sheet: Sheet = NO_SHEET) -> None:
        self._count, self._sheet, self._hide = count, sheet, np.zeros(len(sheet.parts), bool)

    def start(self, pixels: Pixels, clicks: ArrayLike, scale: Scale | None = None) -> Tracked:
        """
        Find the DLO in the first image.

        :param pixels: (h, w, 3) RGB.
        :param clicks: (k, 2) [px], k >= 2, rough, in order along the DLO.
        :param scale: of this image; None: the length is that in the picture.
        :raises InputError: where there is no DLO along the clicks.
        """
        trace = Tracer(pixels).trace(clicks)
        count = int(np.clip(arc_lengths(trace.pixels)[-1] / (STATION * trace.width / 2), *STATIONS))
        arc = arc_lengths(trace.pixels if scale is None else scale.to_table(trace.pixels))
        line = along_line(trace.pixels, arc, np.linspace(0.0, arc[-1], count))
        sure = np.interp(np.linspace(0, 1, count), np.linspace(0, 1, len(trace.sure)), trace.sure) > 0.5
        self._scale = scale
        self._dlo = Appearance.of(pixels, line, trace.width / 2, scale)
        self._line = TrackedLine(line, sure, (True, True), 0.0, Lift.of(line, np.zeros(2)))
        self._velocity: Floats = np.zeros_like(line)
        self._lost_for = 0
        self._assembled = False  # of parts, whose ends have not been seen since
        self._shown = 1.0
        self._ground = Ground(pixels, scale, line, self._dlo.halves(line, scale))
        self._hide = self._alike(DloImage(pixels, scale, self._dlo, self._ground))
        image = self._image(pixels)
        factor = reduction(image.width(line))
        own, others = (area(mask, factor) for mask in shown_places(image, line, self._shown))
        # Where it is thin or blurred, less than its area has its colour.
        self._shown = max(own / self._expected_area(image, line), SHOWN)
        self._usual = others / self._expected_area(image, line)
        return self._tracked(image)

    def next(self, pixels: Pixels, elapsed: float, scale: Scale | None = None) -> Tracked:
        """
        Find the DLO in the next image.

        :param pixels: (h, w, 3) RGB.
        :param elapsed: time since the image before, also where that was earlier [s]; not below 0.
        :param scale: of this image; None: that of the image before.
        """
        self._rescale(scale)
        image, before = self._image(pixels), self._line
        found = self._followed(image, elapsed)
        reason, again = self._doubt(image, found), None
        if reason == ELSEWHERE or reason and self._lost_for % SEARCHES == SEARCHES - 1:
            again = self._again(image, found)
        if again is not None:
            found, self._assembled = again, True
        elif reason:
            self._lost_for += 1
            self._velocity = np.zeros_like(before.line)
            if reason == ELSEWHERE:  # from there, it may reach the rest in the next image
                self._line = found
            return Tracked(np.full((self._count, 2), np.nan), image.width(self._line.line), reason)
        if again is not None or self._lost_for or elapsed <= 0:
            self._velocity = np.zeros_like(before.line)
        else:
            change = (found.line - before.line) / elapsed
            if not any(found.ends):  # how it slides along itself is not seen
                tangents = directions(found.line)
                change -= (change * tangents).sum(axis=1, keepdims=True) * tangents
            self._velocity = DAMPED * gaussian_filter1d(change, 2.0, axis=0)
        self._lost_for = 0
        self._line = found
        self._assembled &= not all(found.ends)
        return self._tracked(image)

    def _rescale(self, scale: Scale | None) -> None:
        """Move the line to where it is in a picture of another scale; None: the last one is best."""
        if scale is not None and self._scale is not None and scale is not self._scale:
            line, rested = (scale.to_pixels(self._scale.points(points))
                            for points in (self._line.line, self._line.lift.rested))
            if np.isfinite(line).all() and np.isfinite(rested).all():
                self._line = replace(self._line, line=line, lift=replace(self._line.lift, rested=rested))
        if scale is not None:
            self._scale = scale

    def _image(self, pixels: Pixels) -> DloImage:
        """Return an image in which the parts of the sheet that hide the DLO are covered."""
        if self._scale is None or not self._hide.any():
            return DloImage(pixels, self._scale, self._dlo, self._ground)
        covered = self._sheet.drawn(self._scale, pixels.shape[:2], self._hide)
        u, v, width, height = cv2.boundingRect(covered)
        part = np.s_[v:v + height, u:u + width]
        pixels = pixels.copy()
        pixels[part][covered[part] > 0] = COVER
        return DloImage(pixels, self._scale, self._dlo, self._ground, covered > 0)

    def _alike(self, image: DloImage) -> Bools:
        """Tell which parts of the sheet have so much of the DLO's colour that they hide it."""
        found = np.zeros(len(self._sheet.parts), bool)
        if self._scale is not None:
            width = image.width(self._line.line)
            step, mask = reduction(width), coloured(image, width)
            numbers = range(1, len(found) + 1)
            shown = self._sheet.drawn(self._scale, image.pixels.shape[:2], numbers)[::step, ::step]
            for number in numbers[1:]:
                part = shown == number
                found[number - 1] = part.any() and mask[part].mean() > SHEET_ALIKE
            found[:1] = found.any()
        return found

    def _tracked(self, image: DloImage) -> Tracked:
        place = np.linspace(0, len(self._line.line) - 1, self._count)
        points = along_line(self._line.line, np.arange(float(len(self._line.line))), place)
        low, high = np.floor(place).astype(int), np.ceil(place).astype(int)
        seen, ends = self._line.seen, self._line.ends
        if self._assembled or any(ends):
            # A hand may hide more or less than that: only what a visible end is part of counts.
            shown = seen | ~image.inside(self._line.line, 0.0)
            hidden = np.cumsum(_long_gaps(shown, 0.0 if self._assembled else GAP * len(seen)))
            seen = seen & (ends[0] & (hidden == 0) | ends[1] & (hidden == hidden[-1]))
        points[~(seen[low] & seen[high])] = np.nan
        return Tracked(points, image.width(self._line.line))

    def _expected_area(self, image: DloImage, line: Floats) -> float:
        """Return the area that usually has the DLO's colour [px^2]."""
        return self._shown * max(image.width(line) * float(arc_lengths(line)[-1]), 1.0)

    def _followed(self, image: DloImage, elapsed: float) -> TrackedLine:
        """Return the line near where it is expected, along its loop the way in which it goes straight on."""
        found = followed(image, self._line, self._line.line + self._velocity * elapsed,
                         WIDER if self._lost_for else FAR[0])
        if not np.isfinite(found.line).all():
            return found
        line = straight_on(found.line, image.width(found.line))
        return found if line is found.line else followed(image, replace(found, line=line), line, FAR[1])

    def _doubt(self, image: DloImage, found: TrackedLine) -> str:
        """Return why a line is none, one sentence; empty: it is one."""
        if not np.isfinite(found.line).all():
            return 'the line could not be fitted: start again with new clicks'
        if image.inside(found.line, 0.0).mean() < LEAST:
            return 'the DLO has left the picture, or lies on a sheet of its colour: show it again'
        if found.seen.mean() < LEAST:
            return 'too little of the DLO is seen: take hands out of the way, and move it slowly'
        _, others = shown_places(image, found.line, self._shown)
        width = image.width(found.line)
        unexplained = area(others, reduction(width)) / self._expected_area(image, found.line)
        least = LEAST_PART * width / float(arc_lengths(found.line)[-1])
        if unexplained > self._usual + max(UNEXPLAINED, least):
            return ELSEWHERE
        # The picture of a camera in the hand shows more or less of other things.
        self._usual += ADAPTED * (unexplained - self._usual)
        return ''

    def _again(self, image: DloImage, found: TrackedLine) -> TrackedLine | None:
        """Return the line along all parts of the DLO that the picture shows; None: it is not sure."""
        own, others = shown_places(image, found.line, self._shown)
        width = image.width(found.line)
        parts = [part for part in map(image.flat, paths(own | others, reduction(width)))
                 if np.isfinite(part).all()][:PARTS]
        if not parts or len(parts) > 1 and not any(found.ends):
            return None  # nothing says in which order they are
        for one in joined(parts, self._dlo.length, all(found.ends)):
            for order in (1, -1):
                line, curves = (points if image.scale is None else image.scale.to_pixels(points)
                                for points in (one.line[::order], one.curves))
                fits = self._agrees(line, found, width)
                if fits and (not len(curves) or image.hidden(curves).mean() > COVERED):
                    return self._checked(image, line, whole=len(parts) == 1)
        return None

    def _agrees(self, line: Floats, found: TrackedLine, width: float) -> bool:
        """Tell whether a line (n, 2) [px] has the ends that are seen, and runs as what is seen of another."""
        apart = np.linalg.norm(line[[0, -1]] - found.line[[0, -1]], axis=1)
        if any(found.ends):
            return bool((apart < 2 * width)[np.array(found.ends)].all())
        distances, nearest = cKDTree(line).query(found.line)
        known = np.flatnonzero(found.seen & (distances < width))
        if len(known) > 1 and np.ptp(nearest[known]):
            return bool(np.polyfit(known, nearest[known], 1)[0] > 0)
        return bool(apart.sum() < np.linalg.norm(line[[-1, 0]] - found.line[[0, -1]], axis=1).sum())

    def _checked(self, image: DloImage, rough: Floats, whole: bool) -> TrackedLine | None:
        """Return the line near a rough one (n, 2) [px], from end to end if whole; None: it is not sure."""
        smooth = gaussian_filter1d(evenly(rough, image.width(self._line.line) / REDUCED), 3.0, axis=0,
                                   mode='nearest')
        count = len(self._line.line)
        arc = image.arc_lengths(smooth)
        if not arc[-1] > (1 - (WRONG_LENGTH if whole else IN_AIR)) * self._dlo.length:
            return None
        line = along_line(smooth, arc, np.linspace(0, arc[-1], count))
        rests = TrackedLine(line, np.ones(count, bool), (True, True), 0.0,
                            Lift.of(line, np.full(2, np.nan)))
        found = followed(image, rests, line, FAR[1])
        if found.ends[0] != found.ends[1]:  # the rest of its length is hidden at the other end
            line = _from_end(image, line, 0 if found.ends[0] else 1, self._dlo.length)
            found = followed(image, replace(rests, line=line), line, FAR[1])
        sure = (all if whole else any)(found.ends) and -WRONG_LENGTH < found.excess < IN_AIR
        return found if sure and not self._doubt(image, found) else None


def _long_gaps(shown: Bools, longest: float) -> Bools:
    """Tell which points (n,) of a line lie in gaps of more than so many that are not shown; not at an end."""
    hidden = np.r_[np.full(TIP, False), ~shown[TIP:-TIP], np.full(TIP, False)]
    gaps, _ = label(hidden)
    return np.asarray(hidden & (np.bincount(gaps)[gaps] > longest))


def _from_end(image: DloImage, line: Floats, end: int, length: float) -> Floats:
    """Return a line (n, 2) [px] of some length from an end (0 or 1) of another one, which it prolongs."""
    way = line if end == 0 else line[::-1]
    arc = image.arc_lengths(way)
    slope = (way[-1] - way[-1 - LAST]) / (arc[-1] - arc[-1 - LAST])
    places = np.linspace(0.0, length, len(line))
    found = along_line(way, arc, places) + np.maximum(places - arc[-1], 0.0)[:, None] * slope
    return np.asarray(found if end == 0 else found[::-1])
