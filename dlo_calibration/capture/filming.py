# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Filming: from the views of a film, or of a camera that is on, to episodes and their messages."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Sequence

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats
from dlo_calibration.observation.episodes import Bounds, Episode, episodes
from dlo_calibration.observation.sightings import HandSightings, Sightings
from dlo_calibration.vision.observer import ImageView
from dlo_calibration.vision.tags import tag_path, TagPose

FEWEST_SEEN = 5  # pictures in which a tag is seen; fewer may be misreadings


@dataclass(frozen=True)
class HeldPoint:
    """
    The point that a hand without a tag holds, as a person says.

    :param place: share of the length.
    :param height: of the point above its place on the table [m].
    """

    place: float
    height: float = 0.0


@dataclass
class Filming:
    """
    What was seen so far; an image costs some kilobytes.

    :param held: what hands without a tag hold.
    """

    held: Sequence[HeldPoint] = ()
    times: list[float] = field(default_factory=list)
    _views: list[ImageView] = field(default_factory=list)
    _measured: list[Floats | None] = field(default_factory=list)  # points in space; None: without depth
    _diameters: list[float] = field(default_factory=list)

    def add(self, view: ImageView, depth: Floats | None = None) -> Floats:
        """
        Take the view of the next image.

        :param depth: of each pixel, as for `ImageView.points`.
        :returns: the points (count, 3) of the DLO [m]; NaN where it is not seen.
        """
        # The diameter does not change, and its median needs no more.
        self._diameters += [view.diameter()] if len(self._diameters) < 300 and view.scale is not None else []
        points = view.points(self.radius, depth)
        self.times.append(view.time)
        self._views.append(view)
        self._measured.append(None if depth is None else points)
        return points

    @property
    def radius(self) -> float:
        """Radius of the DLO [m]: half the median of the diameters seen; 0 before."""
        known = np.array(self._diameters)[np.isfinite(self._diameters)]
        return float(np.median(known)) / 2.0 if len(known) else 0.0

    def forget(self, until: float) -> None:
        """Forget what was seen before a time [s]."""
        first = int(np.searchsorted(self.times, until))
        del self.times[:first], self._views[:first], self._measured[:first]

    def sightings(self) -> Sightings:
        """
        Return what was seen of the DLO.

        :raises InputError: where the scale is unknown.
        """
        if all(view.scale is None for view in self._views):
            raise InputError('film', 'no scale', 'the printed board on the table, or known points',
                             'lay the board beside the DLO and give --board, or give --scale')
        radius = self.radius
        if any(points is not None for points in self._measured):
            # With depth, an image without it shows nothing.
            unseen = np.full_like(next(points for points in self._measured if points is not None), np.nan)
            return Sightings(np.array(self.times), np.stack([
                unseen if points is None else points for points in self._measured]), None, radius)
        points = np.stack([view.points(radius) for view in self._views])
        # Where the view of the table is unknown, nothing was seen of the DLO.
        scales = [view.scale for view in self._views]
        known = next(scale for scale in scales if scale is not None)
        cameras = np.stack([(known := scale or known).camera for scale in scales])
        return Sightings(np.array(self.times), points, cameras, radius)

    def hands(self, seen: Sightings) -> tuple[HandSightings, ...]:
        """Return what was seen of the hands: those with tags, and those whose point a person names."""
        poses: dict[int, dict[int, TagPose]] = {}
        for k, view in enumerate(self._views):
            for number, pose in view.poses.items():
                poses.setdefault(number, {})[k] = pose
        tagged = [(number, tag_path(self.times, of_tag)) for number, of_tag in sorted(poses.items())
                  if len(of_tag) >= FEWEST_SEEN]
        hands = [HandSightings(f'hand_{number + 1}', path.positions, path.orientations)
                 for number, path in tagged]
        names = [f'hand_{k}' for k in range(1, 9) if all(hand.name != f'hand_{k}' for hand in hands)]
        return (*hands, *(_held(seen, held, name)
                          for held, name in zip(self.held, names, strict=False)))

    def episodes(self, count: int | None = None,
                 bounds: Sequence[Bounds] = ()) -> tuple[tuple[Episode, ...], tuple[str, ...]]:
        """
        Return the episodes so far, and sentences about movements that make none.

        :param count: of points of their chains; None: as many as were tracked.
        :param bounds: of those episodes that shall begin or end elsewhere.
        :raises InputError: where the scale is unknown.
        """
        seen = self.sightings()
        return episodes(seen, self.hands(seen), count, bounds)


def _held(seen: Sightings, held: HeldPoint, name: str) -> HandSightings:
    """Return the path of a point of the DLO; where it is not seen, it moves on evenly."""
    at = held.place * (seen.points.shape[1] - 1)
    below = min(int(at), seen.points.shape[1] - 2)
    path = seen.points[:, below] + (at - below) * (seen.points[:, below + 1] - seen.points[:, below])
    known = np.isfinite(path[:, 0])
    if known.any():
        path = np.stack([np.interp(seen.times, seen.times[known], axis[known]) for axis in path.T], axis=1)
    if held.height and seen.cameras is not None:
        share = held.height / (seen.cameras[:, 2:] - path[:, 2:])
        path = path + share * (seen.cameras - path)
    return HandSightings(name, path, place=held.place)
