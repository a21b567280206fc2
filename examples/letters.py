# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Three calibrated ropes are laid into the letters D, L, O, step by step.

    python examples/letters.py [FOLDER]

writes ``letters.png`` and ``letters.gif``, and prints a line for each action; it takes a minute or two.

Each rope is calibrated from its session in `msg_samples`.  It begins straight.  A plan with the fitted
parameters says what a hand does next, a finer simulation with the true properties does it, and the next
plan begins with what a camera sees then, with a noise of 1 mm.  A letter is bent only as sharply as
stiffness and friction hold it: see `held`.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
import os
from pathlib import Path
import sys
from typing import Sequence

from letters_drawing import draw_film, draw_letters
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import lsq_linear

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'benchmark'))

from plan_executions import NOISE  # noqa: E402
from reality import KNOWN_DLOS, KnownDlo, POINTS, Reality, seen  # noqa: E402

from dlo_calibration import calibrate, Chain, Options, plan, PlanOptions, read_session  # noqa: E402
from dlo_calibration.calibration.engines import make_simulator  # noqa: E402
from dlo_calibration.calibration.result import CalibrationResult  # noqa: E402
from dlo_calibration.evaluation import Pool  # noqa: E402
from dlo_calibration.files.session import samples  # noqa: E402
from dlo_calibration.model.action import Action  # noqa: E402
from dlo_calibration.model.chain import Floats  # noqa: E402
from dlo_calibration.model.parameters import GRAVITY  # noqa: E402
from dlo_calibration.planning.dlo import CalibratedDlo, Posterior  # noqa: E402
from dlo_calibration.planning.rehearsal import RehearsalJob, rehearse  # noqa: E402

SAFETY = 0.9  # share of the friction that a held letter needs
NODES, STEPS = 41, 12  # of a held letter; of its fit
TOLERANCE = 0.5  # % of the length
MOST_ACTIONS = 6

Place = tuple[float, float]


def arc(x: float, y: float, radii: Place, first: float, last: float) -> list[Place]:
    """Return points on an ellipse around (x, y), from one angle to another [degrees]."""
    angles = np.radians(np.linspace(first, last, 60))
    return list(zip(x + radii[0] * np.cos(angles), y + radii[1] * np.sin(angles), strict=True))


#: Letter -> rope, and its stroke as corners of a polygon, in any unit.
LETTERS = {
    'D': ('object3', [(0, 0.04), (0, 1), (0.2, 1), *arc(0.22, 0.5, (0.4, 0.5), 90, -90), (0.03, 0)]),
    'L': ('object4', [(0, 1), *arc(0.4, 0.4, (0.4, 0.4), 180, 270), (0.9, 0)]),
    'O': ('object1', arc(0, 0.5, (0.48, 0.5), 88, 88 - 356)),
}


@dataclass(frozen=True)
class Laid:
    """
    A rope that was laid into a letter.

    :param goal: (N, 3) [m].
    :param chains: (k + 1, N, 3) [m] at rest before and after each of the k actions.
    :param errors: (k + 1) mean distance of the chains from the goal [% of the length].
    :param courses: for each action, (m, N, 3) [m] the rope while the hand moves.
    """

    letter: str
    dlo: KnownDlo
    goal: Floats
    chains: Floats
    errors: tuple[float, ...]
    actions: tuple[Action, ...]
    courses: tuple[Floats, ...]


