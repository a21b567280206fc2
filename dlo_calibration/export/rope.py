# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""ExportedRope: a calibrated DLO at an observed chain, as every format for another simulator needs it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_calibration.calibration.engines import obstacles_of
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import ParameterEstimate
from dlo_calibration.inference.uncertainty import NOT_IDENTIFIABLE
from dlo_calibration.model.chain import Chain, Floats, frozen_array
from dlo_calibration.model.parameters import (
    BY_NAME,
    CLAMP_BENDS,
    measured,
    natural_curvature,
    ParameterSpace,
    stiffness_profile,
)
from dlo_calibration.observation.noise import NO_NOISE, noise_of, smooth
from dlo_calibration.observation.table import lying_level, rest_on
from dlo_calibration.planning.dlo import CalibratedDlo
from dlo_calibration.simulation.nodes import feature_shares, spread_places
from dlo_calibration.simulation.scene import Obstacle

LEVEL_TOLERANCE = 1e-3  # m; a table that is moved by less is not worth a warning
LENGTH_TOLERANCE = 0.05  # of the length; a chain that differs by more may belong to another DLO


@dataclass(frozen=True)
class ExportedRope:
    """
    A DLO of n nodes; inner node j, of n - 2, lies between segments j and j + 1.  All values in SI units.

    :param points: (n, 3) nodes at the start [m]: the chain without its noise; those that rest on the table
        lie exactly on it.
    :param rest_lengths: (n - 1,) of the segments [m].
    :param masses: (n - 1,) of the segments [kg]; `marker_masses` (n,) in addition, at the nodes.
    :param radius: [m].
    :param bending_stiffness: (n - 2,) EI at the inner nodes [N m^2].
    :param stretching_stiffness: EA [N].
    :param twisting_stiffness: (n - 2,) GJ at the inner nodes [N m^2]; None: the trials were simulated without
        resistance to twist.
    :param natural_curvature: (n - 2, 2) components of the curvature of the rest shape in `frames` [1/m].
    :param frames: (n - 1, 3, 3) material frame of each segment at the start, its columns the direction of the
        segment and two across it, not twisted; turned about the DLO so that the start bends it least.
    :param clamp_twist: angle between the rest shape and a second clamp [rad].
    :param clamp_bends: both components of the bends at the first and the second clamp [rad].
    :param drag: acceleration against the velocity, relative to it [1/s].
    :param internal_damping: damping of bending and stretching, relative to their stiffness [s].
    :param friction: Coulomb coefficient of the DLO with the table and with itself.
    :param bending_friction: largest moment of friction between strands, relative to EI [1/m]; 0: none.
    :param bending_slip: change of curvature at which they slip [1/m].
    :param locking: bend radius at which EI has doubled [m]; 0: none.
    :param table: height of the table [m]; None: there is none.
    :param obstacles: of the scene.
    :param point_places: (m,) arc lengths of the points of the chain at rest [m], from 0.
    :param values: a line for each found parameter: value, 90 % interval, verdict.
    :param warnings: which parameters the trials do not determine, and what was assumed.
    """

    points: Floats
    rest_lengths: Floats
    masses: Floats
    marker_masses: Floats
    radius: float
    bending_stiffness: Floats
    stretching_stiffness: float
    twisting_stiffness: Floats | None
    natural_curvature: Floats
    frames: Floats
    clamp_twist: float
    clamp_bends: tuple[float, ...]
    drag: float
    internal_damping: float
    friction: float
    bending_friction: float
    bending_slip: float
    locking: float
    table: float | None
    obstacles: tuple[Obstacle, ...]
    point_places: Floats
    values: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def cells(self) -> Floats:
        """Length that bends at each inner node, (n - 2,) [m]: the stiffness of a joint there is EI / cell."""
        return np.asarray((self.rest_lengths[:-1] + self.rest_lengths[1:]) / 2)

    @property
    def length(self) -> float:
        """Length at rest [m]."""
        return float(self.rest_lengths.sum())

    @property
    def slender(self) -> bool:
        """Whether only neighbours among the segments touch each other where the DLO is straight."""
        return bool(self.rest_lengths.min() > 2 * self.radius)

    @property
    def turns(self) -> Rotation:
        """The n - 1 rotations of the segments at the start."""
        return Rotation.from_matrix(self.frames.copy())  # SciPy 1.11 cannot read what must not be written

    @property
    def rest_turns(self) -> Rotation:
        """The n - 2 rotations from each segment to the next in the rest shape: towards the curvature."""
        bends = self.natural_curvature * self.cells[:, None]
        return Rotation.from_rotvec(np.column_stack([np.zeros(len(bends)), -bends[:, 1], bends[:, 0]]))

    @property
    def rest_frames(self) -> Floats:
        """
        Material frames of the segments in the rest shape, (n - 1, 3, 3), the first as at the start.

        They turn from segment to segment by the smallest rotation, as in `model.parameters.rest_shape`.
        """
        return np.array([*accumulate(self.rest_turns.as_matrix(), np.matmul, initial=self.frames[0])])

    def place_of(self, place: float) -> tuple[int, float]:
        """Return the segment at an arc length [m], and how far from its first node it is [m]."""
        ends = np.concatenate([[0.0], np.cumsum(self.rest_lengths)])
        segment = int(np.clip(np.searchsorted(ends, place, side='right') - 1, 0, len(ends) - 2))
        return segment, float(min(max(place - ends[segment], 0.0), self.rest_lengths[segment]))

    @classmethod
    def of(cls, dlo: CalibratedDlo, chain: Chain, options: Options | None = None) -> ExportedRope:
        """
        Return a calibrated DLO at an observed chain.

        :param dlo: a `CalibrationResult`, or the `Description` that `read_result` returns.
        :param options: `nodes`, `table`, `table_height` and `scene` are used; None: the defaults.
        :raises InputError: if the scene cannot be read.
        """
        options = options or Options()
        physical = dlo.space.physical({name: estimate.value for name, estimate in dlo.parameters.items()},
                                        dlo.length)
        radius, twisting = physical['self_collision'], physical.get('torsion', 0.0)
        # In a scene, a DLO that lies flat may lie on an obstacle: that says nothing about the table.
        level = lying_level(chain, options.table_height) if options.table and not options.scene else None
        chain = _without_noise(chain)
        places = spread_places(np.array([0.0, chain.length]), options.nodes)
        points = chain.resample(places)
        if level is not None:
            points = rest_on(points, level)
        lengths = np.diff(places) * physical.get('length_scale', 1.0)
        ends = np.concatenate([[0.0], np.cumsum(lengths)])
        stiffness = physical['flexibility'] * _relative_stiffness(ends, stiffness_profile(physical))
        natural = natural_curvature(physical, ends[1:-1] / ends[-1])
        return cls(
            points=frozen_array(points), rest_lengths=frozen_array(lengths), radius=radius,
            masses=frozen_array(physical['mass'] * lengths / ends[-1]),
            marker_masses=frozen_array(physical.get('marker_mass', 0.0) * feature_shares(chain, places)),
            bending_stiffness=frozen_array(stiffness), stretching_stiffness=physical['elasticity'],
            twisting_stiffness=frozen_array(twisting * stiffness) if twisting > 0 else None,
            natural_curvature=frozen_array(natural),
            frames=frozen_array(_material_frames(points, stiffness[:, None] * natural)),
            clamp_twist=physical.get('clamp_twist', 0.0),
            clamp_bends=tuple(physical.get(name, 0.0) for name in CLAMP_BENDS), drag=physical['damping'],
            internal_damping=physical['internal_damping'], friction=physical['friction'],
            bending_friction=physical.get('bending_friction', 0.0),
            bending_slip=physical.get('bending_slip', 0.0),
            locking=physical.get('locking', 0.0),
            table=None if not options.table else options.table_height if level is None else level - radius,
            obstacles=obstacles_of(options),
            point_places=frozen_array(chain.arc_lengths() * lengths.sum() / places[-1]),
            values=_values(dlo),
            warnings=(*_undetermined(dlo), *_assumed(dlo, physical, chain),
                     *_about_table(level, radius, options)))


