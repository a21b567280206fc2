# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rope: the nodes of a simulated DLO and the state that the kernels step, for both engines."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
import math
from typing import Any, Mapping, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.simulation.entries import start_distances
from dlo_calibration.simulation.machine_code import Packed
from dlo_calibration.simulation.rod import Rod, RodProperties
from dlo_calibration.simulation.states import CONTACT, RopeState, SelfContact


class Rope:
    """
    A DLO of N nodes at the start of a trial.

    :param places: (N,) [m] arc lengths of the nodes at rest, from 0, increasing.
    :param points: (N, 3) [m] at the start.
    :param velocities: (N, 3) [m/s] at the start.
    :param physical: physical values by parameter name, in SI units.
    :param time_step: [s].
    :param gravity: (3,) [m/s^2].
    :param features: (N,) number of points annotated as feature at each node; None: there are none.
    :param directions: (N - 1, 3) of the clamps that hold from the start, see `NodeLayout`; None: unknown.
    """

    def __init__(self, places: Floats, points: Floats, velocities: Floats, physical: Mapping[str, float],
                 time_step: float, gravity: Floats, features: Floats | None = None,
                 directions: Floats | None = None) -> None:
        properties = RodProperties.of(physical)
        self._rod = Rod(places[1:] - places[:-1], properties, time_step, features)
        contact = self_contact(self._rod.state.rest_lengths, 0.0, 0.0)  # `_begin` sets radius and friction
        #: its contact with itself, as kernels take it
        self.contact: Any = Packed(contact)
        points = np.array(points, dtype=float)
        #: state of the kernels, which change positions and velocities in place
        self.state = RopeState(
            points=points, velocities=np.array(velocities, dtype=float), predicted=np.zeros_like(points),
            support=np.zeros_like(points), gravity=np.array(gravity, dtype=float), rod=self._rod.state,
            contact=contact)
        self._packed: tuple[RopeState, Packed] | None = None
        self._begin(places, properties, physical, directions)

    def become(self, places: Floats, points: Floats, velocities: Floats, physical: Mapping[str, float],
              features: Floats | None = None, directions: Floats | None = None) -> None:
        """Become another DLO of as many nodes at the start of a trial; see the constructor."""
        properties = RodProperties.of(physical)
        self._rod.become(places[1:] - places[:-1], properties, features)
        state = self.state
        state.points[...], state.velocities[...] = points, velocities
        state.predicted[...], state.support[...] = 0.0, 0.0
        self._begin(places, properties, physical, directions)

    def _begin(self, places: Floats, properties: RodProperties, physical: Mapping[str, float],
               directions: Floats | None) -> None:
        # A rest shape of unknown direction turns to where the DLO is bent at the start.
        self._directions = {} if directions is None or not properties.rest_curvature else _in_clamps(
            directions, np.diff(self.state.points, axis=0), places, properties.clamp_twist)
        contact, sizes = self.contact, _Sizes.of(self._rod.state.rest_lengths.tobytes())
        contact['half'][:], contact['middles'][:] = sizes.half, sizes.middles
        contact.set(**sizes.at(physical['self_collision']), friction=float(physical['friction']))
        start_distances(contact, self.state.points)
        self.state = self.state._replace(rod=self._rod.state, contact=contact.state)

    @property
    def points(self) -> Floats:
        """The nodes' positions now, (N, 3) [m]; a copy."""
        return self.state.points.copy()

    @property
    def twists(self) -> bool:
        """Whether it makes a difference how clamps turn about the axis of the DLO."""
        return len(self.state.rod.frame.clamped) > 0

    def hold(self, nodes: Sequence[int]) -> None:
        """Let exactly these nodes follow given positions from now on."""
        self._rod.hold(nodes, {} if self.state.rod.frame.begun[0] else self._directions)
        self.state = self.state._replace(rod=self._rod.state)

    @property
    def packed(self) -> Packed:
        """Its state, as kernels take it."""
        if self._packed is None or self._packed[0] is not self.state:
            self._packed = self.state, Packed(self.state)
        return self._packed[1]


def _in_clamps(directions: Floats, segments: Floats, places: Floats, twist: float) -> dict[int, Floats]:
    """
    Return the direction of the rest shape, (3,), in each clamped segment.

    :param directions: (N - 1, 3) unit vectors across the segments; nan where there is no clamp.
    :param segments: (N - 1, 3) [m] vectors from node to node.
    :param places: (N,) [m] arc lengths of the nodes.
    :param twist: angle [rad] by which those in the second half of the DLO are turned about its axis.
    """
    found = {}
    for segment in np.flatnonzero(np.isfinite(directions[:, 0])).tolist():
        across = directions[segment]
        if places[segment] + places[segment + 1] > places[-1]:
            axis = segments[segment] / np.linalg.norm(segments[segment])
            across = np.cos(twist) * across + np.sin(twist) * np.cross(axis, across)
        found[segment] = across
    return found


def self_contact(rest_lengths: Floats, radius: float, friction: float) -> SelfContact:
    """
    Return the state of contact of a DLO with itself.

    :param rest_lengths: (S,) [m] of its segments.
    :param radius: self-collision radius [m].
    :param friction: Coulomb coefficient.
    """
    sizes = _Sizes.of(rest_lengths.tobytes())
    segments = len(sizes.half)
    count = segments * (segments - 1) // 2
    return SelfContact(
        half=sizes.half.copy(), middles=sizes.middles.copy(), **sizes.at(radius), friction=float(friction),
        distances=np.empty((segments, segments)), pairs=np.empty((count, 2), np.int64),
        near=np.zeros(1, np.int64), room=np.full(3, -1.0),
        contacts=np.empty(count, CONTACT),
        change=np.empty((segments + 1, 3)), balls=np.empty((8, segments)),
        overlaps=np.zeros(1, np.int64))


@dataclass(frozen=True)
class _Sizes:
    """
    What of a `SelfContact` depends on the lengths of S segments alone.

    :param half: (S,) [m] see `SelfContact`, like `middles`.
    :param longest: half the length of the longest segment [m].
    :param widest: (S,) [m] the largest arc length between two segments, one of which is at most so many
        segments further than the other.
    """

    half: Floats
    middles: Floats
    longest: float
    widest: list[float]

    @classmethod
    @lru_cache(maxsize=256)
    def of(cls, lengths: bytes) -> _Sizes:
        """Return them for the octets of an array of lengths [m]."""
        rest_lengths = np.frombuffer(lengths)
        half = rest_lengths / 2
        middles = rest_lengths.cumsum() - half
        starts, ends = middles - half, middles + half
        gaps = [float((starts[k:] - ends[:len(ends) - k]).max()) for k in range(len(half))]
        return cls(frozen_array(half), frozen_array(middles), float(half.max()), list(accumulate(gaps, max)))

    def at(self, radius: float) -> dict[str, Any]:
        """Return what depends on the self-collision radius [m], too."""
        apart = max(math.pi * radius, self.longest)
        return {'diameter': 2.0 * radius, 'apart': apart, 'next_one': bisect_right(self.widest, apart)}


def diverged() -> SimulationError:
    """Return the error for a kernel whose step is not finite."""
    return SimulationError('the rollout diverged: the chain is no longer finite')
