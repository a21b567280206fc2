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

The rest shape may be curved, and the DLO may resist twist.  Then each segment has a material
frame, turned by an angle from a frame that is carried along without twist (Bergou et al.,
2008; Bishop, There is more than one way to frame a curve, 1975).  With natural curvature k,
two components in the material frame, the bending energy becomes
``EI / (2 l) |t_i - t_(i-1) - l k_i|^2``: beside the energy of a straight DLO and a constant,
there is the mixed term ``-EI k_i . (t_i - t_(i-1))``, where k_i has the mean angle of both
segments.  The twisting energy is ``GJ / (2 l) (angle_i - angle_(i-1))^2``.  A DLO has almost no
inertia about its axis, so that the angles are those of least energy: a clamp prescribes them,
free ends and pins are without torque.  Where clamps are not to hold the DLO (torsion 0), it turns
freely as a whole, and does not twist.

Strands that rub on each other resist bending as an elastic, perfectly plastic element beside the
elastic one.  Its state is the bend p_i at which it is free of stress, at first that of the start:
``e = t_i - t_(i-1) - p_i`` causes the moment ``k EI e / l``, and where |e| exceeds ``l slip``, p_i
follows.  p_i turns with the DLO by the smallest rotation; the nodes that turn it bear the torque,
without which the element would gain energy.

`kernels` take the step; this module computes their input.  If parts of the DLO differ in
stiffness, an inner node has the stiffness of the pieces on its two sides in series.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import knot_names, KNOTS, PART_NAMES
from dlo_calibration.simulation.states import BAND, FrameState, RodState, SlipState

