# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
MJCF: a calibrated DLO for MuJoCo 3 and 4, as a chain of capsules that ball joints connect.

A ball joint has the stiffness EI / l.  Its position of rest is the rest shape of the DLO, in which the
bodies stand; the keyframe `start` has the observed chain.  In the form `extensible`, a slide joint of
stiffness EA / l before each ball joint lets the segment become longer.

The integrator that both versions have, `implicitfast`, takes the springs of joints explicitly.  A spring of
stiffness k needs a step below ``2 sqrt(m / k)``, which is far below a millisecond for a segment of a gram.
So each joint has an armature of ``k h^2``: with it, every spring is stable at the step h, also in the contact
solver, which knows no implicit damping.  An armature resists only bending and stretching, and slows a mode of
frequency w by the share ``(w h)^2 / 2``.  The damping is the calibrated one, but at least 0.6 h k, as in
`simulation.rod`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError, one_of
from dlo_calibration.export.bodies import COLOUR, corners_and_faces
from dlo_calibration.export.rope import ExportedRope
from dlo_calibration.files.xml import add, add_comment, document, new_root
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import interval, measured
from dlo_calibration.planning.dlo import CalibratedDlo
from dlo_calibration.simulation.scene import Obstacle

NAME = 'dlo'  # begins the names of bodies, joints, geoms and sites
OBSTACLE = 'obstacle'  # begins the names of those of a scene
FORMS = ('extensible', 'inextensible')
MOST_NODES = 400  # MuJoCo reads elements that are nested up to 500 deep
TIME_STEP = 0.002  # s
#: Friction against turning about the normal and against rolling, relative to that of sliding and the radius.
#: The DLO is to slide, as in the calibration.  In the elliptic cone, a ratio c of rolling leaves sliding
#: ``1 / sqrt(1 + 1 / c^2)`` of its friction.
TURNING, ROLLING = 0.01, 4.0
SOLREF = '0.004 1'  # s and damping ratio, of the contact of the DLO
#: How much harder friction is than the contact itself.  At MuJoCo's 1, a DLO that is held up creeps.
HARDNESS = 10
LEAST_DAMPING = 0.6  # time steps, of the damping relative to the stiffness


def export_mjcf(dlo: CalibratedDlo, chain: Chain, *, form: str = FORMS[0],
                options: Options | None = None) -> str:
    """
    Return a calibrated DLO at an observed chain as the text of an MJCF file.

    :param dlo: a `CalibrationResult`, or the `Description` that `read_result` returns.
    :param form: extensible: with the calibrated EA; inextensible: faster, for a DLO that nothing stretches.
    :param options: see `ExportedRope.of`.
    :raises InputError: if the form is unknown, there are too many points or nodes, or the scene cannot be
        read.
    """
    rope = ExportedRope.of(dlo, chain, options)
    if form not in FORMS:
        raise InputError('form', repr(form), one_of(FORMS, form), 'correct it')
    if len(rope.points) > MOST_NODES:
        raise InputError('nodes', str(len(rope.points)), f'at most {MOST_NODES}, as MuJoCo reads no deeper '
                         'nested bodies', 'take fewer nodes')
    return document(_MjcfWriter(rope, form == 'extensible').root()).decode()


