# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The compiled engine: the rope of `bullet` with a contact of its own, for a table or none.

Same rod, table, friction, self-contact, grips, stable test and time step as the
PyBullet engine, without a call into another library for each node and step.
"""

from __future__ import annotations

import copy
from typing import Any, Mapping

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.table import rest_on, resting_level
from dlo_calibration.simulation import kernels
from dlo_calibration.simulation.nodes import Layout
from dlo_calibration.simulation.protocol import DEFAULT_NODES, DEFAULT_TIME_STEP, Rollout
from dlo_calibration.simulation.rod import Rod, RodProperties
from dlo_calibration.simulation.rollout import roll_out, Settling

NO_PATH = np.empty((0, 0, 3))
NOWHERE = -1e6  # m: where there is no table


class CompiledRope:
    """
    A rope on a table or in the air, stepped by `kernels`.

    :param nodes: N.
    :param time_step: [s].
    """

    def __init__(self, nodes: int, time_step: float) -> None:
        self.time_step = time_step
        segments = nodes - 1
        self._distances = np.empty((segments, segments))
        self._pairs = np.empty((segments * (segments - 1) // 2, 2), np.int64)
        self._contacts = np.empty((len(self._pairs), kernels.CONTACT_COLUMNS))
        self._bands = np.empty((3 * nodes + kernels.BAND - 1, kernels.BAND))
        self._right = np.empty(3 * nodes + kernels.BAND - 1)
        self._wanted = np.empty((nodes, 3))
        self._change = np.empty((nodes, 3))

    def reset(self, places: Floats, points: Floats, velocities: Floats, physical: Mapping[str, float],
              level: float | None, features: Floats | None = None) -> None:
        """
        Start anew.

        :param places: (N,) [m] of the nodes along the rope at rest.
        :param points: (N, 3) [m] at the start.
        :param velocities: (N, 3) [m/s] at the start.
        :param physical: physical values by parameter name, in SI units.
        :param level: height [m] of nodes that touch the table; None: no table.
        :param features: see `Layout`.
        """
        self._points = np.array(points, dtype=float)
        self._velocities = np.array(velocities, dtype=float)
        self._support = np.zeros_like(self._points)
        properties = RodProperties.of(physical)
        self._rod = Rod(np.diff(places), properties, self.time_step, features)
        diameter = 2 * physical['self_collision']
        half = self._rod.rest_lengths / 2
        apart = max(np.pi * physical['self_collision'], float(half.max()))
        middles = places[:-1] * properties.length_scale + half
        kernels.start_distances(self._points, middles, half, apart, diameter, self._pairs, self._distances)
        self._constants = np.array([
            self._rod.drag, self._rod.implicit, self.time_step, GRAVITY,
            NOWHERE if level is None else level, physical['friction'], diameter, apart, -1.0, 0.0])
        self.hold(())

    @property
    def points(self) -> Floats:
        """The nodes' positions now, (N, 3) [m]; a copy."""
        return self._points.copy()

    def hold(self, nodes: tuple[int, ...]) -> None:
        """Let exactly these nodes follow a path from now on."""
        self._held = np.array(nodes, np.int64)
        self._rod.hold(nodes)
        self._inverse_masses = 1 / self._rod.masses
        self._inverse_masses[self._held] = 0.0

    def advance(self, targets: Floats, path: Floats = NO_PATH) -> None:
        """
        Take k steps; targets (k, h, 3) [m] of the held nodes after each.

        :param path: (k, N, 3) to write all nodes to after each step [m]; or empty.
        :raises SimulationError: where the rollout diverges; at that step.
        """
        rod = self._rod
        taken = kernels.advance(
            np.ascontiguousarray(targets), self._held, self._points, self._velocities, self._support,
            rod.rest_lengths, rod.stiffness, rod.masses, self._inverse_masses, rod.bending, rod.natural,
            rod.spans, self._distances, self._pairs, self._contacts, self._bands, self._right, self._wanted,
            self._change, self._constants, path)
        if taken < len(targets):
            raise SimulationError('the rollout diverged: the chain is no longer finite')


class CompiledSimulator:
    """
    Simulates trials on a table or in the air, about thirty times as fast as `bullet.BulletSimulator`.

    :param table: whether there is a table.
    :param table_height: [m].
    :param nodes: of the rope.
    :param time_step: [s].
    :param stable_distance: see `Settling` [m].
    :param stable_time: see `Settling` [s].
    :param settle_limit: see `Settling` [s].
    """

    name = 'compiled'

    def __init__(self, table: bool = True, table_height: float = 0.0, nodes: int = DEFAULT_NODES,
                 time_step: float = DEFAULT_TIME_STEP, stable_distance: float = Settling.distance,
                 stable_time: float = Settling.time, settle_limit: float = Settling.limit) -> None:
        self._table_height = table_height if table else None
        self._nodes = nodes
        self._time_step = time_step
        self._settling = Settling(stable_distance, stable_time, settle_limit)
        self._rope: CompiledRope | None = None
        self._known: dict[int, tuple[Trial, Layout, float | None]] = {}

    def prepare(self) -> None:
        """Do nothing: the kernels were compiled, or taken from the cache, when they were imported."""

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """
        Simulate a trial with physical parameters by name (SI units).

        :raises SimulationError: where the rollout diverges.
        :raises InputError: where the trial grips more points than there are nodes.
        """
        layout, level = self._layout(trial)
        points = layout.points
        if self._table_height is not None:
            if level is None:
                level = self._table_height + physical['self_collision']
            points = rest_on(points, level)
        if self._rope is None:
            self._rope = CompiledRope(self._nodes, self._time_step)
        self._rope.reset(layout.places, points, layout.velocities, physical, level,
                         layout.features)
        return roll_out(trial, layout, self._rope, self._settling)

    def _layout(self, trial: Trial) -> tuple[Layout, float | None]:
        """Return what depends on the trial alone."""
        if id(trial) not in self._known or self._known[id(trial)][0] is not trial:
            level = None if self._table_height is None else resting_level(trial, self._table_height)
            self._known[id(trial)] = trial, Layout.of(trial, self._nodes), level
        return self._known[id(trial)][1:]

    def refined(self) -> CompiledSimulator:
        """Return one with twice the segments and half the time step."""
        finer = copy.copy(self)
        finer._nodes, finer._time_step = 2 * self._nodes - 1, self._time_step / 2
        return finer

    def close(self) -> None:
        """Forget the trials."""
        self._known.clear()
        self._rope = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave the workspace behind: it belongs to this process."""
        return {**self.__dict__, '_rope': None, '_known': {}}
