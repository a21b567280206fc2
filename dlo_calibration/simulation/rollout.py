# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""roll_out(): simulates a trial by following its script, the same way for every engine."""

from __future__ import annotations

from collections import deque
from functools import lru_cache
from itertools import cycle
import math
from typing import Generator, NamedTuple, Protocol, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.model.chain import Floats
from dlo_calibration.simulation.protocol import advanced, Rollout
from dlo_calibration.simulation.script import Advance, Close, Hold, Script, See, Settling

CHECKS = 5  # of the displacement within one `Settling.time`
PIECE = 1000  # steps in one call of a stepper: at most some seconds, even with 1000 nodes


class Steps(NamedTuple):
    """
    What a trial asks of a stepper next.

    :param targets: (k, h, 3) [m] positions of the held nodes after each step; after k steps, they stay.
    :param turns: (k, h, 9) rotation matrices of their hands in each step, row by row; None: it makes no
        difference how they turn.
    :param number: of steps; with `settling`, at most.
    :param path: (number, N, 3) [m] where the nodes' positions after each step are written; None: nowhere.
    :param settling: the steps end as soon as the DLO is stable; None: they do not.
    """

    targets: Floats
    turns: Floats | None
    number: int
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


def roll_out(script: Script, stepper: Stepper) -> Rollout:
    """
    Simulate a trial with a stepper that is at the start of it.

    :raises SimulationError: if the rollout diverges.
    """
    steps_of, taken = course(script, stepper), None
    try:
        while True:
            taken = take(stepper, steps_of.send(taken))
    except StopIteration as end:
        rollout: Rollout = end.value
        return rollout


def course(script: Script, stepper: Stepper) -> Course:
    """Return the course of a trial for a stepper that is at the start of it; others take its steps."""
    offsets = np.empty((script.offsets, 3))  # [m] of nodes from the hands that hold them
    before, chains, settled = stepper.points, [], []
    steps, rests = 0, False  # whether the DLO came to rest and nothing has happened since
    for event in script.events:
        if isinstance(event, Advance):
            if event.remembers:
                before = stepper.points
            if not (event.settles and rests):
                taken, rests = _answered((yield _steps(event, script, stepper, offsets)))
                steps += taken
        elif isinstance(event, Hold):
            stepper.hold(event.nodes)
            rests = False
        elif isinstance(event, Close):
            offsets[event.rows] = stepper.points[event.nodes] - event.position
        elif isinstance(event, See):
            now = stepper.points
            chains.append(script.observe @ (
                now if event.share is None else before + event.share * (now - before)))
            settled.append(rests or event.share is not None)
        else:
            path = np.empty((event.steps.count + 2, *before.shape))
            path[:2] = before, stepper.points
            taken, rests = _answered((yield _steps(event.steps, script, stepper, offsets, path[2:])))
            steps += taken
            before, earlier = path[-2], path[event.after - 1]
            chains.extend(script.observe @ (
                earlier + event.shares[:, None, None] * (path[event.after] - earlier)))
            settled.extend([True] * len(event.after))
    return Rollout(np.array(chains), tuple(settled), steps * script.time_step, steps)


def _steps(event: Advance, script: Script, stepper: Stepper, offsets: Floats,
           path: Floats | None = None) -> Steps:
    return Steps(event.targets(offsets), event.turns if stepper.twists else None, event.count, path,
                 script.settling if event.settles else None)


def _answered(answer: tuple[int, bool] | None) -> tuple[int, bool]:
    assert answer is not None
    return answer


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
        while taken < steps.number:
            advance(min(PIECE, steps.number - taken))
        return taken, False
    seen: deque[Floats] = deque([stepper.points], maxlen=CHECKS + 1)  # over one window
    for count in cycle(steps.periods(stepper.time_step).tolist()):
        advance(min(count, steps.number - taken))
        seen.append(stepper.points)
        if len(seen) > CHECKS and _largest_move(seen) < steps.settling.distance:
            return taken, True
        if taken == steps.number:
            break
    return taken, False


def _largest_move(seen: Sequence[Floats]) -> float:
    """Return the largest distance [m] of any point, at any later time, from its first position."""
    start, *later = seen
    return math.sqrt(max(float(np.square(points - start).sum(axis=1).max()) for points in later))
