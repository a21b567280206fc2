# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Rod: the internal forces of the mass-spring chain, integrated implicitly.

Springs of stiffness ``EA / l`` join neighbouring point masses.  Each inner node has the
bending energy ``EI / (2 l) |t_i - t_(i-1)|^2``, with t the segment vectors divided by
their rest lengths (the discrete curvature of Bergou et al., Discrete Elastic Rods,
2008, without twist).  A step is

    [M (1 + drag dt) + c K] v' = M v + dt f(x),    x' = x + dt v'

With c = dt^2 this is the linearised backward Euler method of Baraff and Witkin, Large
Steps in Cloth Simulation, 1998, equation 6.  For one mode of a linear spring, every
c >= dt^2 / 2 is stable at any stiffness, and the determinant shows that c damps the mode
like a stiffness-proportional damping of c / dt.  So c is dt times the internal damping,
but at least 0.6 dt^2 for stability (at 0.5 dt^2 the stiffest modes would ring for ever);
at this limit the damping depends on the time step.  The negative part of the matrix of
a compressed spring is left out, so that the matrix stays positive definite.

`kernels` take the step and add natural curvature and twist; this module computes their
input.  If parts of the DLO differ in stiffness, an inner node has the stiffness of the
pieces on its two sides in series.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import PART_NAMES
from dlo_calibration.simulation.kernels import BAND, RodState, SPAN, Spans


@dataclass(frozen=True)
class RodProperties:
    """
    Physical properties of a rod.

    :param bending_stiffness: EI [N m^2].
    :param stretching_stiffness: EA [N].
    :param mass: mass of the whole rod [kg].
    :param drag: acceleration against the velocity, relative to it [1/s].
    :param internal_damping: damping relative to stiffness [s].
    :param length_scale: rest lengths relative to the observed ones.
    :param natural_curvature: curvature of the rest shape [1/m].
    :param marker_mass: mass at each point annotated as feature [kg].
    :param torsion: twisting stiffness relative to the bending stiffness.
    :param profile: bending stiffness of parts of equal length, relative to that of the first part.
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
        Return the properties for physical values by parameter name, in SI units.

        Optional ones may be absent, as in results of older versions.
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
    A chain of N nodes, with the `state` that the kernels step.

    :param rest_lengths: (N - 1,) [m] of the segments as observed; they need not be equal.
    :param properties: see `RodProperties`.
    :param time_step: [s].
    :param features: (N,) number of points annotated as feature at each node; None: there are none.
    """

    def __init__(self, rest_lengths: Floats, properties: RodProperties, time_step: float,
                 features: Floats | None = None) -> None:
        n = len(rest_lengths) + 1
        rest_lengths = rest_lengths * properties.length_scale
        weights = np.zeros(n)
        weights[:-1] += rest_lengths / 2
        weights[1:] += rest_lengths / 2
        masses = properties.mass * weights / weights.sum()
        if features is not None:
            masses += properties.marker_mass * features
        self._properties = properties
        self.state = RodState(
            rest_lengths=rest_lengths, stiffness=properties.stretching_stiffness / rest_lengths,
            masses=masses, inverse_masses=1 / masses, bending=np.zeros((3, n)), natural=np.zeros(0),
            spans=np.zeros(0, SPAN), held=np.zeros(0, np.int64), follow=np.zeros((0, 3)),
            drag=float(properties.drag),
            implicit=float(time_step * max(properties.internal_damping, 0.6 * time_step)),
            step=float(time_step), bands=np.empty((3 * n + BAND - 1, BAND)),
            right=np.empty(3 * n + BAND - 1))
        self.hold(())

    def hold(self, nodes: Sequence[int]) -> None:
        """
        Let exactly these nodes follow given velocities from now on.

        A segment between two held nodes is rigid, so bending begins at its end, where a
        clamped DLO leaves its clamp.
        """
        state, properties = self.state, self._properties
        held = np.array(nodes, np.int64)
        follows = np.isin(np.arange(len(state.masses)), held)
        rigid = follows[:-1] & follows[1:]
        stiffnesses = self._stiffnesses(rigid)
        natural: Floats = np.zeros(0)
        if properties.natural_curvature and not rigid.all():
            natural = properties.natural_curvature * np.where(rigid[:-1] & rigid[1:], 0.0, stiffnesses)
        spans = state.spans
        if properties.torsion > 0:
            bendable = np.where(rigid, 0.0, state.rest_lengths)
            compliances = (bendable[:-1] + bendable[1:]) / (2 * properties.torsion * stiffnesses)
            spans = _spans_between(rigid, compliances, spans)
        self.state = state._replace(
            held=held, follow=np.zeros((len(held), 3)), natural=natural, spans=spans,
            inverse_masses=np.where(follows, 0.0, 1 / state.masses),
            bending=_bending_bands(state.rest_lengths, rigid, stiffnesses))

    def _stiffnesses(self, rigid: NDArray[np.bool_]) -> Floats:
        """Return the bending stiffness at each inner node, (N - 2,) [N m^2]."""
        lengths, profile = self.state.rest_lengths, np.array(self._properties.profile)
        stiffness: Floats = np.full(len(lengths) - 1, self._properties.bending_stiffness)
        if (profile == 1).all():
            return stiffness
        ends = np.concatenate([[0.0], np.cumsum(lengths)])
        bounds = np.linspace(0, ends[-1], len(profile) + 1)
        flexibility = np.concatenate([[0.0], np.cumsum(np.diff(bounds) / profile)])  # up to each bound

        def between(a: Floats, b: Floats) -> Floats:
            here, there = (np.interp(place, bounds, flexibility) for place in (a, b))
            share: Floats = there - here
            return share

        middles = (ends[:-1] + ends[1:]) / 2
        bendable = np.where(rigid, 0.0, lengths / 2)
        total = np.where(rigid[:-1], 0.0, between(middles[:-1], ends[1:-1])) + np.where(
            rigid[1:], 0.0, between(ends[1:-1], middles[1:]))
        cells = bendable[:-1] + bendable[1:]
        stiffness *= np.divide(cells, total, out=np.ones_like(total), where=total > 0)
        return stiffness