_KNOT_NAMES = knot_names(KNOTS[-1])


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
    :param bending_friction: largest moment of friction between the strands, relative to EI [1/m].
    :param bending_slip: change of curvature at which they slip [1/m].
    :param rest_curvature: K pairs of components of the natural curvature [1/m], at places that divide the
        length evenly; linear between them.
    :param clamp_twist: angle [rad] between the rest shape and clamps in the second half, see `Rope`.
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
    bending_friction: float = 0.0
    bending_slip: float = 0.1
    rest_curvature: tuple[tuple[float, float], ...] = ()
    clamp_twist: float = 0.0

    @classmethod
    def of(cls, physical: Mapping[str, float]) -> RodProperties:
        """
        Return the properties for physical values by parameter name, in SI units.

        Optional ones may be absent, as in results of older versions.
        """
        profile = (1.0, *(physical[name] for name in PART_NAMES if name in physical))
        known = [physical[name] for name in _KNOT_NAMES if name in physical]
        return cls(bending_stiffness=physical['flexibility'], stretching_stiffness=physical['elasticity'],
                   mass=physical['mass'], drag=physical['damping'],
                   internal_damping=physical['internal_damping'],
                   length_scale=physical.get('length_scale', 1.0),
                   natural_curvature=physical.get('natural_curvature', 0.0),
                   marker_mass=physical.get('marker_mass', 0.0),
                   torsion=physical.get('torsion', 0.0), profile=profile,
                   bending_friction=physical.get('bending_friction', 0.0),
                   bending_slip=physical.get('bending_slip', 0.1),
                   rest_curvature=tuple(zip(known[::2], known[1::2], strict=True)),
                   clamp_twist=physical.get('clamp_twist', 0.0))


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
        self.state = RodState(
            rest_lengths=np.empty(n - 1), stiffness=np.empty(n - 1), masses=np.empty(n),
            inverse_masses=np.empty(n), bending=np.empty((3, n)), frame=_no_frame(), friction=_no_friction(),
            held=np.zeros(0, np.int64), follow=np.zeros((0, 3)), drag=0.0, implicit=0.0,
            step=float(time_step), bands=np.zeros((BAND - 1 + 3 * n, BAND)),
            right=np.empty(3 * n))
        self.become(rest_lengths, properties, features)

    def become(self, rest_lengths: Floats, properties: RodProperties, features: Floats | None = None) -> None:
        """Become another chain of as many nodes; see the constructor."""
        state = self.state
        np.multiply(rest_lengths, properties.length_scale, out=state.rest_lengths)
        np.divide(properties.stretching_stiffness, state.rest_lengths, out=state.stiffness)
        self._lengths = state.rest_lengths.tobytes()
        self._rows, weights, total = _rows_and_weights(self._lengths)
        np.multiply(properties.mass, weights, out=state.masses)
        np.divide(state.masses, total, out=state.masses)
        if features is not None and properties.marker_mass:
            np.add(state.masses, properties.marker_mass * features, out=state.masses)
        self._uniform = all(part == 1 for part in properties.profile)
        self._properties = properties
        self._held: tuple[int, ...] | None = None
        self.state = state._replace(
            frame=_no_frame(), friction=_no_friction(), drag=float(properties.drag),
            implicit=float(state.step * max(properties.internal_damping, 0.6 * state.step)))
        self.hold(())

    def hold(self, nodes: Sequence[int], directions: Mapping[int, Floats] | None = None) -> None:
        """
        Let exactly these nodes follow given velocities from now on.

        A segment between two held nodes is rigid, so bending begins at its end, where a
        clamped DLO leaves its clamp.

        :param directions: unit vectors (3,) across clamped segments, by segment, that belong to the
            material frame.  Other clamps hold the DLO as they find it.
        """
        state = self.state
        if tuple(nodes) == self._held:
            return
        self._held = tuple(nodes)
        held, rigid, cells, weights, bands = _cells(self._lengths, self._held)
        np.divide(1.0, state.masses, out=state.inverse_masses)
        state.inverse_masses[held] = 0.0
        frame, friction = state.frame, state.friction
        if self._uniform:
            np.multiply(self._properties.bending_stiffness, bands, out=state.bending)
        if not self._uniform or self._framed or self._properties.bending_friction > 0:
            stiffnesses = self._stiffnesses(rigid)
            joints = stiffnesses * weights
            frame = self._frame(rigid, stiffnesses, cells, held, directions or {})
            friction = self._friction(joints, cells)
            if not self._uniform:
                state.bending[...] = _bending_bands(self._rows, joints)
        self.state = state._replace(
            held=held, follow=np.zeros((len(held), 3)), frame=frame, friction=friction)

    @property
    def _framed(self) -> bool:
        """Whether there may be a material frame."""
        properties = self._properties
        return properties.torsion > 0 or bool(properties.natural_curvature) or any(
            map(any, properties.rest_curvature))

    def _frame(self, rigid: NDArray[np.bool_], stiffnesses: Floats, cells: Floats, held: NDArray[np.int64],
               directions: Mapping[int, Floats]) -> FrameState:
        """Return the material frame; what the previous one knows of angles and clamps is kept."""
        properties, before = self._properties, self.state.frame
        twists = properties.torsion > 0
        clamped = np.flatnonzero(rigid) if twists else np.zeros(0, np.int64)
        curved = bool(properties.natural_curvature) or any(map(any, properties.rest_curvature))
        if not (curved or len(clamped)) or rigid.all():
            return _no_frame() if len(before.angles) else before
        n = len(rigid)
        inner = np.cumsum(self.state.rest_lengths)[:-1] / self.state.rest_lengths.sum()
        curvature = np.zeros((n - 1, 2))
        curvature[:, 0] = properties.natural_curvature
        if properties.rest_curvature:
            knots = np.linspace(0, 1, len(properties.rest_curvature))
            for component, values in enumerate(np.array(properties.rest_curvature).T):
                curvature[:, component] += np.interp(inner, knots, values)
        natural = np.where(cells > 0, stiffnesses, 0.0)[:, None] * curvature
        cells = np.where(cells > 0, cells, self.state.rest_lengths[1:])  # inside a clamp, any stiffness does
        frame = before if len(before.angles) else _frame_of(n)
        known = {int(segment): clamp for (segment, _), clamp in zip(frame.clamped, frame.clamps, strict=True)}
        clamps = np.full((len(clamped), 7), np.nan)
        for clamp, segment in zip(clamps, clamped.tolist(), strict=True):
            if segment in known:
                clamp[:] = known[segment]
            elif segment in directions:
                clamp[:3] = directions[segment]
        places = {int(node): place for place, node in enumerate(held)}
        return frame._replace(
            natural=np.column_stack([natural, np.hypot(*natural.T)]),
            twisting=properties.torsion * stiffnesses / cells if twists else np.zeros(0), clamps=clamps,
            clamped=np.array([(segment, places[segment]) for segment in clamped.tolist()],
                             np.int64).reshape(-1, 2))

    def _friction(self, joints: Floats, cells: Floats) -> SlipState:
        """Return the friction between strands; what the previous one keeps of the bends is kept."""
        properties, before = self._properties, self.state.friction
        if not properties.bending_friction > 0:
            return before
        slip = properties.bending_slip
        rows = np.column_stack([self._rows, joints * (properties.bending_friction / slip), cells * slip])
        if not len(before.rows):
            before = before._replace(kept=np.zeros((len(cells), 9)), begun=np.zeros(1, np.int64),
                                     pull=np.zeros((len(cells) + 2, 6)))
        return before._replace(rows=rows)

    def _stiffnesses(self, rigid: NDArray[np.bool_]) -> Floats:
        """Return the bending stiffness at each inner node, (N - 2,) [N m^2]."""
        lengths = self.state.rest_lengths
        stiffness: Floats = np.full(len(lengths) - 1, self._properties.bending_stiffness)
        if self._uniform:
            return stiffness
        profile = np.array(self._properties.profile)
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


