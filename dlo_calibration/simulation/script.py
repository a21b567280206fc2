# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Script: what happens in a simulated trial, event by event.

It is the same for every engine and parameter set: `script_writer` writes it once, `rollout` follows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats


@dataclass(frozen=True)
class Settling:
    """
    When a DLO counts as stable: no point moves further than a distance within a time.

    :param distance: this distance [m].
    :param time: this time [s], while all hands are at rest.
    :param limit: longest time [s] to wait for it.
    """

    distance: float = 0.0005
    time: float = 0.25
    limit: float = 10.0


@dataclass(frozen=True)
class Close:
    """
    A hand closes: its nodes keep their places relative to it from now on.

    :param rows: their rows of the table of these places.
    :param nodes: that it grips.
    :param position: (3,) [m] of the hand.
    """

    rows: slice
    nodes: list[int]
    position: Floats


@dataclass(frozen=True)
class Hold:
    """From now on, exactly these nodes are held."""

    nodes: tuple[int, ...]


@dataclass(frozen=True)
class Held:
    """
    Nodes that a hand holds while steps are taken; after the last of the k rows, it stays.

    :param rows: (n,) rows of the table of places relative to hands, one for each node.
    :param positions: (k, 3) [m] of the hand after each step.
    :param rotations: (k, 3, 3) of the hand after each step since it closed; None: it does not turn.
    :param turns: (k, 9) rotation matrices of the hand in each step, row by row.
    """

    rows: NDArray[np.int64]
    positions: Floats
    rotations: Floats | None
    turns: Floats


@dataclass(frozen=True)
class Advance:
    """
    Steps are taken.

    :param held: what each closed hand does meanwhile.
    :param count: number of steps; with `settles`, the most.
    :param settles: they end as soon as the DLO is stable; if it is, and nothing has happened since, none is
        taken.
    :param remembers: the points before are kept, see `See`.
    """

    held: tuple[Held, ...]
    count: int
    settles: bool = False
    remembers: bool = False

    def targets(self, places: Floats) -> Floats:
        """
        Return the positions of the held nodes after each step, (k, h, 3) [m].

        :param places: (p, 3) [m] the table of places of nodes relative to the hands that closed.
        """
        targets = self._positions + places[self._rows]
        start = 0
        for one in self.held:
            end = start + len(one.rows)
            if one.rotations is not None:
                targets[:, start:end] = one.positions[:, None, :] + np.einsum(
                    'kij,nj->kni', one.rotations, places[one.rows])
            start = end
        return targets

    @cached_property
    def _rows(self) -> NDArray[np.int64]:
        return np.concatenate([np.zeros(0, np.int64), *(one.rows for one in self.held)])

    @cached_property
    def _positions(self) -> Floats:
        """The (k, h, 3) [m] positions of the hands that hold the nodes; of at least one step."""
        rows = max((len(one.positions) for one in self.held), default=1)
        return np.concatenate([np.zeros((rows, 0, 3)), *(
            np.repeat(one.positions[:, None], len(one.rows), axis=1) for one in self.held)], axis=1)

    @cached_property
    def turns(self) -> Floats:
        """The (k, h, 9) rotation matrices of the hands that hold the nodes in each step."""
        return np.concatenate([np.zeros((len(self._positions), 0, 9)), *(
            np.repeat(one.turns[:, None], len(one.rows), axis=1) for one in self.held)], axis=1)


@dataclass(frozen=True)
class See:
    """
    The DLO is seen at a goal.

    :param goal: index of the goal.
    :param share: it is seen so far (0 to 1) on the way from the points that were remembered to those now;
        None: now, and the goal is a stable configuration.
    """

    goal: int
    share: float | None


@dataclass(frozen=True)
class Trace:
    """
    Steps are taken, and the DLO is seen at several timed goals.

    The positions in question are the remembered ones, those before the steps, and those after each step.
    Those before the last step are remembered.

    :param steps: that are taken.
    :param first: index of the first goal.
    :param after: (g,) index of the positions after each goal, at least 1.
    :param shares: (g,) the DLO is seen so far (0 to 1) on the way to them from those before.
    """

    steps: Advance
    first: int
    after: NDArray[np.int64]
    shares: Floats


Event = Close | Hold | Advance | See | Trace


@dataclass(frozen=True)
class Script:
    """
    What happens in a simulated trial.

    :param events: in order.
    :param places: number of rows of the table of places of nodes relative to hands.
    :param rows: of the positions of hands that it contains.
    :param observe: see `NodeLayout`.
    :param settling: when the DLO is stable.
    :param time_step: [s].
    """

    events: tuple[Event, ...]
    places: int
    rows: int
    observe: Floats
    settling: Settling
    time_step: float