def evenly(corners: Floats, count: int) -> Floats:
    """Return evenly spaced points, (count, 2), on a polygon."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.linspace(0, along[-1], count)
    return np.stack([np.interp(at, along, axis) for axis in corners.T], axis=1)


def stroke(corners: Sequence[Place], length: float) -> Floats:
    """Return a stroke of a length [m] as evenly spaced points, (NODES, 2) [m], with round corners."""
    fine = evenly(np.array(corners, dtype=float), 2001)
    padded = np.concatenate([2 * fine[0] - fine[500:0:-1], fine, 2 * fine[-1] - fine[-2:-502:-1]])
    points = evenly(gaussian_filter1d(padded, 40, axis=0)[500:-500], NODES)
    points *= length / np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    return points - (points.min(axis=0) + points.max(axis=0)) / 2


def held(letter: Floats, rope: CalibratedDlo) -> Floats:
    """
    Return the shape nearest to a letter, (NODES, 2) [m], in which the rope stays when it is let go.

    On a table, friction holds a curvature kappa(s) of a rod with bending stiffness EI, mass m and length L
    where the lateral force of its bending, EI (d2(kappa)/ds2 + kappa^3 / 2), is at most mu m g / L (Euler's
    elastica, with free ends and no force along it); kappa and its slope are 0 at the ends.  The unknowns are
    d2(kappa)/ds2 at each node, within these bounds, and the heading of the first segment.  They fit first
    the headings of the letter, which are linear in them, and then its nodes, by Gauss-Newton steps.

    :param letter: (NODES, 2) [m].
    """
    physical, length = Posterior.of(rope).best, rope.length
    most = SAFETY * physical['friction'] * physical['mass'] * GRAVITY / length / physical['flexibility']
    step = length / (NODES - 1)
    slope = most * np.tril(np.full((NODES, NODES), step))  # d(kappa)/ds, then kappa, then headings
    kappa = np.tril(np.full((NODES, NODES), step), -1) @ slope
    headings = np.column_stack([step * np.cumsum(kappa, axis=0)[:-1], np.ones(NODES - 1)])
    ends = np.column_stack([[length * kappa[-1], length**2 * slope[-1]], np.zeros(2)])

    def fitted(rows: Floats, wanted: Floats, cubes: Floats) -> Floats:
        """Return the unknowns within their bounds that fit best, with free ends, given kappa^3 [1/m^3]."""
        middle = np.append(-cubes / (2 * most), 0.0)
        half = np.append(np.ones(NODES), 30.0)
        unknowns: Floats = lsq_linear(np.concatenate([rows, ends]), [*wanted, 0, 0],
                                      (middle - half, middle + half), method='bvls').x
        return unknowns

    unknowns = fitted(headings, np.unwrap(np.arctan2(*np.diff(letter, axis=0).T[::-1])), np.zeros(NODES))
    for _ in range(STEPS):
        angles = headings @ unknowns
        segments = step * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        turning = np.stack([-segments[:, 1], segments[:, 0]], axis=1)[:, :, None] * headings[:, None]
        points, moved = (np.concatenate([np.zeros_like(steps[:1]), np.cumsum(steps, axis=0)])
                         for steps in (segments, turning))
        points, moved = points - (points - letter).mean(axis=0), moved - moved.mean(axis=0)
        unknowns = fitted(moved.reshape(2 * NODES, -1) / length,
                          (letter - points + moved @ unknowns).ravel() / length,
                          (kappa @ unknowns[:-1])**3)
    return points


def calibrated(dlo: KnownDlo) -> CalibrationResult:
    """Calibrate a rope from its session."""
    session = read_session(samples() / dlo.name)
    return calibrate(session.trials, session.options)


def laid(letter: str) -> Laid:
    """Lay a rope into a letter."""
    name, corners = LETTERS[letter]
    dlo = next(dlo for dlo in KNOWN_DLOS if dlo.name == name)
    rope = calibrated(dlo)
    shape = Chain(np.column_stack([held(stroke(corners, dlo.length), rope), np.full(NODES, dlo.radius)]))
    goal = shape.resample(np.linspace(0, shape.length, POINTS))
    start = np.full((POINTS, 3), dlo.radius)
    start[:, 0] = goal[0, 0]
    start[:, 1] = np.linspace(-0.5, 0.5, POINTS) * dlo.length * np.sign(goal[-1, 1] - goal[0, 1] or 1.0)
    random = np.random.default_rng(1)
    options = PlanOptions(tolerance=TOLERANCE)
    with closing(make_simulator(Options()).refined()) as simulator:
        reality, chains, actions = Reality(dlo, Chain(start), simulator), [start], []
        for k in range(MOST_ACTIONS):
            camera = Chain(seen(reality.points) + random.normal(0, NOISE, (len(seen(start)), 3)))
            steps = plan(rope, camera, Chain(seen(goal)), options)
            if not steps.actions:
                break
            reality.act(steps.actions[0].action)
            chains.append(reality.points)
            actions.append(steps.actions[0].action)
            left = error(reality.points, goal, dlo)
            sys.stdout.write(f'{letter}, action {k + 1}: {left:.2f} % of the length from the goal\n')
            sys.stdout.flush()
        job = RehearsalJob(Chain(start), reality.steps, dlo.physical, trajectories=True)
        laid, = rehearse(Pool(simulator), [job])
    return Laid(letter, dlo, goal, np.stack(chains), tuple(error(points, goal, dlo) for points in chains),
                tuple(actions), laid.trajectories)


def error(points: Floats, goal: Floats, dlo: KnownDlo) -> float:
    """Return the mean distance of (N, 3) points from the goal [% of the length]."""
    return 100 * float(np.linalg.norm(points - goal, axis=1).mean()) / dlo.length


def main() -> int:
    """Lay and draw the letters."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else os.curdir)
    folder.mkdir(parents=True, exist_ok=True)
    letters = [laid(letter) for letter in LETTERS]
    draw_letters(letters, folder / 'letters.png')
    draw_film(letters, folder / 'letters.gif')
    return 0


if __name__ == '__main__':
    sys.exit(main())
