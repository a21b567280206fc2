# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The core's Python interface.  Wrong shapes, indices and numbers that are not finite raise ValueError."""

from typing import Any, Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: kinds of processors whose code this processor can execute, the fastest first; all give the same bits
TARGETS: tuple[str, ...]

#: See `roll_out`.
Outcome = tuple[NDArray[np.float64], tuple[bool, ...], int, NDArray[np.float64] | None, NDArray[np.float64]]

class Start:
    """
    Where a DLO of N nodes is at the start of a trial.

    :param places: (N,) [m] arc lengths of the nodes at rest, increasing.
    :param points: (N, 3) [m].
    :param velocities: (N, 3) [m/s].
    :param features: (N,) number of markers at each node; None: there are none.
    :param directions: (N - 1, 3) unit vectors across segments in clamps, nan elsewhere; None: unknown.
    """

    def __init__(self, places: ArrayLike, points: ArrayLike, velocities: ArrayLike,
                 features: ArrayLike | None = None, directions: ArrayLike | None = None) -> None: ...

class Grip:
    """
    The poses of a hand while steps are taken; after the last of the k poses, it stays.

    :param rows: of the table of offsets, one per node that it holds.
    :param positions: (k, 3) [m] of the hand after each step.
    :param rotations: (k, 9) of the hand since it closed, matrices row by row; None: it does not turn.
    :param turns: (k, 9) rotations in each step.
    """

    def __init__(self, rows: Sequence[int], positions: ArrayLike, rotations: ArrayLike | None,
                 turns: ArrayLike) -> None: ...

class Event:
    """Something that happens in a trial."""

    @staticmethod
    def close(row: int, nodes: Sequence[int], position: ArrayLike) -> Event:
        """
        Close a hand at a position (3,) [m].

        From now on, its nodes keep their offsets from it, which are rows of a table, from `row` on.  The
        table has no gaps.
        """

    @staticmethod
    def hold(nodes: Sequence[int]) -> Event:
        """Hold exactly these nodes from now on."""

    @staticmethod
    def advance(grips: Sequence[Grip], count: int, settles: bool = False, remembers: bool = False,
                sights: Sequence[tuple[int, float]] = ()) -> Event:
        """
        Take steps.

        :param grips: the poses of each closed hand, in the order of the held nodes.
        :param count: number of steps; with `settles`, the limit.
        :param settles: the steps end as soon as the DLO is stable; no step is taken if it already is, and no
            event has come since.
        :param remembers: the points before the first step are remembered for `see`.
        :param sights: (steps, share) for each goal in this time: the DLO is seen at the share (0 to 1) of the
            way from the points before the last of these steps to those after it.  With 0 steps, the way
            begins at the remembered points.  The points before the last step are remembered.
        """

    @staticmethod
    def see(share: float | None = None) -> Event:
        """
        See the DLO at the next goal.

        :param share: (0 to 1) of the way from the remembered points to the current ones; None: the current
            points, and the goal is a stable configuration.
        """

class Script:
    """
    The events of a trial; they do not depend on the parameters.

    :param stable_distance: the DLO is stable when no node moves as far as this [m] within `stable_steps`.
    :param stable_steps: at least 5.
    :param loads: whether the loads of the DLO are measured after each step.
    """

    def __init__(self, events: Sequence[Event], stable_distance: float, stable_steps: int,
                 loads: bool = False) -> None: ...

class Grid:
    """
    Signed distances from a surface at the points of a grid, which several bodies may share.

    :param distances: (x, y, z) [m], single precision.
    :param corner: (3,) [m] of the first point, in the frame of a body.
    :param cell: [m] from a point to the next.
    """

    def __init__(self, distances: ArrayLike, corner: ArrayLike, cell: float) -> None: ...

