# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Rod: the internal forces of the mass-spring chain, integrated implicitly.

Point masses in a line.  Stretching springs of stiffness ``EA / l`` join
neighbours, bending has the energy ``EI / (2 l) |t_i - t_(i-1)|^2`` at each inner
node, with t the segment vectors divided by their rest length (the discrete
curvature of Bergou et al., Discrete Elastic Rods, 2008, without twist).  A step is

    [M (1 + drag dt) + c K] v' = M v + dt f(x),    x' = x + dt v'

With c = dt^2 that is the linearised backward Euler of Baraff and Witkin, Large
Steps in Cloth Simulation, 1998, equation 6.  For one mode of a linear spring any
c >= dt^2 / 2 is stable at any stiffness, and its determinant shows that c damps
it like a stiffness-proportional damping of c / dt.  So c is dt times the internal
damping wherever that is large enough to be stable, and 0.6 dt^2 where it is
not (at 0.5 the stiffest modes would ring for ever): the damping is then less the
time step's.  The part of the stretching matrix that a compressed spring makes
negative is left out, so that the matrix stays positive definite.

A DLO with natural curvature: see `natural`; one that resists twist: see `twist`.
Parts of different stiffness: an inner node has that of the pieces on its two sides
in series.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import PART_NAMES
from dlo_calibration.simulation.natural import natural_forces
from dlo_calibration.simulation.twist import COLUMNS, spans_between, twist_forces

Indices = NDArray[np.intp]

BANDS = 7  # diagonal and six below it: node i couples to i + 2, three coordinates each
IMPLICIT = 0.6  # see the module
TINY = 1e-12
HELD = 1e12  # a held node's share of the matrix, relative to its mass


@dataclass(frozen=True)
class RodProperties:
    """
    Physical properties of a rod.

    :param bending_stiffness: EI [N m^2].
    :param stretching_stiffness: EA [N].
    :param mass: of the whole rod [kg].
    :param drag: acceleration against the velocity [1/s].
    :param internal_damping: damping per stiffness [s].
    :param length_scale: rest lengths relative to the observed ones.
    :param natural_curvature: at rest [1/m].
    :param marker_mass: at each point annotated as feature [kg].
    :param torsion: twisting stiffness relative to the bending stiffness.
    :param profile: bending stiffness of equal parts of the length, relative to the first one's.
    """

    bending_stiffness: float
    stretching_stiffness: float
    mass: float
    drag: float = 0.0
    internal_damping: float = 0.0
    length_scale: float = 1.0
    natural_curvature: float = 0.0
    marker_mass: float = 0.0
    torsion: float = 0.0
    profile: tuple[float, ...] = (1.0,)

    @classmethod
    def of(cls, physical: Mapping[str, float]) -> RodProperties:
        """
        Take them from physical values by parameter name.

        Those that are not in it and can be absent are: an older result names fewer.
        """
        profile = (1.0, *(physical[name] for name in PART_NAMES if name in physical))
        return cls(bending_stiffness=physical['flexibility'], stretching_stiffness=physical['elasticity'],
                   mass=physical['mass'], drag=physical['damping'],
                   internal_damping=physical['internal_damping'],
                   length_scale=physical.get('length_scale', 1.0),
                   natural_curvature=physical.get('natural_curvature', 0.0),
                   marker_mass=physical.get('marker_mass', 0.0),
                   torsion=physical.get('torsion', 0.0), profile=profile)


