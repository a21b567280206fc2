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
    A hand closes: its nodes keep their offsets from it from now on.

    :param rows: of the table of these offsets, one for each node.
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
class Grip:
    """
    Nodes that a hand holds while steps are taken; after the last of the k rows, it stays.

    :param rows: (n,) of the table of offsets, one for each node.
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

    :param grips: what each closed hand does meanwhile.
    :param count: number of steps; with `settles`, the most.
    :param settles: they end as soon as the DLO is stable; if it is, and nothing has happened since, none is
        taken.
    :param remembers: the points before are kept, see `See`.
    """

    grips: tuple[Grip, ...]
    count: int
    settles: bool = False
    remembers: bool = False

    def targets(self, offsets: Floats) -> Floats:
        """
        Return the positions of the held nodes after each step, (k, h, 3) [m].

        :param offsets: (p, 3) [m] of nodes from the hands that hold them, when these closed.
        """
        if not self.grips:
            return self._positions
        targets = self._positions + offsets[self._rows]
        start = 0
        for grip in self.grips:
            end = start + len(grip.rows)
            if grip.rotations is not None:
                targets[:, start:end] = grip.positions[:, None, :] + np.einsum(
                    'kij,nj->kni', grip.rotations, offsets[grip.rows])
            start = end
        return targets

    @cached_property
    def _rows(self) -> NDArray[np.int64]:
        return np.concatenate([np.zeros(0, np.int64), *(grip.rows for grip in self.grips)])

    @cached_property
    def _positions(self) -> Floats:
        """The (k, h, 3) [m] positions of the hands that hold the nodes; of at least one step."""
        rows = max((len(grip.positions) for grip in self.grips), default=1)
        return np.concatenate([np.zeros((rows, 0, 3)), *(
            np.repeat(grip.positions[:, None], len(grip.rows), axis=1) for grip in self.grips)], axis=1)

    @cached_property
    def turns(self) -> Floats:
        """The (k, h, 9) rotation matrices of the hands that hold the nodes in each step."""
        return np.concatenate([np.zeros((len(self._positions), 0, 9)), *(
            np.repeat(grip.turns[:, None], len(grip.rows), axis=1) for grip in self.grips)], axis=1)


@dataclass(frozen=True)
class See:
    """
    The DLO is seen at the next goal.

    :param share: it is seen so far (0 to 1) on the way from the points that were remembered to those now;
        None: now, and the goal is a stable configuration.
    """

    share: float | None


@dataclass(frozen=True)
class Trace:
    """
    Steps are taken, and the DLO is seen at the next goals, all of which have a time.

    The positions in question are the remembered ones, those before the steps, and those after each step.
    Those before the last step are remembered.

    :param steps: that are taken.
    :param after: (g,) index of the positions after each goal, at least 1.
    :param shares: (g,) the DLO is seen so far (0 to 1) on the way to them from those before.
    """

    steps: Advance
    after: NDArray[np.int64]
    shares: Floats


Event = Close | Hold | Advance | See | Trace


@dataclass(frozen=True)
class Script:
    """
    What happens in a simulated trial.

    :param events: in order.
    :param offsets: number of rows of the table of offsets of nodes from hands.
    :param positions: how many positions of hands the events contain; its memory grows with them.
    :param observe: see `NodeLayout`.
    :param settling: when the DLO is stable.
    :param time_step: [s].
    """

    events: tuple[Event, ...]
    offsets: int
    positions: int
    observe: Floats
    settling: Settling
    time_step: float