def _spans_between(rigid: NDArray[np.bool_], compliances: Floats, before: Spans) -> Spans:
    """
    Return the parts of a DLO between two clamps, (s,) of `SPAN`.

    :param rigid: (N - 1,) True for segments that are held.
    :param compliances: (N - 2,) [1/(N m)] twisting compliance of each inner node.
    :param before: the previous parts; a part between the same clamps keeps its twist.
    """
    held = np.flatnonzero(rigid).tolist()
    pairs = [(a, b) for a, b in zip(held[:-1], held[1:], strict=True) if b > a + 1]
    spans = np.zeros(len(pairs), SPAN)
    for k, (a, b) in enumerate(pairs):
        span = spans[k]
        span['first'], span['last'], span['stiffness'] = a, b, 1 / compliances[a:b].sum()
        for old in before:
            if all(old[name] == span[name] for name in ('first', 'last', 'stiffness')):
                spans[k] = old
    return spans


def _bending_bands(rest_lengths: Floats, rigid: NDArray[np.bool_], stiffness: Floats) -> Floats:
    """Return the diagonal and the two below it, (3, N) [N/m], of the symmetric (N, N) bending matrix."""
    n = len(rest_lengths) + 1
    before, after = 1 / rest_lengths[:-1], 1 / rest_lengths[1:]
    row = np.stack([before, -(before + after), after])  # curvature of node i from i - 1, i, i + 1
    bendable = np.where(rigid, 0.0, rest_lengths)
    cells = (bendable[:-1] + bendable[1:]) / 2  # [m] length that bends at each inner node
    row *= np.sqrt(np.divide(stiffness, cells, out=np.zeros_like(cells), where=cells > 0))
    bands = np.zeros((3, n))
    for a in range(3):
        for b in range(a + 1):
            bands[a - b, b:n - 2 + b] += row[a] * row[b]
    return bands
