# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Script: the events of a simulated trial, written before it is simulated.

Hands close, move and open.  Timed goals are compared at their time; for a goal that
is a stable configuration, the simulation continues until the DLO has come to rest.
Time in which the DLO stays at rest is skipped.  Every engine follows the same script
with every parameter set.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
import math
from typing import Iterator, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation import core
from dlo_calibration.simulation.nodes import NodeLayout

MOST_STEPS = 2_000_000  # of one path, which takes 200 MB of memory; 100 minutes at the default time step
MOST_TRACED = 5000  # steps in one event with timed goals, which are all in memory
ROUNDING = 1e-9  # s; instants that differ by less are equal


@dataclass(frozen=True)
class Settling:
    """
    When a DLO counts as stable: no point moves as far as a distance within a time.

    :param distance: this distance [m].
    :param time: this time [s], in which all hands are at rest.
    :param limit: longest time [s] to wait until the DLO is stable.
    """

    distance: float = 0.0005
    time: float = 0.25
    limit: float = 10.0


@dataclass(frozen=True)
class Script:
    """
    The events of a simulated trial.

    :param events: for the core.
    :param positions: number of positions of hands in the events, a measure of their memory.
    """

    events: core.Script
    positions: int

    @classmethod
    def of(cls, trial: Trial, layout: NodeLayout, time_step: float, settling: Settling) -> Script:
        """
        Write the script of a trial.

        :raises SimulationError: if a hand moves for more than `MOST_STEPS`.
        """
        writer = _Writer(trial, layout, time_step, settling)
        writer.write()
        steps = max(5, round(settling.time / time_step))
        return cls(core.Script(writer.events, settling.distance, steps, trial.loads), writer.positions)


@dataclass
class _ClosedHand:
    hand: Hand
    nodes: tuple[int, ...]
    rows: list[int]
    since: int  # number of steps when it closed
    positions: Floats  # (k, 3) [m] of the hand after each later step, until it rests
    rotations: Floats | None  # (k, 9) since it closed, row by row
    turns: Floats  # (k + 1, 9) in each of these steps, and the identity

    def grip(self, steps: int, count: int) -> core.Grip:
        """Return its poses in the `count` steps after `steps` steps of the trial."""
        first = steps - self.since
        return core.Grip(self.rows, _rows(self.positions, first, count),
                         None if self.rotations is None else _rows(self.rotations, first, count),
                         _rows(self.turns, first, count))


