# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Lift: which part of a DLO a hand seems to lift since all of it lay on the table.

A hand that lifts an end hides how long the DLO looks there; one that lifts another part makes the DLO look
longer or shorter around itself, while both ends are seen.  That part has moved farthest.  A hand that brings
the end that it holds to the other one hides that one, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d, label

from dlo_calibration.model.chain import Floats
from dlo_calibration.vision.appearance import Bools

BESIDE = 2.0  # points: standard deviation of a filter, which tells what is beside a hidden part
HELD = 6.0  # difference between both ends, from which on a hand seems to hold one of them
ONE_PLACE = 4.0  # half widths between both ends, below which the hand that holds one hides the other, too
NEWEST = 0.3  # share of what is new in an image
BOTH = 0.3  # share of the way of the end that moved farthest, from which on the other one moved, too
CHANGED = 4.0  # times as far: from then on a hand seems to hold an end after all
RAISED = 0.4  # share of the length that a hand lifts to each side


@dataclass(frozen=True, eq=False)
class Lift:
    """
    Which part of a line a hand seems to lift.

    :param rested: (n, 2) the line when last all of it lay on the table [px].
    :param strange: (2,) distance in L, a, b of what is behind an end from the ground, as a mean over images;
        not a number: no image has shown it yet.
    :param held: the end, 0 or 1, that a hand last seemed to hold since then; None: neither.
    :param hides: the other end, if that hand hides it, too; None: it does not.
    :param ends: (2,) how far the ends have been from where they rested [px].
    :param middle: how far a part that was hidden has been [px].
    :param raises: whether a hand seems to lift the middle, and not an end.
    :param centre: index of the point that it seems to hold then.
    """

    rested: Floats
    strange: Floats
    held: int | None
    hides: int | None
    ends: Floats
    middle: float
    raises: bool
    centre: float

    @classmethod
    def of(cls, line: Floats, strange: Floats) -> Lift:
        """Return the state of a line that lies on the table: nothing is lifted."""
        return cls(line, strange, None, None, np.zeros(2), 0.0, False, (len(line) - 1) / 2)

    @property
    def shows_hand(self) -> bool:
        """Whether it is stranger behind one end than behind the other, as where a hand holds it."""
        return bool(abs(self.strange[0] - self.strange[1]) > HELD)

    def behind(self, strange: Sequence[float | None], apart: float) -> Lift:
        """
        Return the state with what an image shows behind both ends.

        :param strange: None: it does not show that end.
        :param apart: half widths between both ends.
        """
        new, mean = np.array(strange, float), self.strange
        hides = None
        if self.held is not None:
            other = 1 - self.held
            # Where one hand has both, the DLO seems to end twice at its border.
            meets = apart < ONE_PLACE and mean.max() > HELD
            if meets or self.hides is not None and not new[other] <= HELD:
                hides, new[other] = other, np.nan
        mean = np.where(np.isnan(new), mean, np.where(np.isnan(mean), new, mean + NEWEST * (new - mean)))
        now = replace(self, strange=mean)
        held = int(np.argmax(mean)) if now.shows_hand else self.held
        return replace(now, held=held, hides=hides if held == self.held else None)

    def seen(self, line: Floats, ends: Floats, shown: Bools, least: float) -> Lift:
        """
        Return the state with what an image shows of the line.

        :param line: (n, 2) now [px].
        :param ends: (2, 2) where its ends are seen [px].
        :param shown: (n,) which of its points are seen.
        :param least: way of a part that moves [px].
        """
        hidden, middle, centre = _gaps(shown), self.middle, self.centre
        if hidden.any():
            away = np.linalg.norm(line - self.rested, axis=1)
            parts, _ = label(hidden)
            centre = float(np.flatnonzero(parts == parts[np.argmax(np.where(hidden, away, -1.0))]).mean())
            beside = gaussian_filter1d(hidden.astype(float), BESIDE, mode='nearest') > 0.05
            middle = max(middle, float(away[beside].max()))
        moved = np.maximum(self.ends, np.linalg.norm(ends - self.rested[[0, -1]], axis=1))
        # It may come back before an end does; both ends slide towards it.
        surplus = middle * (CHANGED if self.raises else 1.0)
        raises = self.held is None and (surplus > moved.max() or moved.min() > BOTH * moved.max())
        return replace(self, ends=moved, middle=middle, centre=centre,
                       raises=bool(raises and max(middle, moved.max()) > least))

    def share(self, count: int) -> Floats:
        """Return how much each of the segments (count,) may be in the air, if a hand raises the DLO."""
        along = (np.arange(count) + 0.5 - self.centre) / (RAISED * count)
        return np.asarray(np.square(np.maximum(1.0 - np.square(along), 0.0)))


def _gaps(shown: Bools) -> Bools:
    """Return which points (n,) are not shown, between some that are."""
    places = np.flatnonzero(shown)
    hidden = ~shown
    if len(places):
        hidden[:places[0]] = hidden[places[-1]:] = False
    # One station alone is a coincidence.
    return np.asarray(gaussian_filter1d(hidden.astype(float), 1.0) > 0.5)