class Body:
    """
    A body that does not move.

    :param shape: sphere, box, cylinder or capsule.
    :param sizes: [m] radius of a sphere; (3,) half edges of a box; half length and radius of a cylinder or
        capsule along z.
    :param position: (3,) [m] of its centre.
    :param turn: (9,) rotation from its frame to that of the world, row by row.
    :param friction: coefficient that multiplies that of the DLO.
    """

    def __init__(self, shape: str, sizes: ArrayLike, position: ArrayLike, turn: ArrayLike, friction: float
                 ) -> None: ...

    @staticmethod
    def of_grid(grid: Grid, position: ArrayLike, turn: ArrayLike, friction: float) -> Body:
        """Return a body of any shape, by the distances from its surface."""

    def distance(self, at: ArrayLike) -> float:
        """Return the signed distance [m] of a point (3,) [m] from the surface; negative inside."""

class Scene:
    """Bodies that a DLO touches; it is its friction times theirs that rubs."""

    def __init__(self, bodies: Sequence[Body]) -> None: ...

class Stop:
    """A flag that one thread sets to end `roll_out` in others within some milliseconds."""

    def set(self) -> None: ...
    def is_set(self) -> bool: ...

def roll_out(jobs: Sequence[tuple[Script, Start, Mapping[str, float], float]], time_step: float,
             stop: Stop | None = None, target: str = '', scene: Scene | None = None
             ) -> list[Outcome | None]:
    """
    Simulate jobs.  Any number of threads may call this; an outcome does not depend on the other jobs.

    :param jobs: script, start, physical parameters by name (SI units), and the height [m] of nodes that touch
        the table.
    :param time_step: [s].
    :param target: one of `TARGETS`; empty: the fastest.
    :param scene: around the DLO of each job; None: nothing.
    :returns: for each job the nodes at the goals (g, N, 3) [m], whether the DLO was stable at each goal that
        is a stable configuration (else True), the number of steps, the loads, and the forces (g, N, 3) [N]
        with which hands hold nodes, 0 at others; None if the rollout diverged.  The loads (g, 3, 2) are the
        sharpest curvature [1/m], the largest tension [N] and the largest strain since the goal before, each
        with its place: the index of a node, or the middle between two; None if the script does not ask for
        them.  After a stop, outcomes are meaningless.
    """

class Rope:
    """
    A DLO that is stepped from Python.

    :param physical: parameters by name (SI units).
    :param time_step: [s].
    :param level: height [m] of nodes that touch the table.
    :param gravity: (3,) [m/s^2].
    :param scene: that `step` keeps it out of; None: nothing.
    """

    #: (N, 3) [m], [m/s]: state; `predicted`: velocities without contact with other bodies; `support`: change
    #: of the velocities by that contact in the last step.  These arrays share their memory with the rope.
    points: NDArray[np.float64]
    velocities: NDArray[np.float64]
    predicted: NDArray[np.float64]
    support: NDArray[np.float64]
    #: (N,) [kg]
    masses: NDArray[np.float64]
    #: held nodes
    held: list[int]
    #: (h, 3) [m] positions of the held nodes after the coming step; a copy
    targets: NDArray[np.float64]
    #: for tests: copies of what else determines a step, by the names in the headers; `clamps` are pairs of a
    #: segment and a unit vector (3,) of the material frame there
    state: dict[str, Any]

    def __init__(self, start: Start, physical: Mapping[str, float], time_step: float, level: float,
                 gravity: ArrayLike, scene: Scene | None = None) -> None: ...
    def hold(self, nodes: Sequence[int]) -> None:
        """Hold exactly these nodes from now on; a segment between two of them is rigid."""

    def aim(self, targets: ArrayLike, turns: ArrayLike | None = None) -> None:
        """
        Set the positions of held nodes after the coming step.

        :param targets: (h, 3) [m].
        :param turns: (h, 9) rotations of their hands in that step, row by row; None: a clamp turns with its
            segment, and not about it.
        """

    def predict(self) -> bool:
        """Compute `predicted`; return whether it is finite."""

    def step(self) -> bool:
        """Take a step on the table and in the scene; return whether the rope is still finite."""

    def follow(self, script: Script, step: Callable[[], Any]) -> Outcome | None:
        """
        Follow a script; return the outcome as `roll_out` does.

        :param step: takes a step to the targets that the script has set; it may not hold or aim.
        """