class _Writer:
    def __init__(self, trial: Trial, layout: NodeLayout, time_step: float, settling: Settling) -> None:
        self.events: list[core.Event] = []
        self.positions = 0
        self._offsets = 0  # of nodes from the hands that hold them, so far
        self._trial = trial
        self._layout = layout
        self._step = time_step
        self._settling = settling
        self._time = 0.0  # [s] of the trial
        self._steps = 0
        self._last = 0.0  # time [s] of the remembered points
        self._goal = 0  # index of the current goal
        self._timed = [goal.time for goal in trial.goals if not goal.stable]  # [s], increasing
        self._closed: dict[str, _ClosedHand] = {}
        self._waiting = list(trial.hands)

    def write(self) -> None:
        """Write the events up to each goal in turn."""
        seen = 0  # number of goals that have been seen
        for k, goal in enumerate(self._trial.goals):
            self._goal = k
            if goal.stable:
                self._act_until(goal.time)
                self._open(goal)
                self._settle(self._settling.limit)  # takes no time of the trial
                self.events.append(core.Event.see())
            elif k >= seen:
                self._see(goal.time)
                seen = self._trace(k + 1)

    def _goals(self, first: int) -> Iterator[Goal]:
        """Yield the goals from an index on, without a copy: a stream has thousands."""
        for k in range(first, len(self._trial.goals)):
            yield self._trial.goals[k]

    def _hands(self) -> Iterator[Hand]:
        """Yield the hands that are closed."""
        for closed in self._closed.values():
            yield closed.hand

    def _see(self, instant: float) -> None:
        """See the DLO at an instant, between two steps."""
        self._act_until(instant - self._step)
        while self._time < instant - ROUNDING:
            self._last = self._time
            self._close()
            self._advance(1, remembers=True)
            self._open_arrived()
        share = (instant - self._last) / (self._time - self._last) if self._time > self._last else 0.0
        self.events.append(core.Event.see(min(max(share, 0.0), 1.0)))

    def _trace(self, first: int) -> int:
        """
        See the DLO at timed goals, from an index on up to the next event of a hand; return the next index.

        The result is the same as with `_see` for each goal, but in a single event.
        """
        step = self._step
        self._close()
        events = [hand.start for hand in self._waiting] + [
            hand.end for hand in self._hands() if hand.end > self._time + ROUNDING]
        end = min(events, default=math.inf) - 2 * step
        arrived = [hand for hand in self._hands() if hand.end <= self._time + ROUNDING]
        last = first
        for goal in self._goals(first):
            if goal.stable or goal.time > end or goal.time - self._time > MOST_TRACED * step \
                    or arrived and not all(self._trial.holds(hand, goal) for hand in arrived):
                break
            last += 1
        count = math.ceil((self._trial.goals[last - 1].time - ROUNDING - self._time) / step)
        if last == first or count <= 0:
            return first
        times = np.concatenate([[self._last], self._time + step * np.arange(count + 1)])
        self._last = float(times[-2])
        instants = np.array([goal.time for goal in self._trial.goals[first:last]])
        after = np.clip(np.searchsorted(times, instants - ROUNDING), 1, len(times) - 1)
        widths = times[after] - times[after - 1]
        shares = np.clip((instants - times[after - 1]) / np.maximum(widths, ROUNDING), 0.0, 1.0)
        self._advance(count, sights=list(zip((after - 1).tolist(), shares.tolist(), strict=True)))
        return last

    def _act_until(self, until: float) -> None:
        """Let hands act until an instant; skip time in which no hand moves and the DLO rests."""
        while self._time < until - ROUNDING:
            self._close()
            ends = [hand.end for hand in self._hands() if hand.end > self._time + ROUNDING]
            starts = [hand.start for hand in self._waiting if hand.start < until]
            target = min([*ends, *starts, until])
            if ends or not self._nothing_timed_before(target):
                self._advance(max(1, math.ceil((target - self._time) / self._step - 1e-6)))
            else:
                self._settle(min(target - self._time, self._settling.limit))
                self._time = target
            self._open_arrived()

    def _nothing_timed_before(self, instant: float) -> bool:
        """Return whether there is no timed goal until an instant, so that this time may be skipped."""
        return bisect_right(self._timed, self._time) >= bisect_right(self._timed, instant + self._step)

    def _close(self) -> None:
        closing = [hand for hand in self._waiting if hand.start <= self._time + ROUNDING]
        for hand in closing:
            self._waiting.remove(hand)
            nodes = self._layout.nodes(hand)
            count = max(1, math.ceil((hand.end - self._time) / self._step - ROUNDING))
            if count > MOST_STEPS:
                raise SimulationError(f'{self._trial.name}: hand {hand.name!r} moves for {count} time steps, '
                                      f'more than {MOST_STEPS}; divide its path into several actions')
            positions, rotations, turns = _hand_steps(hand, self._time, self._step, count)
            rows = list(range(self._offsets, self._offsets + len(nodes)))
            self._offsets += len(nodes)
            self.events.append(core.Event.close(rows[0], nodes, positions[0]))
            self._closed.pop(hand.name, None)
            self._let_go(nodes)
            self._closed[hand.name] = _ClosedHand(
                hand, nodes, rows, self._steps, positions[1:],
                None if rotations is None else rotations[1:], turns)
        if closing:
            self._hold()

    def _open_arrived(self) -> None:
        """Open the hands that have arrived, unless the next goal shows them closed."""
        for closed in list(self._closed.values()):
            if closed.hand.end <= self._time + ROUNDING:
                end = closed.hand.end
                following = next((goal for goal in self._goals(self._goal) if goal.time > end), None)
                if following is not None and not self._trial.holds(closed.hand, following):
                    self._release(closed)

    def _open(self, goal: Goal) -> None:
        """Open the hands that have arrived and are open in a goal."""
        for closed in list(self._closed.values()):
            if closed.hand.end < goal.time and not self._trial.holds(closed.hand, goal):
                self._release(closed)

    def _let_go(self, nodes: tuple[int, ...]) -> None:
        """Release nodes that another hand grips from the hands that hold them."""
        for name, closed in list(self._closed.items()):
            remaining = [k for k, node in enumerate(closed.nodes) if node not in nodes]
            if not remaining:
                del self._closed[name]
            elif len(remaining) < len(closed.nodes):
                closed.nodes = tuple(closed.nodes[k] for k in remaining)
                closed.rows = [closed.rows[k] for k in remaining]

    def _release(self, closed: _ClosedHand) -> None:
        del self._closed[closed.hand.name]
        self._hold()

    def _hold(self) -> None:
        self.events.append(core.Event.hold(
            [node for closed in self._closed.values() for node in closed.nodes]))

    def _settle(self, limit: float) -> None:
        """Let the DLO come to rest while no hand moves, for at most a limit [s]."""
        time, count = self._time, round(limit / self._step)
        if count:
            self._advance(count, settles=True)
            self._time = time

    def _advance(self, count: int, settles: bool = False, remembers: bool = False,
                 sights: Sequence[tuple[int, float]] = ()) -> None:
        """Take steps."""
        hands = self._closed.values()
        moving = max((len(closed.turns) - (self._steps - closed.since) for closed in hands), default=1)
        moving = min(max(moving, 1), count)
        grips = [closed.grip(self._steps, moving) for closed in hands]
        self.events.append(core.Event.advance(grips, count, settles, remembers, sights))
        self._time += count * self._step
        self._steps += count
        self.positions += moving * len(hands)


def _rows(array: Floats, first: int, count: int) -> Floats:
    """Return `count` rows of an array from `first` on; beyond its end, repeat the last one."""
    rows = array[first:first + count]
    rest = count - len(rows)
    return np.concatenate([rows, np.repeat(array[-1:], rest, axis=0)]) if rest else rows


def _hand_steps(hand: Hand, start: float, step: float, count: int) -> tuple[Floats, Floats | None, Floats]:
    """
    Return positions and rotations of a hand.

    :param start: time [s] in the trial.
    :param step: [s].
    :returns: (count + 1, 3) [m] positions after 0 to `count` steps; (count + 1, 9) rotations since the first
        position, row by row, or None if it does not turn; (count + 1, 9) rotations in each step, and the
        identity.
    """
    positions, turns = hand.poses(start + step * np.arange(count + 1))
    each = np.concatenate([turns[1:] @ turns[:-1].transpose(0, 2, 1), np.eye(3)[None]]).reshape(-1, 9)
    turned = frozen_array(turns @ turns[0].T)
    return frozen_array(positions), (
        None if np.all(turned == np.eye(3)) else turned.reshape(-1, 9)), frozen_array(each)