class Rod:
    """
    A chain of N nodes whose velocities are stepped by its internal forces and gravity.

    :param rest_lengths: (N - 1,) [m] of the segments as observed; they need not be equal.
    :param properties: see `RodProperties`.
    :param time_step: [s].
    :param features: (N,) share of each node in the points annotated as feature; None: there are none.
    """

    def __init__(self, rest_lengths: Floats, properties: RodProperties, time_step: float,
                 features: Floats | None = None) -> None:
        n = len(rest_lengths) + 1
        rest_lengths = rest_lengths * properties.length_scale
        #: (N - 1,) [m]
        self.rest_lengths = rest_lengths
        self._step = time_step
        #: (N - 1,) of each stretching spring [N/m]
        self.stiffness = properties.stretching_stiffness / rest_lengths
        weights = np.zeros(n)
        weights[:-1] += rest_lengths / 2
        weights[1:] += rest_lengths / 2
        #: (N,) mass of each node [kg]
        self.masses = properties.mass * weights / weights.sum()
        if features is not None:
            self.masses += properties.marker_mass * features
        #: [1/s]
        self.drag = properties.drag
        self._bending_stiffness = properties.bending_stiffness
        self._natural_curvature = properties.natural_curvature
        self._torsion = properties.torsion
        self._profile = np.array(properties.profile)
        #: c of the step [s^2], see the module
        self.implicit = time_step * max(properties.internal_damping, IMPLICIT * time_step)
        self.spans = np.zeros((0, COLUMNS))
        self.hold(())

    def hold(self, nodes: Sequence[int]) -> None:
        """
        Let these nodes follow given velocities from now on, and no others.

        A segment between two held nodes is rigid, so that the bending begins
        at its end: exactly there a clamped DLO leaves its clamp.
        """
        self._held = np.array(sorted(nodes), int)
        self._pull = HELD * self.masses[self._held]
        held = np.zeros(len(self.masses), bool)
        held[self._held] = True
        rigid = held[:-1] & held[1:]
        #: (3, N) bending matrix [N/m]: its diagonal and the two below it
        stiffnesses = self._stiffnesses(rigid)
        self.bending = _bending_bands(self.rest_lengths, rigid, stiffnesses)
        #: (N - 2,) [N m] that would straighten each inner node; (0,) of a DLO that is straight at rest
        self.natural: Floats = np.zeros(0)
        if self._natural_curvature and not rigid.all():
            self.natural = self._natural_curvature * np.where(rigid[:-1] & rigid[1:], 0.0, stiffnesses)
        #: what twists between clamps, see `twist`; empty of a DLO that does not resist twist
        compliances = self._compliances(rigid, stiffnesses)
        self.spans = spans_between(rigid & (self._torsion > 0), compliances, self.spans)
        self._constant: Floats | None = None

    @property
    def held(self) -> Indices:
        """Indices of the held nodes."""
        return self._held

    def velocities(self, points: Floats, velocities: Floats, gravity: Floats,
                   held_velocities: Floats) -> Floats:
        """
        Return the velocities (N, 3) [m/s] after one time step without contacts.

        :param points: (N, 3) [m] now.
        :param velocities: (N, 3) [m/s] now.
        :param gravity: (3,) [m/s^2].
        :param held_velocities: (h, 3) [m/s] of the held nodes, in the order of `held`.
        :raises SimulationError: where the points are no longer finite.
        """
        step = self._step
        segments = points[1:] - points[:-1]
        squares = np.einsum('ij,ij->i', segments, segments)
        lengths = np.sqrt(squares)
        slack = (1 - self.rest_lengths / lengths)[:, None]
        tensions = self.stiffness[:, None] * slack * segments
        forces = -self._bend(points)
        if len(self.natural):
            forces += natural_forces(segments, lengths, self.natural)
        if len(self.spans):
            forces += twist_forces(segments, lengths, self.spans)
        forces[:-1] += tensions
        forces[1:] -= tensions
        right = self.masses[:, None] * (velocities + step * gravity) + step * forces

        across = np.maximum(slack, 0) * self.stiffness[:, None]
        along = (self.stiffness[:, None] - across) / squares[:, None]
        blocks = (along * segments)[:, :, None] * segments[:, None, :]
        blocks[:, (0, 1, 2), (0, 1, 2)] += across
        blocks *= self.implicit
        diagonal = np.zeros((len(points), 3, 3))
        diagonal[:-1] = blocks
        diagonal[1:] += blocks
        if self._constant is None:
            self._constant = self._constant_bands()
        bands = self._constant.copy()
        places, signs = _stretching_places(len(points))
        bands.reshape(-1)[places] += signs * np.concatenate(
            [diagonal[:, _ROWS, _COLUMNS].ravel(), blocks.ravel()])
        bands[0, self._held] += self._pull[:, None]
        right[self._held] += self._pull[:, None] * held_velocities
        _, solution, info = lapack.dpbsv(bands.reshape(BANDS, -1), right.ravel(), lower=1,
                                         overwrite_ab=1, overwrite_b=1)
        if info != 0 or not np.isfinite(solution).all():
            raise SimulationError('the rollout diverged: the chain is no longer finite')
        return np.asarray(solution).reshape(-1, 3)

    def _stiffnesses(self, rigid: NDArray[np.bool_]) -> Floats:
        """Return the bending stiffness at each inner node, (N - 2,) [N m^2]."""
        stiffness: Floats = np.full(len(self.rest_lengths) - 1, self._bending_stiffness)
        if (self._profile == 1).all():
            return stiffness
        ends = np.concatenate([[0.0], np.cumsum(self.rest_lengths)])
        bounds = np.linspace(0, ends[-1], len(self._profile) + 1)
        flexibility = np.concatenate([[0.0], np.cumsum(np.diff(bounds) / self._profile)])  # up to each bound

        def between(a: Floats, b: Floats) -> Floats:
            here, there = (np.interp(place, bounds, flexibility) for place in (a, b))
            share: Floats = there - here
            return share

        middles = (ends[:-1] + ends[1:]) / 2
        bendable = np.where(rigid, 0.0, self.rest_lengths / 2)
        total = np.where(rigid[:-1], 0.0, between(middles[:-1], ends[1:-1])) + np.where(
            rigid[1:], 0.0, between(ends[1:-1], middles[1:]))
        cells = bendable[:-1] + bendable[1:]
        stiffness *= np.divide(cells, total, out=np.ones_like(total), where=total > 0)
        return stiffness

    def _compliances(self, rigid: NDArray[np.bool_], stiffnesses: Floats) -> Floats:
        """Return the angle per torque of twist at each inner node, (N - 2,) [1/(N m)]."""
        bendable = np.where(rigid, 0.0, self.rest_lengths)
        compliances: Floats = (bendable[:-1] + bendable[1:]) / (2 * max(self._torsion, TINY) * stiffnesses)
        return compliances

    def _constant_bands(self) -> Floats:
        """Return the part of the matrix that stays the same until other nodes are held, (BANDS, N, 3)."""
        bands = np.zeros((BANDS, len(self.masses), 3))
        bands[0] = (self.masses * (1 + self.drag * self._step))[:, None]
        for offset in range(3):
            bands[3 * offset] += self.implicit * self.bending[offset][:, None]
        return bands

    def _bend(self, points: Floats) -> Floats:
        """Multiply (N, 3) with the bending matrix."""
        diagonal, first, second = self.bending
        product: Floats = diagonal[:, None] * points
        product[:-1] += first[:-1, None] * points[1:]
        product[1:] += first[:-1, None] * points[:-1]
        product[:-2] += second[:-2, None] * points[2:]
        product[2:] += second[:-2, None] * points[:-2]
        return product


