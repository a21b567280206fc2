# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Single steps of the core, for tests."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.simulation import core

NO_TABLE = -1e6  # m; height of a table that nothing touches
ALONE = 1e6  # m; a self-collision radius with which no segments are far enough apart along a DLO to touch


def properties(flexibility, elasticity, mass, damping=0.0, internal_damping=0.0, *, profile=(1.0,),
               rest_curvature=(), **others):
    """
    Return physical parameters, by name, of a DLO that does not touch itself.

    :param profile: bending stiffness of parts of equal length, relative to that of the first part.
    :param rest_curvature: pairs of components of the natural curvature [1/m].
    """
    parts = {f'stiffness_{part}': ratio for part, ratio in enumerate(profile[1:], start=2)}
    knots = {f'rest_curvature_{axis}{knot}': component for knot, pair in enumerate(rest_curvature, start=1)
             for axis, component in zip('xy', pair, strict=True)}
    return {'flexibility': flexibility, 'elasticity': elasticity, 'mass': mass, 'damping': damping,
            'internal_damping': internal_damping, 'friction': 0.0, 'self_collision': ALONE,
            **parts, **knots, **others}


class SteppedRod:
    """Internal forces of a DLO that starts straight, step by step, from points that the caller gives."""

    def __init__(self, rest_lengths, physical, time_step, features=None):
        places = np.concatenate([[0.0], np.cumsum(rest_lengths)])
        nothing = np.zeros((len(places), 3))
        start = core.Start(places, places[:, None] * (1.0, 0, 0), nothing, features)
        self.rope = core.Rope(start, physical, time_step, NO_TABLE, np.zeros(3))
        self.time_step = time_step
        self.follow = np.zeros((0, 3))

    @property
    def state(self):
        """What determines its steps, see `core.Rope.state`."""
        return SimpleNamespace(**self.rope.state, held=np.array(self.rope.held, int), follow=self.follow,
                               step=self.time_step)

    def hold(self, nodes):
        """Hold exactly these nodes."""
        self.rope.hold([int(node) for node in nodes])

    def velocities(self, points, velocities, gravity, held_velocities, turns=None):
        """Return the (N, 3) [m/s] velocities after a step without contacts."""
        rope, step = self.rope, self.time_step
        rope.points[:], rope.velocities[:] = points, velocities + step * gravity
        self.follow = np.asarray(held_velocities)
        rope.aim(rope.points[rope.held] + step * self.follow, turns)
        assert rope.predict()
        return rope.predicted.copy()

    def frame_forces(self, points, times=1):
        """Return the (N, 3) [N] forces of the material frame, after so many steps at the same points."""
        for _ in range(times + 1):  # the first one only finds where the clamps hold
            self.velocities(points, np.zeros_like(points), np.zeros(3), np.zeros((len(self.rope.held), 3)))
        impulses = self.rope.state['frame_impulses']
        return impulses / self.time_step if len(impulses) else np.zeros_like(points)

    def turned(self, points, axes):
        """Turn clamps by rotation vectors (3,), given by held node; what they hold stays where it is."""
        pieces = 1 + int(max((np.linalg.norm(axis) for axis in axes.values()), default=0))
        held = self.rope.held
        rotations = np.tile(np.eye(3), (len(held), 1, 1))
        for place, node in enumerate(held):
            if node in axes:
                rotations[place] = Rotation.from_rotvec(np.array(axes[node]) / pieces).as_matrix()
        still = np.zeros((len(held), 3))
        for _ in range(pieces):
            self.velocities(points, np.zeros_like(points), np.zeros(3), still, rotations.reshape(-1, 9))


class SteppedRope:
    """A DLO, in the air or on a table, whose steps are those of the compiled engine."""

    def __init__(self, places, points, velocities, physical, time_step, level=NO_TABLE,
                 gravity=(0.0, 0.0, -GRAVITY)):
        self._rope = core.Rope(core.Start(places, points, velocities), physical, time_step, level, gravity)
        self.hold = self._rope.hold

    @property
    def points(self):
        """The nodes' positions now, (N, 3) [m]; a copy."""
        return self._rope.points.copy()

    def advance(self, targets, turns=None):
        """
        Take k steps.

        :param targets: (k, h, 3) [m] positions of the held nodes after each step.
        :param turns: (k, h, 9) rotations of their hands in each step, row by row; None: see `core.Rope.aim`.
        """
        for k, target in enumerate(targets):
            self._rope.aim(target, None if turns is None else turns[k])
            if not self._rope.step():
                raise SimulationError('the rollout diverged')


class Touching:
    """Contact of a DLO with itself, step by step, from points and velocities that the caller gives."""

    def __init__(self, places, radius, friction, time_step):
        self._places, self._step = places, time_step
        self._physical = {  # without internal forces; markers are its mass
            **properties(0.0, 0.0, 1e-300, marker_mass=1.0), 'self_collision': radius, 'friction': friction}

    def start(self, points):
        """Take the (N, 3) [m] points at the start."""
        self._start, self._moved, self._rope = points.copy(), np.zeros_like(points), None

    def velocities(self, points, velocities, inverse_masses, support):
        """
        Return the (N, 3) [m/s] velocities that contacts allow.

        :param inverse_masses: (N,) [1/kg], 0 for held nodes; those of the first call count.
        """
        if self._rope is None:
            masses = 1 / np.where(inverse_masses > 0, inverse_masses, 1.0)
            start = core.Start(self._places, self._start, self._moved, masses)
            self._rope = core.Rope(start, self._physical, self._step, NO_TABLE, np.zeros(3))
            self._rope.hold(np.flatnonzero(inverse_masses == 0).tolist())
        rope = self._rope
        rope.points[:], rope.support[:] = points, support
        # A step looks for contacts according to the velocities of the last one, by which the points moved.
        for begun in (self._moved, velocities):
            rope.velocities[:] = begun
            rope.aim((points + self._step * begun)[rope.held])
            assert rope.predict()
        self._moved = rope.predicted.copy()
        return self._moved