class _MjcfWriter:
    """
    Makes the elements of a file.

    :param stretches: whether segments can become longer.
    """

    def __init__(self, rope: ExportedRope, stretches: bool) -> None:
        self._rope, self._stretches = rope, stretches
        self._least = max(rope.internal_damping, LEAST_DAMPING * TIME_STEP)  # s, damping by stiffness

    def root(self) -> Any:
        """Return the root element."""
        rope, root = self._rope, new_root('mujoco', model=NAME)
        add_comment(root, self._about())
        add(root, 'option', timestep=TIME_STEP, integrator='implicitfast', cone='elliptic', impratio=HARDNESS,
            viscosity=_text(self._viscosity()))
        defaults = add(root, 'default')
        group = add(defaults, 'default', **{'class': NAME})
        add(group, 'geom', type='capsule', size=_text(rope.radius), priority=1, condim=6,
            friction=self._friction(1.0), solref=SOLREF, rgba='0.9 0.6 0.2 1')
        add(group, 'site', size=_text(1.1 * rope.radius), group=4)
        if rope.obstacles:
            group = add(defaults, 'default', **{'class': OBSTACLE})
            # Above the priority of the DLO, so that the friction of both counts, not that of the DLO alone.
            add(group, 'geom', priority=2, condim=6, solref=SOLREF, rgba=_text([*COLOUR, 1]))
            self._meshes(add(root, 'asset'))
        world = add(root, 'worldbody')
        add(world, 'light', pos='0 0 2', dir='0 0 -1', directional='true')
        if rope.table is not None:
            add(world, 'geom', name='table', type='plane', size='0 0 0.1', pos=_text([0, 0, rope.table]),
                friction=_text([1, 0, 0]), rgba='0.5 0.5 0.5 1')
        for number, obstacle in enumerate(rope.obstacles):
            self._obstacle(world, number, obstacle)
        parent = world
        for k in range(len(rope.rest_lengths)):
            parent = self._segment(parent, k)
        contact = add(root, 'contact')
        for k in range(len(rope.rest_lengths)):
            for other in range(k + 1, min(k + 1 + self._touching(), len(rope.rest_lengths))):
                add(contact, 'exclude', body1=f'{NAME}_{k}', body2=f'{NAME}_{other}')
        add(add(root, 'keyframe'), 'key', name='start', qpos=_text(self._start()))
        return root

    def _friction(self, share: float) -> str:
        """Return the friction of the DLO with a body, whose coefficient is `share`."""
        radius = self._rope.radius
        return _text(share * self._rope.friction * np.array([1, TURNING * radius, ROLLING * radius]))

    def _meshes(self, assets: Any) -> None:
        for number, obstacle in enumerate(self._rope.obstacles):
            if obstacle.shape == 'mesh':
                corners, faces = corners_and_faces(obstacle)
                add(assets, 'mesh', name=f'{OBSTACLE}_{number}', vertex=_text(corners.ravel()),
                    face=' '.join(map(str, faces.ravel().tolist())))

    def _obstacle(self, world: Any, number: int, obstacle: Obstacle) -> None:
        name, shape = f'{OBSTACLE}_{number}', obstacle.shape
        if shape == 'mesh':
            size = None
        elif shape == 'box':
            size = _text(obstacle.sizes / 2)
        else:  # the radius, and half the length
            size = _text((obstacle.sizes * [0.5, 1.0][-len(obstacle.sizes):])[::-1])
        add(world, 'geom', name=name, **{'class': OBSTACLE}, type=shape, mesh=None if size else name,
            size=size, pos=_text(obstacle.position), quat=_text(np.roll(obstacle.turn, 1)),
            friction=self._friction(obstacle.friction))

    def _segment(self, parent: Any, k: int) -> Any:
        """Add the body of a segment to that of the one before, or the first to the world; return it."""
        rope, length, mass = self._rope, float(self._rope.rest_lengths[k]), float(self._rope.masses[k])
        across = mass * (length**2 / 12 + rope.radius**2 / 4)
        if k == 0:
            body = add(parent, 'body', name=f'{NAME}_0', pos=_text(rope.points[0]),
                       quat=_text(_quaternions(rope.turns[0])), childclass=NAME)
            add(body, 'freejoint', name=f'{NAME}_root')
        else:
            turn = rope.rest_turns[k - 1]
            body = add(parent, 'body', name=f'{NAME}_{k}', pos=_text([rope.rest_lengths[k - 1], 0, 0]),
                       quat=_text(_quaternions(turn)))
            if self._stretches:
                stiffness = rope.stretching_stiffness / self._stretched()[k - 1]
                add(body, 'joint', name=f'{NAME}_stretch_{k}', type='slide',
                    axis=_text(turn.inv().apply([1, 0, 0])), stiffness=_text(stiffness),
                    damping=_text(stiffness * self._least), armature=_text(stiffness * TIME_STEP**2))
            stiffness = rope.bending_stiffness[k - 1] / rope.cells[k - 1]
            add(body, 'joint', name=f'{NAME}_bend_{k}', type='ball', stiffness=_text(stiffness),
                damping=_text(stiffness * self._least), armature=_text(max(stiffness * TIME_STEP**2, across)))
        add(body, 'inertial', pos=_text([length / 2, 0, 0]), mass=_text(mass),
            diaginertia=_text([mass * rope.radius**2 / 2, across, across]))
        add(body, 'geom', name=f'{NAME}_{k}', fromto=_text([0, 0, 0, length, 0, 0]))
        for point, place in enumerate(rope.point_places.tolist()):
            segment, along_it = rope.place_of(place)
            if segment == k:
                add(body, 'site', name=f'{NAME}_point_{point}', pos=_text([along_it, 0, 0]))
        self._markers(body, k)
        return body

    def _markers(self, body: Any, k: int) -> None:
        """Add the marker at the first node of a segment, and that at the last node of the last segment."""
        rope, last = self._rope, len(self._rope.points) - 1
        for node in (k, last) if k == last - 1 else (k,):
            mass = float(rope.marker_masses[node])
            if mass > 0:
                marker = add(body, 'body', name=f'{NAME}_marker_{node}',
                             pos=_text([0 if node == k else rope.rest_lengths[k], 0, 0]))
                add(marker, 'inertial', pos='0 0 0', mass=_text(mass),
                    diaginertia=_text(3 * [0.4 * mass * rope.radius**2]))

    def _start(self) -> Floats:
        """Return the positions of all joints at the observed chain."""
        turns = self._rope.turns
        bends = _quaternions(self._rope.rest_turns.inv() * turns[:-1].inv() * turns[1:])
        joints = np.column_stack([np.zeros(len(bends)), bends]) if self._stretches else bends
        return np.concatenate([self._rope.points[0], _quaternions(turns[0]), joints.ravel()])

    def _stretched(self) -> Floats:
        """Return the length [m] whose stretch each inner node has, (n - 2,); the ends' halves are added."""
        lengths = np.array(self._rope.cells)
        lengths[0] += self._rope.rest_lengths[0] / 2
        lengths[-1] += self._rope.rest_lengths[-1] / 2
        return lengths

    def _touching(self) -> int:
        """Return how many segments after each one are too near to touch it, see `simulation.rope`."""
        return max(1, int(np.ceil(np.pi * self._rope.radius / self._rope.rest_lengths.min())))

    def _viscosity(self) -> float:
        """
        Return the viscosity of the air [Pa s] in which a segment is slowed by the calibrated drag.

        MuJoCo's inertia box of a rod is l by sqrt(3) r by sqrt(3) r, and its drag is 3 pi times the viscosity
        and the mean of these (MuJoCo documentation, Computation, Fluid forces, Inertia model).
        """
        rope = self._rope
        size = (rope.rest_lengths[0] + 2 * np.sqrt(3) * rope.radius) / 3
        return float(rope.drag * rope.masses[0] / (3 * np.pi * size))

    def _about(self) -> list[str]:
        """Return the lines of the comment at the top of the file."""
        rope = self._rope
        ends = float(rope.bending_stiffness.min()), float(rope.bending_stiffness.max())
        bending = measured(ends[0], 'N m^2') if np.isclose(*ends) else interval(*ends, 'N m^2')
        return [
            'A calibrated DLO, written by dlo_calibration; SI units. Found parameters:', *rope.values,
            *rope.warnings, 'Kept:',
            f'EI of {bending} in the ball joints, the rest shape (the bodies stand in it), mass of '
            f'{1e3 * rope.masses.sum():.3g} g, friction (also against rolling: the DLO slides), drag as '
            'viscosity of the air; the keyframe "start" has the chain',
            f'EA of {measured(rope.stretching_stiffness, "N")} in the slide joints' if self._stretches else
            'the lengths: this form does not stretch',
            'Not kept:', *self._lost(),
            'In a world of your own, whose options hold instead of those here, take this time step or a '
            f'shorter one, the elliptic cone, impratio {HARDNESS}, and this viscosity.']

    def _lost(self) -> list[str]:
        """Return a line for each property of the DLO that MuJoCo cannot represent."""
        rope = self._rope
        twist = 'the trials were simulated without resistance to twist' if rope.twisting_stiffness is None \
            else f'GJ {measured(float(rope.twisting_stiffness[0]), "N m^2")} was found'
        lines = [f'twist: ball joints resist twist as bending; {twist}',
                 f'contact between {self._touching() + 1} neighbouring segments',
                 f'damping relative to the stiffness of {1e3 * rope.internal_damping:.3g} ms; it is '
                 f'{1e3 * self._least:.3g} ms here']
        if rope.bending_friction > 0:
            lines.append(f'bends that stay: friction between strands of {rope.bending_friction:.3g} 1/m '
                         f'times EI, which slip at {rope.bending_slip:.3g} 1/m')
        if any(obstacle.shape == 'mesh' for obstacle in rope.obstacles):
            lines.append('dents and holes of meshes among the obstacles: MuJoCo touches their convex hulls')
        if rope.locking > 0:
            lines.append(f'locking: EI has doubled at a bend radius of {measured(rope.locking, "m")}')
        if rope.clamp_twist:
            lines.append(f'the angle of the second clamp, {rope.clamp_twist:.3g} rad')
        if any(rope.clamp_bends):
            lines.append('how askew the DLO stands in its clamps, '
                         f'{", ".join(f"{bend:.3g}" for bend in rope.clamp_bends)} rad')
        return lines


def _quaternions(rotations: Rotation) -> Floats:
    """Return (..., 4) quaternions w x y z, with w >= 0."""
    return np.roll(rotations.as_quat(canonical=True), 1, axis=-1)


def _text(values: Any) -> str:
    """Return numbers as text, with nine digits."""
    return ' '.join(f'{value:.9g}' for value in np.atleast_1d(np.asarray(values, dtype=float)))