_ROWS, _COLUMNS = (np.array(indices) for indices in ((0, 1, 2, 1, 2, 2), (0, 1, 2, 0, 1, 0)))


def _bending_bands(rest_lengths: Floats, rigid: NDArray[np.bool_], stiffness: Floats) -> Floats:
    """Bending matrix (N, N), symmetric: its diagonal and the two below it, (3, N)."""
    n = len(rest_lengths) + 1
    before, after = 1 / rest_lengths[:-1], 1 / rest_lengths[1:]
    row = np.stack([before, -(before + after), after])  # curvature of node i from i - 1, i, i + 1
    bendable = np.where(rigid, 0.0, rest_lengths)
    cells = (bendable[:-1] + bendable[1:]) / 2  # of the DLO, bent at each inner node
    row *= np.sqrt(np.divide(stiffness, cells, out=np.zeros_like(cells), where=cells > 0))
    bands = np.zeros((3, n))
    for a in range(3):
        for b in range(a + 1):
            bands[a - b, b:n - 2 + b] += row[a] * row[b]
    return bands


@lru_cache(maxsize=4)
def _stretching_places(n: int) -> tuple[Indices, Floats]:
    """Where stretching blocks go in the flat (BANDS, N, 3) lower bands, and with which sign."""
    def place(row: Indices, column: Indices) -> Indices:
        at: Indices = (row - column) * 3 * n + column
        return at

    nodes = 3 * np.arange(n)[:, None]
    same = place(nodes + _ROWS, nodes + _COLUMNS).ravel()
    rows, columns = np.divmod(np.arange(9), 3)
    next_ = place(nodes[:-1] + 3 + rows, nodes[:-1] + columns).ravel()
    return np.concatenate([same, next_]), np.concatenate([np.ones(len(same)), -np.ones(len(next_))])
PHASE0 = None
