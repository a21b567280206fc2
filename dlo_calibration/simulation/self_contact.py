# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Contact of a DLO with itself: its segments are capsules that do not pass through each other.

The engines' spheres cannot do this for a thin DLO, whose nodes lie further apart
than its diameter.  Closest points of two segments follow Ericson, Real-Time
Collision Detection, 5.1.9; the contacts are solved as velocity constraints with
Coulomb friction by Jacobi iterations with mass splitting (Tonge et al., Mass
Splitting for Jitter-Free Parallel Rigid Body Simulation, 2012).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats

Indices = NDArray[np.intp]

ITERATIONS = 10
PUSH_OUT = 0.8  # share of a penetration that one step removes
FASTEST_PUSH_OUT = 0.8  # m/s, so that nothing is kicked
SUPPORTED = 0.5  # cosine between a push and the support against it
UNSUPPORTED = 1e-6  # m/s; a smaller change of velocity is rounding
WEDGED = 0.1  # a pair of which less than that share can yield is wedged: then all of it does
TINY = 1e-12


class SelfContact:
    """
    Keeps the segments of one DLO apart.

    Parts of it that are nearer along the DLO than half the circumference of its
    cross-section cannot touch: that is how far apart the legs of the tightest
    hairpin are.  Pairs that are nearer than a diameter at the start keep that
    distance until they have moved apart, so that a radius that is larger than
    the real one does not burst the DLO open.

    :param places: (N,) [m] of the nodes along the DLO at rest.
    :param radius: [m].
    :param friction: Coulomb coefficient.
    :param time_step: [s].
    """

    def __init__(self, places: Floats, radius: float, friction: float, time_step: float) -> None:
        self._friction = friction
        self._step = time_step
        self._half = np.diff(places) / 2
        middles = places[:-1] + self._half
        apart = middles[None, :] - middles[:, None]
        between = apart - self._half[None, :] - self._half[:, None]
        self._may_touch = between > max(np.pi * radius, self._half.max())
        self._diameter = 2 * radius
        self._reach = self._half[None, :] + self._half[:, None] + self._diameter
        self._distance = np.full(apart.shape, self._diameter)
        self._room = -1.0  # how far nodes may move before any pair can touch

    def start(self, points: Floats) -> None:
        """Take the (N, 3) [m] points at the start, where nothing may be kicked apart."""
        self._room = -1.0
        self._distance[:] = self._diameter
        first, second = np.nonzero(self._may_touch & (self._gaps(points, 1.0) < 0))
        if len(first):
            distance = _closest(points, first, second)[3]
            self._distance[first, second] = np.minimum(distance, self._diameter)

    def velocities(self, points: Floats, velocities: Floats, inverse_masses: Floats,
                   support: Floats) -> Floats:
        """
        Return the (N, 3) [m/s] velocities that contacts allow.

        :param points: (N, 3) [m] now.
        :param velocities: (N, 3) [m/s] that the DLO would have without contacts.
        :param inverse_masses: (N,) [1/kg], 0 for held nodes.
        :param support: (N, 3) [m/s] change of velocity that other bodies last
            caused.  A node does not yield to a push against it (a strand on a
            table carries another one), but passes the push on to that body.
        """
        travel = self._step * float(np.sqrt(np.einsum('ij,ij->i', velocities, velocities).max()))
        self._room -= 2 * travel
        if self._room > 0:
            return velocities
        gaps = np.where(self._may_touch, self._gaps(points, 1.2), np.inf)
        nearest = float(gaps.min(initial=np.inf))
        if nearest > 2 * travel:
            self._room = nearest - 2 * travel
            return velocities
        first, second = np.nonzero(gaps <= 2 * travel)
        return self._resolve(points, velocities, inverse_masses, support, first, second)

    def _gaps(self, points: Floats, stretch: float) -> Floats:
        """Lower bound of the distance between all pairs of capsules, (S, S) [m]."""
        middles = (points[1:] + points[:-1]) / 2
        squares = np.einsum('ij,ij->i', middles, middles)
        distances = squares[:, None] + squares[None, :] - 2 * middles @ middles.T
        gaps: Floats = np.sqrt(np.maximum(distances, 0)) - stretch * self._reach
        return gaps

    def _resolve(self, points: Floats, velocities: Floats, inverse_masses: Floats, support: Floats,
                 first: Indices, second: Indices) -> Floats:
        s, t, normal, distance = _closest(points, first, second)
        allowed = np.maximum(self._distance[first, second], np.minimum(distance, self._diameter))
        self._distance[first, second] = allowed
        gap = distance - allowed
        wanted = np.where(gap > 0, -gap / self._step,
                          np.minimum(-PUSH_OUT * gap / self._step, FASTEST_PUSH_OUT))
        nodes = np.stack([first, first + 1, second, second + 1], axis=1)
        weights = np.stack([1 - s, s, -(1 - t), -t], axis=1)
        approach = np.einsum('ck,ckj,cj->c', weights, velocities[nodes], normal)
        near = approach < wanted
        if not near.any():
            return velocities
        nodes, weights, normal, wanted = nodes[near], weights[near], normal[near], wanted[near]
        sharing = np.bincount(nodes.ravel(), minlength=len(points))
        backing = np.einsum('ckj,cj->ck', support[nodes], normal) * np.sign(weights)
        resistance = np.maximum(SUPPORTED * np.linalg.norm(support[nodes], axis=2), UNSUPPORTED)
        yielding = inverse_masses[nodes] * (backing > -resistance)
        wedged = np.einsum('ck,ck->c', weights**2, yielding) < WEDGED * np.einsum(
            'ck,ck->c', weights**2, inverse_masses[nodes])
        yielding = np.where(wedged[:, None], inverse_masses[nodes], yielding)
        mobility = np.einsum('ck,ck->c', weights**2, yielding * sharing[nodes])[:, None]
        mobility = np.where(mobility > 0, mobility, np.inf)  # both held
        resolved = velocities.copy()
        pushed = np.zeros(len(nodes))
        rubbed = np.zeros((len(nodes), 3))
        for _ in range(ITERATIONS):
            relative = np.einsum('ck,ckj->cj', weights, resolved[nodes])
            approach = np.einsum('cj,cj->c', relative, normal)
            push = np.maximum(pushed + (wanted - approach) / mobility[:, 0], 0)
            rub = rubbed - (relative - approach[:, None] * normal) / mobility
            size = np.linalg.norm(rub, axis=1)
            rub *= np.minimum(1, self._friction * push / np.maximum(size, TINY))[:, None]
            impulses = (push - pushed)[:, None] * normal + rub - rubbed
            pushed, rubbed = push, rub
            np.add.at(resolved, nodes, (weights * yielding)[:, :, None] * impulses[:, None, :])
        passed_on = weights * (inverse_masses[nodes] - yielding)
        np.add.at(resolved, nodes, passed_on[:, :, None] * (pushed[:, None] * normal + rubbed)[:, None, :])
        return resolved


