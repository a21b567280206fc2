# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The elastic line through what an image shows of a DLO.

It keeps its length between both ends.  Where it cannot, an end is covered, or a part of it is in the air,
which looks longer or shorter: that part is guessed (`lift`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Sequence

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.appearance import Bools
from dlo_calibration.vision.dlo_image import DloImage
from dlo_calibration.vision.elastic import Evidence, fitted
from dlo_calibration.vision.lift import Lift
from dlo_calibration.vision.line_end import LineEnd
from dlo_calibration.vision.middle_line import arc_lengths

STRETCH = 0.02  # of a segment's length: standard deviation; a part in the air looks longer
UNSCALED_STRETCH = 0.05  # the same in a picture without a scale
LOOSE = 0.01  # of the weight of the lengths, where it is measured how long the DLO looks
BEND = 0.01  # half widths, standard deviation of a change of second differences across it, between images
KEPT = 0.9  # share of the bends that the line keeps from image to image where the DLO is not seen
FREE = (10.0, 1.5)  # half widths, deviation from where the line is expected: if an end is seen, or none
STILL = 0.3  # the same, along the half of the DLO whose end is hidden by the hand that holds the other one
END = 0.1  # half widths, standard deviation of an end
HIDDEN = 0.1  # of the weight of the place that is seen best, below which one is hidden
GUESSED = 0.2  # of a segment's length: standard deviation of how long a part in the air looks
SHORTEST = 0.4  # share by which a segment in the air can look shorter
LONGEST = 1.0  # the same by which the DLO can look longer, as one high above the table does
MOVES = 0.12  # half widths from image to image, from which on a part moves
TOLERANCE = 0.006  # share of the length on a table that a line between two visible ends may lack
UNSCALED = 0.04  # the same in a picture without a scale
BLURRED = 3.0  # px that it may lack besides, as ends are blurred
STRANGE = 16.0  # distance in L, a, b of what is behind an end, from which on it is probably covered
STRANGE_ALONE = 6.0  # the same, as a mean, where the other end is not seen, and no hand seems to hold it


@dataclass(frozen=True, eq=False)
class TrackedLine:
    """
    A line in an image.

    :param line: (n, 2) [px], evenly along the DLO.
    :param seen: (n,).
    :param ends: whether both ends are seen.
    :param excess: share of the length by which the DLO looks too long, as far as that is known.
    :param lift: which part a hand seems to lift.
    """

    line: Floats
    seen: Bools
    ends: tuple[bool, bool]
    excess: float
    lift: Lift


@dataclass(frozen=True, eq=False)
class Shown:
    """
    What an image shows of a DLO.

    :param near: (n, 2) the line beside which it was looked for [px].
    :param measured: (n, 2) where it is beside that line [px].
    :param across: (n,) weight of that [1/px^2].
    :param expected: (n, 2) where it was expected [px].
    :param ends: both ends; None: not seen.
    :param half: half its width [px].
    """

    near: Floats
    measured: Floats
    across: Floats
    expected: Floats
    ends: tuple[LineEnd | None, LineEnd | None]
    half: float


def elastic_line(image: DloImage, before: TrackedLine, shown: Shown) -> TrackedLine:
    """Return the line through what an image shows; `seen` is still that of the line before."""
    lift = _held_now(before.lift, shown)
    if lift.hides is not None:
        first, last = shown.ends
        shown = replace(shown, ends=(None, last) if lift.hides == 0 else (first, None))
    fit = _Fit(image, before, shown, lift.hides)
    accepted = _uncovered(shown.ends, lift)
    if all(accepted):
        line = fit.through(accepted)
        excess = fit.excess(line)
        lift = lift.seen(line, fit.places, ~fit.hidden, MOVES * shown.half)
        # An end that a hand holds may be in the air.
        most_off = fit.tolerance / (4 if lift.shows_hand else 1)
        fits = excess >= -fit.tolerance if lift.held is None else abs(excess) <= most_off
        if lift.raises or fits:
            return fit.between_ends(line, excess, lift)
        # What covers an end makes the DLO look shorter, as does an end that is held in the air; both move.
        moved = np.linalg.norm(fit.places - before.line[[0, -1]], axis=1)
        unsure = int(np.argmax(moved)) if lift.held is None else lift.held
        accepted[unsure] = False
    ends = (bool(accepted[0]), bool(accepted[1]))
    if not any(ends) and lift.held is not None and lift.hides is None and shown.ends[1 - lift.held] is None:
        accepted[1 - lift.held] = True  # no hand hides that end: it goes on as before
    found = replace(before, line=fit.through(accepted), ends=ends, excess=0.0, lift=lift)
    if not any(ends) or lift.held is None:
        return found
    # The DLO does not end before the hand that holds its end.  Where that end is not seen, it looks as long
    # as before.
    unsure, whole, excess = int(np.argmin(accepted)), found.line, before.excess
    if shown.ends[unsure] is not None:
        whole = fit.through(np.full(2, True), LOOSE)
        excess = fit.excess(whole)
    if not fit.tolerance < excess < LONGEST:
        return found
    lifted = fit.lifted(whole, excess, replace(lift, centre=unsure * (len(whole) - 1.0)))
    return replace(found, line=lifted, excess=excess)


def _held_now(lift: Lift, shown: Shown) -> Lift:
    """Return which end a hand seems to hold, with what an image shows behind both ends."""
    first, last = shown.ends
    apart = np.inf if first is None or last is None else float(np.linalg.norm(last.place - first.place))
    return lift.behind([None if end is None else end.strange for end in shown.ends], apart / shown.half)


def _uncovered(ends: Sequence[LineEnd | None], lift: Lift) -> Bools:
    """Tell which ends (2,) are seen, and probably not covered by a hand."""
    strange = [0.0 if end is None else end.strange for end in ends]
    # A hand that covers both does not look strange in each image.
    if np.maximum(strange, lift.strange).min() > STRANGE:
        return np.full(2, False)
    found = np.array([end is not None for end in ends])
    most = int(np.argmax(strange))
    alone = not all(found) and lift.held != 1 - most
    if strange[most] > STRANGE > strange[1 - most] or alone and lift.strange[most] > STRANGE_ALONE:
        found[most] = False
    return found


class _Fit:
    """The lines that fit what an image shows."""

    def __init__(self, image: DloImage, before: TrackedLine, shown: Shown, hides: int | None) -> None:
        count, half = len(shown.near), shown.half
        # No hand holds the end that one hides: that half of the DLO does not slide along itself.
        first_half = np.arange(count) < count // 2
        self._still = np.zeros(count, bool) if hides is None else first_half == (hides == 0)
        self._before, self._shown, self._length = before, shown, image.dlo.length
        self._fineness = image.finenesses(shown.near)
        self._lengths = self._length / (count - 1) * self._fineness
        self.places = np.array([shown.expected[k] if end is None else end.place
                                for k, end in zip((0, -1), shown.ends, strict=True)])
        stretch = UNSCALED_STRETCH if image.scale is None else STRETCH
        lengths_known = np.full(count - 1, 1.0 / (stretch * float(self._lengths.mean())) ** 2)
        self._known = Evidence(
            shown.measured, shown.across, shown.expected, np.full(count, 1.0 / (FREE[0] * half) ** 2),
            0.2 / (FREE[0] * half) ** 2, self._lengths, lengths_known, 1.0 / (BEND * half) ** 2,
            np.where(before.seen[1:-1], 1.0, KEPT), self.places, np.full(2, 1.0 / (END * half) ** 2))
        self.hidden = shown.across <= HIDDEN * shown.across.max()
        self.tolerance = UNSCALED if image.scale is None else TOLERANCE
        self.tolerance += BLURRED / float(arc_lengths(shown.near)[-1])

    def through(self, accepted: Bools, stretch: float = 1.0) -> Floats:
        """
        Return the line (n, 2) [px] that ends at those ends (2,) that are accepted.

        :param stretch: share of the weight of its lengths.
        """
        free = np.full(len(self._shown.near), FREE[0] if any(accepted) else FREE[1])
        free[self._still] = STILL
        known = replace(self._known, end_weights=np.where(accepted, self._known.end_weights, 0.0),
                        along=1.0 / (free * self._shown.half) ** 2,
                        stretch=stretch * self._known.stretch)
        return fitted(self._shown.near, known)

    def excess(self, line: Floats) -> float:
        """Return the share by which a line (n, 2) is too long."""
        segments = np.linalg.norm(np.diff(line, axis=0), axis=1)
        return float((segments / self._fineness).sum() / self._length - 1)

    def between_ends(self, line: Floats, excess: float, lift: Lift) -> TrackedLine:
        """Return a line between two visible ends, whose excess is given to what is in the air."""
        found = replace(self._before, line=line, ends=(True, True), excess=excess, lift=lift)
        if abs(excess) <= self.tolerance:
            return replace(found, lift=Lift.of(line, lift.strange))
        if not lift.raises:  # the DLO looks longer: it is an end that is in the air
            lift = replace(lift, centre=int(np.argmax(lift.ends)) * (len(line) - 1.0))
        return replace(found, line=self.lifted(line, excess, lift))

    def lifted(self, line: Floats, excess: float, lift: Lift) -> Floats:
        """Return a line near another one (n, 2), of which a part in the air looks longer, or shorter."""
        share = lift.share(len(line) - 1)
        looks = np.maximum(excess * share / share.mean(), -SHORTEST)
        unsure = 1.0 + np.square(GUESSED * share) * self._known.stretch * np.square(self._lengths)
        return fitted(line, replace(self._known, lengths=self._lengths * (1.0 + looks),
                                    stretch=self._known.stretch / unsure))
