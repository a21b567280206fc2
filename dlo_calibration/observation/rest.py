# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rest: when and where a DLO rests after an action, as a tracker shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np

from dlo_calibration.model.chain import Chain, Floats

OPENING = 0.1  # s after the last waypoint; until then a hand may not have opened, though the DLO lies still
STILL = 1.0  # s without motion: longer than a hand takes to open, or a swing to turn
STREAM = 12  # chains that make a stream: a goal is a block of it at rest, and noise shows over time, too
BLOCK = 4  # chains that a block has at least
AGREE = 3.0  # stable distances between blocks at rest; trackers and tables are less still than a simulation
MOVED = 10.0  # stable distances from the place of rest: something has moved the DLO
SIGMAS = 1.5  # standard deviations by which noise makes two blocks differ
MEDIAN = np.pi / 2  # variance of the median of white noise, relative to that of the mean


@dataclass(frozen=True)
class Rest:
    """
    A DLO at rest.

    :param first: index of the first chain that shows it.
    :param points: (n, 3) [m], the mean of the chains; NaN where none shows a point.
    :param count: number of these chains.
    :param moved: index of the first chain that shows that it moved again; None: it did not.
    """

    first: int
    points: Floats
    count: int
    moved: int | None = None


class Stream:
    """
    The chains that were observed after one action, in blocks of one `time` each.

    Rest begins at the first block with which all blocks of the next STILL seconds agree, at the latest after
    `limit`. The cost of a chain does not depend on how many came before.

    :param time: [s] over which rest is measured.
    :param distance: [m] that the DLO moves at most at rest within this time.
    :param limit: [s] after the last waypoint.
    """

    def __init__(self, time: float, distance: float, limit: float) -> None:
        self.count = 0  # of its chains
        self._time, self._distance, self._limit = time, distance, limit
        self._open: list[tuple[int, float, Floats]] = []  # index, instant [s], points of each chain
        self._repeated = 0  # chains among those that repeat the one before
        self._blocks: list[_Block] = []  # until it is certain where rest begins
        self._place: _Place | None = None

    def add(self, instant: float, chain: Chain) -> None:
        """Add the next chain, observed at an instant [s] after the last waypoint."""
        index, self.count = self.count, self.count + 1
        if instant < OPENING:
            return
        if self._open and self._is_whole(instant - self._open[0][1]):
            block = _Block.of(self._open, self._distance)
            if self._place is None:
                self._blocks.append(block)
            else:
                self._place.add(block)
            self._open, self._repeated = [], 0
        if self._open and np.array_equal(self._open[-1][2], chain.observed, equal_nan=True):
            self._repeated += 1  # trackers send the last chain again where they have no new one
        else:
            self._open.append((index, instant, chain.observed))

    def _is_whole(self, span: float) -> bool:
        """Return whether the next chain, `span` [s] after the first of the open block, begins a new block."""
        different = len(self._open)
        enough = different >= BLOCK or different == 1 and self._repeated >= BLOCK
        return span >= self._time and enough or (
            span >= BLOCK * self._time and different + self._repeated >= BLOCK)

    def rest(self) -> Rest | None:
        """Return where the DLO rests; None unless it is known to rest."""
        if self._place is not None:
            return self._place.rest
        begin = next((k for k in range(len(self._blocks) - 1) if self._rests_from(k)), None)
        if begin is None:
            return None
        place = _Place(self._blocks[begin], self._distance)
        for block in self._blocks[begin + 1:]:
            place.add(block)
        if self._blocks[-1].instant >= self._blocks[begin].instant + STILL:
            self._place, self._blocks = place, []  # no later block can change that
        return place.rest

    def _rests_from(self, begin: int) -> bool:
        """Return whether all blocks so far show rest from block `begin` on."""
        first, *later = self._blocks[begin:]
        return first.instant >= self._limit or all(
            block.apart(first.median) < np.hypot(
                AGREE * self._distance, SIGMAS * np.sqrt(first.variance + block.variance))
            for block in later if block.instant < first.instant + STILL)


@dataclass(frozen=True)
class _Block:
    """
    Successive chains, and their median.

    :param first: index of the first chain near the median; others show motion, or a tracker that is lost.
    :param instant: of the first chain [s].
    :param size: number of those near the median.
    :param total: (n, 3) [m], the sum of their points, and `seen`, (n, 1), how many of them show each.
    :param median: (n, 3) [m]; NaN where no chain shows a point.
    :param variance: of the median's points by noise [m^2]: mean square of their distances from the truth.
    """

    first: int
    instant: float
    size: int
    total: Floats
    seen: Floats
    median: Floats
    variance: float

    @classmethod
    def of(cls, chains: Sequence[tuple[int, float, Floats]], distance: float) -> _Block:
        points = np.stack([points for _, _, points in chains])
        seen = np.isfinite(points)
        median = np.full(points.shape[1:], np.nan)
        shown = seen.any(axis=(0, 2))
        median[shown] = np.nanmedian(points[:, shown], axis=0)
        # Second differences leave out uniform motion, and their median one chain that is wrong.
        bends = [_mean_square(bend) for bend in points[2:] - 2 * points[1:-1] + points[:-2]]
        square = float(np.nanmedian([0.0, *bends] if np.isnan(bends).all() else bends)) / 6
        away = np.sqrt([_mean_square(chain - median) for chain in points])
        bound = np.hypot(AGREE * distance, SIGMAS * np.sqrt(square))
        near = np.flatnonzero(away <= max(np.median(away), bound))
        return cls(chains[near[0]][0], chains[0][1], len(near), np.nansum(points[near], axis=0),
                   seen[near, :, :1].sum(axis=0), median, MEDIAN * square / len(points))

    def apart(self, points: Floats) -> float:
        """Return the root mean square distance of its median from (n, 3) points [m], nan if none is seen."""
        return float(np.sqrt(_mean_square(self.median - points)))


def _mean_square(differences: Floats) -> float:
    """Return the mean square length of (n, 3) differences without those that are NaN; nan if all are."""
    squares = np.sum(differences**2, axis=1)
    finite = squares[np.isfinite(squares)]
    return float(finite.mean()) if len(finite) else float('nan')


class _Place:
    """
    Where a DLO rests: the mean of blocks there.

    Blocks measured elsewhere are discarded; after two in a row, the DLO has moved again.
    """

    def __init__(self, block: _Block, distance: float) -> None:
        self._first, self._distance = block.first, distance
        self._size, self._total, self._seen = block.size, block.total, block.seen
        self._away: _Block | None = None  # the newest block, if it was measured elsewhere
        self._moved: int | None = None

    @property
    def rest(self) -> Rest:
        """The place, from all blocks so far."""
        return Rest(self._first, self._points, self._size, self._moved)

    @property
    def _points(self) -> Floats:
        return np.asarray(np.where(self._seen > 0, self._total / np.maximum(self._seen, 1), np.nan))

    def add(self, block: _Block) -> None:
        """Add the next block."""
        if self._moved is not None:
            return
        bound = np.hypot(MOVED * self._distance, SIGMAS * np.sqrt(block.variance))
        if block.apart(self._points) < bound:
            self._size += block.size
            self._total, self._seen = self._total + block.total, self._seen + block.seen
            self._away = None
        elif self._away is None:
            self._away = block
        else:
            self._moved = self._away.first