def _closest(points: Floats, first: Indices,
             second: Indices) -> tuple[Floats, Floats, Floats, Floats]:
    """
    Closest points of pairs of segments, (c,) indices of their first nodes.

    :returns: (c,) places s and t on the first and second segment, 0..1; (c, 3)
        unit normal from second to first; (c,) distance [m].
    """
    p, q = points[first], points[second]
    d1, d2 = points[first + 1] - p, points[second + 1] - q
    r = p - q
    a = np.einsum('ij,ij->i', d1, d1)
    e = np.einsum('ij,ij->i', d2, d2)
    b = np.einsum('ij,ij->i', d1, d2)
    c = np.einsum('ij,ij->i', d1, r)
    f = np.einsum('ij,ij->i', d2, r)
    determinant = a * e - b * b
    parallel = determinant < 1e-9 * a * e
    s = np.where(parallel, 0.5, np.clip((b * f - c * e) / np.where(parallel, 1, determinant), 0, 1))
    t = (b * s + f) / e
    clipped = np.clip(t, 0, 1)
    s = np.where(t == clipped, s, np.clip((b * clipped - c) / a, 0, 1))
    apart = r + s[:, None] * d1 - clipped[:, None] * d2
    distance = np.linalg.norm(apart, axis=1)
    upward = np.tile((0.0, 0.0, 1.0), (len(first), 1))  # any, where the axes meet
    normal = np.where(distance[:, None] > TINY, apart / np.maximum(distance, TINY)[:, None], upward)
    return s, clipped, normal, distance