def _without_noise(chain: Chain) -> Chain:
    """Return a chain smoothed according to its own noise level: noise makes a chain longer, and bends it."""
    level = noise_of([chain.points[None]])
    return Chain(smooth(chain.points, level), features=chain.features) if level > NO_NOISE else chain


def _relative_stiffness(ends: Floats, profile: Floats) -> Floats:
    """
    Return the bending stiffness at the inner nodes, (n - 2,), relative to that of the first part.

    Around a node, from the middle of one segment to the middle of the next, pieces of different stiffness
    bend one after the other, as in `simulation.rod`.

    :param ends: (n,) arc lengths of the nodes [m].
    :param profile: see `stiffness_profile`.
    """
    bounds = np.linspace(0, ends[-1], len(profile) + 1)
    bend = np.concatenate([[0.0], np.cumsum(np.diff(bounds) / profile)])
    middles = (ends[1:] + ends[:-1]) / 2
    return np.asarray(np.diff(middles) / np.diff(np.interp(middles, bounds, bend)))


def _material_frames(points: Floats, moments: Floats) -> Floats:
    """
    Return a frame of each segment, (n - 1, 3, 3).

    It is carried along without twist (Bishop, There is more than one way to frame a curve, 1975).  As a
    whole, it is turned about the DLO to the angle of least bending energy: that at which `moments` of the
    rest shape agree best with how the DLO is bent.

    :param points: (n, 3) [m].
    :param moments: (n - 2, 2) components of EI times the natural curvature.
    """
    tangents = np.diff(points, axis=0)
    tangents = tangents / np.linalg.norm(tangents, axis=1)[:, None]
    start = np.eye(3)[np.abs(tangents[0]).argmin()]
    across = np.cross(tangents[0], start)
    frames = [np.column_stack([tangents[0], across, np.cross(tangents[0], across)])
              / [1.0, *2 * [np.linalg.norm(across)]]]
    for tangent, following in zip(tangents[:-1], tangents[1:], strict=True):
        frames.append(_smallest_rotation(tangent, following) @ frames[-1])
    carried = np.array(frames)
    bends = np.einsum('jik,ji->jk', carried[:-1] + carried[1:], np.diff(tangents, axis=0))[:, 1:]
    angle = np.arctan2((moments[:, 0] * bends[:, 1] - moments[:, 1] * bends[:, 0]).sum(),
                       (moments * bends).sum())
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    return np.asarray(carried @ turn)


