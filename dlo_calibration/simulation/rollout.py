# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
roll_out(): the course of a simulated trial, the same for every engine.

Hands close, move and open.  Timed goals are compared at their time; for a goal that
is a stable configuration, the simulation continues until the DLO has come to rest.
Time in which the DLO stays at rest is skipped.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from dataclasses import dataclass
from functools import lru_cache
from itertools import cycle
import math
from typing import Generator, Iterator, Protocol, Sequence, TypeVar

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import SimulationError
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.simulation.hand_steps import hand_steps
from dlo_calibration.simulation.nodes import NodeLayout
from dlo_calibration.simulation.protocol import advanced, Rollout

CHECKS = 5  # of the displacement within one `Settling.time`
PIECE = 1000  # steps in one call of a stepper: at most some seconds, even with 1000 nodes
MOST_STEPS = 2_000_000  # of one path, which is in memory: 200 MB; 100 minutes at the usual time step
ROUNDING = 1e-9  # s; instants that differ by less are the same


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
class Steps:
    """
    What a trial asks of a stepper next.

    :param targets: (k, h, 3) [m] positions of the held nodes after each step; after k steps, they stay.
    :param turns: (k, h, 9) rotation matrices of their hands in each step, row by row; None: it makes no
        difference how they turn.
    :param count: number of steps; with `settling`, the most.
    :param path: (count, N, 3) [m] where the nodes' positions after each step are written; None: nowhere.
    :param settling: the steps end as soon as the DLO is stable; None: they do not.
    """

    targets: Floats
    turns: Floats | None
    count: int
    path: Floats | None = None
    settling: Settling | None = None

    def periods(self, time_step: float) -> NDArray[np.int64]:
        """Return the steps between checks whether the DLO is stable, (CHECKS,), again and again; or (0,)."""
        if self.settling is None:
            return np.zeros(0, np.int64)
        return _periods(max(CHECKS, round(self.settling.time / time_step)))


@lru_cache(maxsize=16)
def _periods(window: int) -> NDArray[np.int64]:
    bounds = np.linspace(0, window, CHECKS + 1).astype(np.int64)
    return bounds[1:] - bounds[:-1]


#: the course of a trial: yields steps, is sent how many were taken and whether the DLO is stable, and returns
Course = Generator[Steps, tuple[int, bool] | None, Rollout]


class Stepper(Protocol):
    """A simulated DLO of an engine, at the start of a trial."""

    time_step: float

    @property
    def points(self) -> Floats:
        """The current (N, 3) [m] positions of the nodes."""

    def hold(self, nodes: tuple[int, ...]) -> None:
        """Let exactly these nodes follow given positions from now on."""

    @property
    def twists(self) -> bool:
        """Whether it makes a difference how clamps turn about the axis of the DLO."""

    def advance(self, targets: Floats, path: Floats | None = None, turns: Floats | None = None) -> None:
        """
        Take k steps.

        :param targets: (k, h, 3) [m] positions of the held nodes after each step.
        :param path: (k, N, 3) [m] where the positions of all nodes after each step are written.
        :param turns: (k, h, 9) rotation matrices of their hands in each step, row by row; None: a clamp
            turns with its segment, and not about it.
        """


def roll_out(trial: Trial, layout: NodeLayout, stepper: Stepper, settling: Settling) -> Rollout:
    """
    Simulate a trial with a stepper that is at the start of it.

    :raises SimulationError: if the rollout diverges.
    """
    steps_of, taken = course(trial, layout, stepper, settling), None
    try:
        while True:
            taken = take(stepper, steps_of.send(taken))
    except StopIteration as end:
        rollout: Rollout = end.value
        return rollout


def course(trial: Trial, layout: NodeLayout, stepper: Stepper, settling: Settling) -> Course:
    """Return the course of a trial for a stepper that is at the start of it; others take its steps."""
    return _Course(trial, layout, stepper, settling).rollout()


def take(stepper: Stepper, steps: Steps) -> tuple[int, bool]:
    """
    Let a stepper take steps.

    :returns: how many it took, and whether the DLO is stable.
    :raises SimulationError: if the rollout diverges.
    """
    taken = 0

    def advance(count: int) -> None:
        nonlocal taken
        now = np.arange(taken, taken + count)
        stepper.advance(
            steps.targets[np.minimum(now, len(steps.targets) - 1)],
            None if steps.path is None else steps.path[taken:taken + count],
            None if steps.turns is None else steps.turns[np.minimum(now, len(steps.turns) - 1)])
        advanced()
        taken += count

    if steps.settling is None:
        while taken < steps.count:
            advance(min(PIECE, steps.count - taken))
        return taken, False
    seen: deque[Floats] = deque([stepper.points], maxlen=CHECKS + 1)  # over one window
    for count in cycle(steps.periods(stepper.time_step).tolist()):
        advance(min(count, steps.count - taken))
        seen.append(stepper.points)
        if len(seen) > CHECKS and _largest_move(seen) < steps.settling.distance:
            return taken, True
        if taken == steps.count:
            break
    return taken, False