def _frame_of(segments: int) -> FrameState:
    """Return the state of a material frame that has not begun, without clamps."""
    joints = max(segments - 1, 0)
    return FrameState(
        natural=np.zeros((joints, 3)), twisting=np.zeros(0), angles=np.zeros(segments),
        clamped=np.zeros((0, 2), np.int64), clamps=np.zeros((0, 7)), carried=np.zeros((3, 3)),
        begun=np.zeros(1, np.int64), segments=np.zeros((segments, 7)), joints=np.zeros((joints, 7)),
        turning=np.zeros((segments, 2)))


@lru_cache(maxsize=1)
def _no_frame() -> FrameState:
    """Return the frame of a straight DLO that does not resist twist."""
    return _frame_of(0)


@lru_cache(maxsize=1)
def _no_friction() -> SlipState:
    """Return the state of a DLO without friction between strands."""
    return SlipState(rows=np.zeros((0, 5)), kept=np.zeros((0, 9)), begun=np.zeros(1, np.int64),
                     pull=np.zeros((0, 6)))


# The trials of a calibration have the same lengths again and again.
@lru_cache(maxsize=256)
def _rows_and_weights(lengths: bytes) -> tuple[Floats, Floats, float]:
    """
    Return what depends on the rest lengths alone.

    :returns: (N - 2, 3) [1/m]: multiplied by three nodes, they give the change of the unit tangent there;
        (N,) [m] the length that belongs to each node; and their sum.
    """
    rest_lengths = np.frombuffer(lengths)
    before, after = 1 / rest_lengths[:-1], 1 / rest_lengths[1:]
    weights = np.zeros(len(rest_lengths) + 1)
    weights[:-1] += rest_lengths / 2
    weights[1:] += rest_lengths / 2
    return (frozen_array(np.stack([before, -(before + after), after], axis=1)), frozen_array(weights),
            float(weights.sum()))


@lru_cache(maxsize=256)
def _cells(lengths: bytes, held: tuple[int, ...]
           ) -> tuple[NDArray[np.int64], NDArray[np.bool_], Floats, Floats, Floats]:
    """
    Return what depends on the rest lengths and on the held nodes.

    :returns: (h,) the nodes, as kernels take them; (N - 1,) which segments are rigid; (N - 2,) [m] the
        length that bends at each inner node; (N - 2,) [1/m] its inverse, 0 where nothing bends; and the
        bending matrix of a DLO whose bending stiffness is 1 N m^2, see `_bending_bands`.
    """
    rest_lengths = np.frombuffer(lengths)
    nodes, follows = np.array(held, np.int64), np.zeros(len(rest_lengths) + 1, bool)
    follows[nodes] = True
    rigid = follows[:-1] & follows[1:]
    bendable = np.where(rigid, 0.0, rest_lengths)
    cells = (bendable[:-1] + bendable[1:]) / 2
    weights = np.divide(1.0, cells, out=np.zeros_like(cells), where=cells > 0)
    bands = _bending_bands(_rows_and_weights(lengths)[0], weights)
    return nodes, rigid, frozen_array(cells), frozen_array(weights), frozen_array(bands)


def _bending_bands(rows: Floats, joints: Floats) -> Floats:
    """
    Return the diagonal and the two below it, (3, N) [N/m], of the symmetric (N, N) bending matrix.

    :param rows: see `_rows_and_weights`.
    :param joints: (N - 2,) [N m] moment per angle at the inner nodes.
    """
    n = len(rows) + 2
    bands = np.zeros((3, n))
    for a in range(3):
        weighted = joints * rows[:, a]
        for b in range(a + 1):
            bands[a - b, b:n - 2 + b] += weighted * rows[:, b]
    return bands