def _smallest_rotation(start: Floats, end: Floats) -> Floats:
    """Return the (3, 3) rotation by the smallest angle that turns one unit vector, (3,), into another."""
    axis, cosine = np.cross(start, end), float(start @ end)
    if cosine < -1 + 1e-9:  # the DLO turns back on itself: any axis across it does
        across = np.cross(start, np.eye(3)[np.abs(start).argmin()])
        across /= np.linalg.norm(across)
        return np.asarray(2 * np.outer(across, across) - np.eye(3))
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + cosine))


def _values(dlo: CalibratedDlo) -> tuple[str, ...]:
    return tuple(
        f'{name}, {BY_NAME[name].quantity}: {_said(dlo.space, estimate)} '
        f'({_interval(dlo.space, name, estimate.lower, estimate.upper)}), '
        f'{estimate.verdict or "verdict unknown"}'
        for name, estimate in dlo.parameters.items())


def _undetermined(dlo: CalibratedDlo) -> list[str]:
    """Return a warning for each parameter that the trials do not determine, with its interval."""
    return [f'{name} is not identifiable: the trials allow '
            f'{_interval(dlo.space, name, estimate.lower, estimate.upper)}; '
            f'{_said(dlo.space, estimate)} is used'
            for name, estimate in dlo.parameters.items() if estimate.verdict == NOT_IDENTIFIABLE
            or not estimate.verdict and not estimate.identifiable]


def _assumed(dlo: CalibratedDlo, physical: Mapping[str, float], chain: Chain) -> list[str]:
    warnings = []
    if not dlo.space.mass_known:
        warnings.append(f'the mass of the DLO is unknown: {1e3 * physical["mass"]:.3g} g are assumed, and EI '
                       'and EA hold for this mass; all three may be multiplied by the same number')
    change = abs(chain.length - dlo.length) / dlo.length
    if change > LENGTH_TOLERANCE:
        warnings.append(f'the chain is {chain.length:.4g} m long, {100 * change:.0f} % from the '
                       f'{dlo.length:.4g} m of the calibrated DLO: check that both are the same DLO, in '
                       'metres')
    return warnings


def _about_table(level: float | None, radius: float, options: Options) -> list[str]:
    if level is None or abs(level - radius - options.table_height) < LEVEL_TOLERANCE:
        return []
    return [f'the chain lies {measured(level - options.table_height, "m")} above the table, the radius is '
            f'{measured(radius, "m")}: the table is at {measured(level - radius, "m")}, so that the DLO '
            'touches it where it was seen']


def _said(space: ParameterSpace, estimate: ParameterEstimate) -> str:
    """Return a value for people, as it is written beside its interval."""
    value, unit = space.reported(estimate.name, estimate.value)
    return measured(value, unit, estimate.physical_upper)


def _interval(space: ParameterSpace, name: str, lower: float, upper: float) -> str:
    """Return a 90 % interval for people."""
    (first, unit), (second, _) = (space.reported(name, value) for value in (lower, upper))
    return f'90 %: {BY_NAME[name].interval(lower, upper, (min(first, second), max(first, second)), unit)}'