Answer = TypeVar('Answer')
Asking = Generator[Steps, tuple[int, bool] | None, Answer]


@dataclass
class _Grip:
    hand: Hand
    nodes: tuple[int, ...]
    closed: int  # number of steps when it closed
    path: Floats  # (k, n, 3) [m] positions of the nodes after each later step, until the hand rests
    turns: Floats  # (k + 1, 9) rotations of the hand in each of these steps, and none


class _Course:
    def __init__(self, trial: Trial, layout: NodeLayout, stepper: Stepper, settling: Settling) -> None:
        self._trial = trial
        self._layout = layout
        self._stepper = stepper
        self._settling = settling
        self._time = 0.0  # [s] of the trial
        self._steps = 0
        self._rests = False  # the DLO came to rest and no hand has acted since
        self._last = stepper.points, 0.0  # points [m] and time [s] of the step before
        self._goal = 0  # index of the current goal
        self._timed = [goal.time for goal in trial.goals if not goal.stable]  # [s], increasing
        self._grips: dict[str, _Grip] = {}
        self._waiting = sorted(trial.hands, key=lambda hand: hand.start)
        self._hold()

    def rollout(self) -> Course:
        """Go up to each goal in turn."""
        chains, settled = [], []
        traced: dict[int, Floats] = {}
        for k, goal in enumerate(self._trial.goals):
            self._goal = k
            if goal.stable:
                yield from self._act_until(goal.time)
                self._open(goal)
                now = self._time
                settled.append((yield from self._settle(self._settling.limit)))
                self._time = now  # settling takes no time of the trial
                chains.append(self._observed(self._stepper.points))
            else:
                if k not in traced:
                    points = yield from self._points_at(goal.time)
                    traced = {k: self._observed(points), **(yield from self._trace(k + 1))}
                chains.append(traced[k])
                settled.append(True)
        return Rollout(np.array(chains), tuple(settled), self._steps * self._stepper.time_step, self._steps)

    def _goals(self, first: int) -> Iterator[Goal]:
        """Yield the goals from an index on, without a copy: a stream has thousands."""
        for k in range(first, len(self._trial.goals)):
            yield self._trial.goals[k]

    def _observed(self, points: Floats) -> Floats:
        observed: Floats = self._layout.observe @ points
        return observed

    def _points_at(self, instant: float) -> Asking[Floats]:
        """Return the points at an instant, interpolated between two steps."""
        step = self._stepper.time_step
        yield from self._act_until(instant - step)
        before, start = self._last
        while self._time < instant - ROUNDING:
            before, start = self._last = self._stepper.points, self._time
            self._close()
            yield from self._advance(1)
            self._open_arrived()
        share = (instant - start) / (self._time - start) if self._time > start else 0.0
        points: Floats = before + min(max(share, 0.0), 1.0) * (self._stepper.points - before)
        return points

    def _trace(self, first: int) -> Asking[dict[int, Floats]]:
        """
        Return the observed points at the timed goals from the index `first` to the next event of a hand.

        The result is the same as for each goal by itself, but one call to the stepper does.
        """
        step = self._stepper.time_step
        self._close()
        events = [hand.start for hand in self._waiting] + [
            grip.hand.end for grip in self._grips.values() if grip.hand.end > self._time + ROUNDING]
        end = min(events, default=math.inf) - 2 * step
        arrived = [grip.hand for grip in self._grips.values() if grip.hand.end <= self._time + ROUNDING]
        longest = 5000 * step  # a longer path would take much memory
        last = first
        for goal in self._goals(first):
            if goal.stable or goal.time > end or goal.time - self._time > longest or arrived and not all(
                    self._trial.holds(hand, goal) for hand in arrived):
                break
            last += 1
        count = math.ceil((self._trial.goals[last - 1].time - ROUNDING - self._time) / step)
        if last == first or count <= 0:
            return {}
        path = np.empty((count + 2, *self._last[0].shape))
        path[:2] = self._last[0], self._stepper.points
        times = np.concatenate([[self._last[1]], self._time + step * np.arange(count + 1)])
        yield from self._advance(count, path[2:])
        self._last = path[-2], float(times[-2])
        instants = np.array([goal.time for goal in self._trial.goals[first:last]])
        after = np.clip(np.searchsorted(times, instants - ROUNDING), 1, len(times) - 1)
        widths = times[after] - times[after - 1]
        shares = np.clip((instants - times[after - 1]) / np.maximum(widths, ROUNDING), 0.0, 1.0)
        points = path[after - 1] + shares[:, None, None] * (path[after] - path[after - 1])
        return dict(zip(range(first, last), self._layout.observe @ points, strict=True))

    def _act_until(self, until: float) -> Asking[None]:
        """Let hands act until an instant; skip time in which no hand moves and the DLO is at rest."""
        while self._time < until - ROUNDING:
            self._close()
            ends = [grip.hand.end for grip in self._grips.values() if grip.hand.end > self._time + ROUNDING]
            starts = [hand.start for hand in self._waiting if hand.start < until]
            target = min([*ends, *starts, until])
            if ends or not self._nothing_timed_before(target):
                yield from self._advance(
                    max(1, math.ceil((target - self._time) / self._stepper.time_step - 1e-6)))
            else:
                yield from self._settle(min(target - self._time, self._settling.limit))
                self._time = max(self._time, target)
            self._open_arrived()

    def _nothing_timed_before(self, instant: float) -> bool:
        """Tell whether time until an instant may be skipped: no timed goal lies in it."""
        return bisect_right(self._timed, self._time) >= bisect_right(
            self._timed, instant + self._stepper.time_step)

    def _close(self) -> None:
        closing = [hand for hand in self._waiting if hand.start <= self._time + ROUNDING]
        for hand in closing:
            self._waiting.remove(hand)
            nodes = self._layout.nodes(hand)
            step = self._stepper.time_step
            count = max(1, math.ceil((hand.end - self._time) / step - ROUNDING))
            if count > MOST_STEPS:
                raise SimulationError(f'{self._trial.name}: hand {hand.name!r} moves for {count} time steps, '
                                      f'more than {MOST_STEPS}; divide its path into several actions')
            positions, turns, each = hand_steps(hand, self._time, step, count)
            offsets = self._stepper.points[list(nodes)] - positions[0]
            if turns is not None:
                offsets = np.einsum('kij,nj->kni', turns[1:], offsets)
            path = positions[1:, None, :] + offsets
            self._grips.pop(hand.name, None)
            self._let_go(nodes)
            self._grips[hand.name] = _Grip(hand, nodes, self._steps, path, each)
        if closing:
            self._hold()

    def _open_arrived(self) -> None:
        """Open the hands that have arrived, unless the next goal shows them closed."""
        for grip in list(self._grips.values()):
            if grip.hand.end <= self._time + ROUNDING:
                end = grip.hand.end
                following = next((goal for goal in self._goals(self._goal) if goal.time > end), None)
                if following is not None and not self._trial.holds(grip.hand, following):
                    self._release(grip)

    def _open(self, goal: Goal) -> None:
        """Open the hands that have arrived and that a goal shows open."""
        for grip in list(self._grips.values()):
            if grip.hand.end < goal.time and not self._trial.holds(grip.hand, goal):
                self._release(grip)

    def _let_go(self, nodes: tuple[int, ...]) -> None:
        """Take nodes from the hands that hold them, because another hand grips them."""
        for name, grip in list(self._grips.items()):
            kept = [k for k, node in enumerate(grip.nodes) if node not in nodes]
            if not kept:
                del self._grips[name]
            elif len(kept) < len(grip.nodes):
                grip.nodes, grip.path = tuple(grip.nodes[k] for k in kept), grip.path[:, kept]

    def _release(self, grip: _Grip) -> None:
        del self._grips[grip.hand.name]
        self._hold()

    def _hold(self) -> None:
        self._rests = False
        self._stepper.hold(tuple(node for grip in self._grips.values() for node in grip.nodes))

    def _advance(self, count: int, path: Floats | None = None) -> Asking[None]:
        yield from self._ask(count, path, None)

    def _settle(self, limit: float) -> Asking[bool]:
        """Simulate until the DLO is stable, at most for a limit [s]; tell whether it is stable then."""
        if not self._rests:
            self._rests = yield from self._ask(round(limit / self._stepper.time_step), None, self._settling)
        return self._rests

    def _ask(self, count: int, path: Floats | None, settling: Settling | None) -> Asking[bool]:
        """Ask for steps; tell whether the DLO is stable after them."""
        grips = self._grips.values()
        after = [self._steps - grip.closed for grip in grips]
        moving = max((len(grip.turns) - k for k, grip in zip(after, grips, strict=True)), default=1)
        moving = min(max(moving, 1), count)
        targets = [_rows(grip.path, k, moving) for k, grip in zip(after, grips, strict=True)]
        turns = None if not self._stepper.twists else np.concatenate(
            [np.repeat(_rows(grip.turns, k, moving)[:, None], len(grip.nodes), axis=1)
             for k, grip in zip(after, grips, strict=True)], axis=1)
        answer = yield Steps(
            np.concatenate(targets, axis=1) if targets else np.zeros((1, 0, 3)), turns, count, path, settling)
        assert answer is not None
        taken, stable = answer
        self._time += taken * self._stepper.time_step
        self._steps += taken
        self._rests = False
        return stable


def _rows(array: Floats, first: int, count: int) -> Floats:
    """Return so many rows of an array; where there are no more, the last one again."""
    found = array[first:first + count]
    rest = count - len(found)
    return np.concatenate([found, np.repeat(array[-1:], rest, axis=0)]) if rest else found


def _largest_move(seen: Sequence[Floats]) -> float:
    """Return the largest distance [m] of any point, at any later time, from its first position."""
    start, *later = seen
    return math.sqrt(max(float(np.square(points - start).sum(axis=1).max()) for points in later))
