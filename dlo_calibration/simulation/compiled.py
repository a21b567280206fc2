# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The compiled engine: the same rope as in `bullet`, with its own contact with a table.

Kernels, table, grips, the test of stability and the time step are those of the PyBullet engine.
It is faster because no call into another library is needed for each node and step.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Callable, Hashable, Mapping, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation import entries
from dlo_calibration.simulation.engine import Engine
from dlo_calibration.simulation.machine_code import Packed
from dlo_calibration.simulation.nodes import NodeLayout
from dlo_calibration.simulation.protocol import Job, Rollout
from dlo_calibration.simulation.rollout import CHECKS, roll_out, Steps
from dlo_calibration.simulation.rope import diverged, Rope
from dlo_calibration.simulation.states import Move

_NOTHING = np.empty((0, 0, 0))


class CompiledRope(Rope):
    """
    A rope on a table or in the air, stepped by `kernels`.

    :param level: height [m] of nodes that touch the table; None: no table.
    """

    def __init__(self, places: Floats, points: Floats, velocities: Floats, physical: Mapping[str, float],
                 time_step: float, level: float | None = None, features: Floats | None = None,
                 directions: Floats | None = None) -> None:
        super().__init__(places, points, velocities, physical, time_step, np.array([0.0, 0.0, -GRAVITY]),
                         features, directions)
        self.time_step = time_step
        self._move: Packed | None = None
        self.put_on(level)

    def put_on(self, level: float | None) -> None:
        """Set the height [m] of nodes that touch the table; None: no table."""
        self.level = -1e6 if level is None else level  # so low that nothing touches it

    def packed_move(self, steps: Steps) -> Packed:
        """Return a `Move` that takes steps of this rope, as kernels take it; it replaces the one before."""
        rod = self.state.rod
        fields: dict[str, Any] = {
            'targets': np.ascontiguousarray(steps.targets), 'most': steps.number,
            'turns': _NOTHING if steps.turns is None else np.ascontiguousarray(steps.turns),
            'path': _NOTHING if steps.path is None else steps.path, 'periods': steps.periods(self.time_step),
            'distance': 0.0 if steps.settling is None else steps.settling.distance, 'held': rod.held,
            'follow': rod.follow}
        if self._move is None:
            self._move = Packed(Move(
                **fields, inverse_masses=rod.inverse_masses, contact=self.contact,
                progress=np.zeros(4, np.int64), seen=np.empty((CHECKS + 1, *self.state.points.shape))))
        else:
            self._move.set(**fields)
        return self._move

    def become(self, places: Floats, points: Floats, velocities: Floats, physical: Mapping[str, float],
              features: Floats | None = None, directions: Floats | None = None) -> None:
        """Become another DLO of as many nodes at the start of a trial; see the constructor."""
        super().become(places, points, velocities, physical, features, directions)
        if self._move is not None:
            self._move.set(contact=self.contact)

    @property
    def kind(self) -> Hashable:
        """What ropes have in common that can be stepped together."""
        rod = self.state.rod
        frame, rows = rod.frame, rod.friction.rows
        return (len(self.state.points), rod.step, len(frame.angles), len(frame.twisting), len(rows),
                frame.clamped.tobytes(), self.state.gravity.tobytes())

    @property
    def has_begun(self) -> bool:
        """Whether its first step, which sets up the state of frame and friction, has been taken."""
        frame, friction = self.state.rod.frame, self.state.rod.friction
        return bool((frame.begun[0] or not len(frame.angles)) and (
            friction.begun[0] or not len(friction.rows)))

    def advance(self, targets: Floats, path: Floats | None = None, turns: Floats | None = None) -> None:
        """
        Take k steps; see `rollout.Stepper.advance`.

        :raises SimulationError: if the rollout diverges.
        """
        path = _NOTHING if path is None else path
        turns = _NOTHING if turns is None else np.ascontiguousarray(turns)
        targets = np.ascontiguousarray(targets)
        if entries.advance(self.packed, targets, turns, self.level, path) < len(targets):
            raise diverged()


class CompiledSimulator(Engine[CompiledRope]):
    """Simulates trials on a table or in the air, about 50 times as fast as `bullet.BulletSimulator`."""

    name = 'compiled'

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self._free: list[CompiledRope] = []  # ropes that no rollout needs any more

    def simulate(self, trial: Trial, physical: Mapping[str, float]) -> Rollout:
        """Simulate a trial; see `Engine.simulate`."""
        script, rope = self._start(trial, physical)
        rollout = roll_out(script, rope)
        self._free.append(rope)
        return rollout

    def simulate_together(self, jobs: Sequence[Job],
                          between: Callable[[], None] = lambda: None) -> list[Rollout | SimulationError]:
        """
        Simulate each job; see `TogetherSimulator`.

        :raises InputError: if a trial grips more points than there are nodes.
        """
        if not entries.advance_together.ready:  # its compilation may be under way
            found = []
            for job in jobs:
                between()
                found.append(self._outcome(*job))
            return found
        from dlo_calibration.simulation.together import roll_out_together

        return roll_out_together([partial(self._start, *job) for job in jobs], self._free, between)

    def _outcome(self, trial: Trial, physical: Mapping[str, float]) -> Rollout | SimulationError:
        try:
            return self.simulate(trial, physical)
        except SimulationError as error:
            return error

    def _rope(self, layout: NodeLayout, points: Floats, physical: Mapping[str, float],
              level: float | None) -> CompiledRope:
        if not self._free:
            return CompiledRope(layout.places, points, layout.velocities, physical, self._time_step, level,
                                layout.features, layout.directions)
        rope = self._free.pop()
        rope.become(layout.places, points, layout.velocities, physical, layout.features, layout.directions)
        rope.put_on(level)
        return rope

    def close(self) -> None:
        """Drop what is known of the trials, and all ropes."""
        super().close()
        self._free.clear()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the ropes, too: they belong to this process."""
        return {**super().__getstate__(), '_free': []}
