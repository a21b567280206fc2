# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Routing: plans that lead a DLO around pegs, executed in reality; write results/routing.md.

A task has two to four pegs at random places beside a DLO that lies nearly straight, and a goal that a hand
has made in reality: it led one end around the pegs, at random sides, and then dragged two random points to
random places.  A planner that knows the true parameters sees the DLO with noise, and plans; the first action
is executed in a finer simulation; then it plans anew.  In further tasks, a straight DLO is to be laid into a
clip: between two pegs 1.2 diameters apart.

    python benchmark/routing.py [--tasks N] [--seed S]
"""

from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise
import os
from pathlib import Path
import tempfile
import textwrap
import time
from typing import Sequence

import numpy as np
from plan_executions import Belief, TRUE
from reality import clear_of_itself, KNOWN_DLOS, KnownDlo, laid, POINTS, Reality, seen

from dlo_calibration.calibration.engines import make_simulator, obstacles_of
from dlo_calibration.calibration.options import Options
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.planner import plan
from dlo_calibration.planning.rehearsal import ActionStep, motion_of_actions, RehearsalJob, rehearse
from dlo_calibration.planning.surroundings import passed_wrongly, Surroundings
from dlo_calibration.planning.ways import way_around
from dlo_calibration.simulation.protocol import Simulator

PEGS = (2, 3, 4)
DIAMETER = (0.005, 0.010)  # m
HEIGHT = 0.05  # m of the pegs
ASIDE = (0.025, 0.045)  # m between the middle lines of a peg and of the DLO at the start, less its radius
BEND = 0.6  # rad; largest angle by which the start is curved
PIVOT = 0.15  # share of the length; what lies before it is not led
DRAGS = 2  # of random points, after it is led
DRAGGED = (0.04, 0.10)  # m
NEARBY = 0.05  # m between the middle lines of a peg and of the goal that passes it
WIDE = 0.03  # m from the middle of a peg to the way of the hand that makes the goal
NOISE = 1e-3  # m, standard deviation of each coordinate that the camera sees
CLIPS = ((0.35, -0.06), (0.35, 0.1), (0.5, -0.06), (0.5, 0.1))  # share of the length, and m aside
CLIP_RADIUS = 0.004  # m
FRAMES, MOST_FRAMES = 200.0, 100_000  # per second, and in all, in which passages through pegs are looked for
ACTIONS = 8  # executed, at most
REACHED = 2.0  # % of the length
PLAN = PlanOptions(draws=0, tolerance=1.5)
RESULT = Path(__file__).with_name('results') / 'routing.md'


@dataclass(frozen=True)
class Task:
    """
    A routing task.

    :param pegs: (p, 3) [m] places x y and radii.
    :param start: (81, 3) [m]; `goal` (81, 3) [m].
    """

    dlo: KnownDlo
    pegs: Floats
    scene: Path
    start: Floats
    goal: Floats


def write_scene(pegs: Floats, path: Path) -> None:
    """Write pegs, (p, 3) [m] x y radius, as a URDF file."""
    links = ''.join(
        f'<link name="peg_{k}"><collision><origin xyz="{x} {y} {HEIGHT / 2}"/><geometry><cylinder '
        f'radius="{radius}" length="{HEIGHT}"/></geometry></collision></link><joint name="joint_{k}" '
        f'type="fixed"><parent link="table"/><child link="peg_{k}"/></joint>'
        for k, (x, y, radius) in enumerate(pegs))
    path.write_text(f'<robot name="pegs"><link name="table"/>{links}</robot>', encoding='utf-8')


def options_of(dlo: KnownDlo, scene: Path) -> Options:
    """Return the options of the planner's simulation."""
    return Options.of({'mass': dlo.mass, 'scene': str(scene)})


def random_task(index: int, seed: int, folder: Path) -> Task:
    """Return a random task; it depends on the seed and its index alone."""
    generator, dlo = np.random.default_rng([seed, index]), KNOWN_DLOS[index % len(KNOWN_DLOS)]
    scene = folder / f'pegs_{index}.urdf'
    while True:
        curve = bent(dlo, generator.uniform(-BEND, BEND))
        along = np.linspace(0.35, 0.85, PEGS[index % len(PEGS)])
        at = curve[(along * (POINTS - 1)).astype(int)]
        ahead = curve[(along * (POINTS - 1)).astype(int) + 1] - at
        left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead[:, :2], axis=1)[:, None]
        radii = generator.uniform(*DIAMETER, len(along)) / 2
        aside = generator.uniform(*ASIDE, len(along)) + dlo.radius
        aside *= generator.choice([-1.0, 1.0], len(along))
        pegs = np.column_stack([at[:, :2] + aside[:, None] * left, radii])
        sides = generator.choice([-1.0, 1.0], len(along))
        write_scene(pegs, scene)
        options = options_of(dlo, scene)
        surroundings = Surroundings.of(obstacles_of(options), PLAN.clearance)
        with closing(make_simulator(options)) as coarse:
            simulator = coarse.refined()
            start = laid(dlo, curve, simulator)
            goal = routed(dlo, start, pegs, left * sides[:, None], surroundings, simulator, generator)
        if goal is not None and fair(dlo, start, goal, surroundings):
            return Task(dlo, pegs, scene, start, goal)


def clip_task(index: int, folder: Path) -> Task:
    """Return the task to lay a DLO into a clip, one of CLIPS for each of the known DLOs."""
    dlo = KNOWN_DLOS[index % len(KNOWN_DLOS)]
    share, aside = CLIPS[index // len(KNOWN_DLOS)]
    goal, scene = bent(dlo, 0.0), folder / f'clip_{index}.urdf'
    apart = 1.2 * dlo.radius + CLIP_RADIUS
    pegs = np.array([[share * dlo.length, side * apart, CLIP_RADIUS] for side in (-1, 1)])
    write_scene(pegs, scene)
    return Task(dlo, pegs, scene, goal + [0.0, aside, 0.0], goal)


def bent(dlo: KnownDlo, angle: float) -> Floats:
    """Return a DLO that lies on the table, curved by an angle [rad], (81, 3) [m]."""
    heading = angle * (np.linspace(0, 1, POINTS - 1) - 0.5)
    steps = np.column_stack([np.cos(heading), np.sin(heading)]) * dlo.length / (POINTS - 1)
    places = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    return np.column_stack([places, np.full(POINTS, dlo.radius)])


def routed(dlo: KnownDlo, start: Floats, pegs: Floats, sides: Floats, surroundings: Surroundings,
           simulator: Simulator, generator: np.random.Generator) -> Floats | None:
    """
    Return a DLO that a hand has led past pegs and dragged, (81, 3) [m]; None if that fails.

    :param sides: (p, 2) unit vectors, the side at which it passes each peg.
    """
    passed = pegs[:, :2] + (WIDE + dlo.radius) * sides
    pivot = start[int(PIVOT * (POINTS - 1)), :2]
    route = np.vstack([pivot, passed])
    spent = np.linalg.norm(np.diff(route, axis=0), axis=1).sum()
    direction = (passed[-1] - passed[-2]) / np.linalg.norm(passed[-1] - passed[-2])
    end = passed[-1] + max((1 - PIVOT) * dlo.length - spent, 0.02) * direction
    back = start[::-1][:-int(PIVOT * (POINTS - 1)), :2]
    points: Floats | None = dragged(dlo, start, POINTS - 1, np.vstack([back, passed, end]), surroundings,
                                    simulator)
    for _ in range(DRAGS):
        if points is None:
            break
        grip, angle = int(generator.integers(POINTS)), generator.uniform(-np.pi, np.pi)
        place = points[grip, :2] + generator.uniform(*DRAGGED) * np.array([np.cos(angle), np.sin(angle)])
        if surroundings.spare(points[grip]) < 0:
            return None
        points = dragged(dlo, points, grip, np.vstack([points[grip, :2], place]), surroundings, simulator)
    return points


def dragged(dlo: KnownDlo, points: Floats, grip: int, places: Floats, surroundings: Surroundings,
            simulator: Simulator) -> Floats | None:
    """
    Return the DLO at rest, (81, 3) [m], after a hand has dragged a point of it; None if that fails.

    :param places: (w, 2) [m] that the hand passes at the sides of pegs at which a short way does.
    """
    way = way_around(surroundings, places, dlo.radius)
    if way is None:
        return None
    path = np.column_stack([way, np.full(len(way), points[grip, 2])])
    legs = np.maximum(np.linalg.norm(np.diff(path, axis=0), axis=1), 1e-4)
    hand = Hand('hand_1', (grip,), np.append(0.0, np.cumsum(legs)) / PLAN.of_length(dlo.length).speed, path)
    steps = (ActionStep(Action((hand,))),)
    rehearsal, = rehearse(Pool(simulator), [RehearsalJob(Chain(points), steps, dlo.physical)])
    settled = not rehearsal.failure and all(rehearsal.settled)
    if not settled or passages(dlo, points, steps, surroundings, simulator):
        return None
    return np.asarray(rehearsal.chains[-1])


def fair(dlo: KnownDlo, start: Floats, goal: Floats, surroundings: Surroundings) -> bool:
    """
    Tell whether a goal is one of routing.

    It lies on the table, clear of itself, passes at least two pegs nearby, and some peg at another side than
    the start does.
    """
    posts = surroundings.posts(start, goal)
    away = np.linalg.norm(goal[:, None, :2] - posts, axis=2)
    inner = np.abs(away.argmin(axis=0) / (POINTS - 1) - 0.5) < 0.45
    return bool(goal[:, 2].max() < 1.5 * dlo.radius and clear_of_itself(dlo, goal)
                and np.count_nonzero(inner & (away.min(axis=0) < NEARBY)) >= 2
                and len(posts) == len(surroundings.bodies) and passed_wrongly(start, goal, posts))


def passages(dlo: KnownDlo, start: Floats, steps: Sequence[ActionStep], surroundings: Surroundings,
             simulator: Simulator) -> int:
    """Return how often a DLO goes through a peg, and not over it, from one frame to the next."""
    _, motion = motion_of_actions(Chain(start), steps, simulator, dlo.physical, frame_rate=FRAMES,
                                  most=MOST_FRAMES)
    count = 0
    for body in surroundings.bodies:
        post = body.middle[None]
        for before, after in pairwise(motion.chains):
            if passed_wrongly(before, after, post):
                near = np.linalg.norm(after[:, :2] - post, axis=1) < 0.03
                count += not (near.any() and after[near, 2].max() > HEIGHT)
    return count


@dataclass(frozen=True)
class Outcome:
    """
    What became of a task.

    :param errors: mean distance from the goal, before and after each action [% of the length].
    :param seconds: of each plan; `worked` those of all processors together; `planned` its number of actions.
    :param nearest: of a hand to a peg [m].
    :param passages: through a peg.
    """

    errors: tuple[float, ...]
    seconds: tuple[float, ...]
    worked: tuple[float, ...]
    planned: tuple[int, ...]
    nearest: float
    passages: int
    wrong: int
    why: str

    @property
    def reached(self) -> bool:
        """Whether the DLO is within REACHED of the goal, at the right sides."""
        return self.errors[-1] <= REACHED and not self.wrong and not self.passages


def conduct(task: Task, index: int, seed: int) -> Outcome:
    """Plan and execute, until the camera sees the DLO on the goal."""
    dlo, options = task.dlo, options_of(task.dlo, task.scene)
    camera = np.random.default_rng([seed, index, 1])
    surroundings = Surroundings.of(obstacles_of(options), PLAN.clearance)
    posts = surroundings.posts(task.start, task.goal)
    with closing(make_simulator(options)) as coarse:
        finer = coarse.refined()
        reality = Reality(dlo, Chain(task.start), finer)

        def error() -> float:
            return 100 * float(np.linalg.norm(seen(reality.points - task.goal), axis=1).mean()) / dlo.length

        errors, seconds, worked, planned, nearest, why = [error()], [], [], [], np.inf, ''
        while len(errors) <= ACTIONS:
            points = seen(reality.points)
            points = points + camera.normal(0.0, NOISE, points.shape)
            begun = time.process_time()
            made = plan(Belief.certain(TRUE, dlo), Chain(points), Chain(seen(task.goal)),
                        replace(PLAN, actions=min(PLAN.actions, ACTIONS + 1 - len(errors))),
                        simulation=options)
            if not made.actions:
                break
            worked.append(time.process_time() - begun)
            seconds.append(made.seconds)
            planned.append(len(made.actions))
            why = made.stop_reason if not made.reached else ''
            hand, = made.actions[0].action.hands
            reality.act(made.actions[0].action)
            for begin, end in pairwise(hand.positions):
                nearest = min(nearest, *(PLAN.clearance + surroundings.spare(begin + share * (end - begin))
                                         for share in np.linspace(0, 1, 50)))
            errors.append(error())
        through = passages(dlo, task.start, reality.steps, surroundings, finer) if reality.steps else 0
    return Outcome(tuple(errors), tuple(seconds), tuple(worked), tuple(planned), nearest, through,
                   passed_wrongly(reality.points, task.goal, posts), why)


def whole_search(task: Task) -> tuple[int, int, float, float]:
    """Return what `_times` takes of a plan of up to three actions with a tolerance that cannot be met."""
    begun, working = time.monotonic(), time.process_time()
    plan(Belief.certain(TRUE, task.dlo), Chain(seen(task.start)), Chain(seen(task.goal)),
         PlanOptions(actions=3, tolerance=0.01), simulation=options_of(task.dlo, task.scene))
    return len(task.pegs), 3, time.monotonic() - begun, time.process_time() - working


def table(outcomes: list[tuple[Task, Outcome]], clips: list[tuple[Task, Outcome]], seed: int) -> str:
    """Return the document with the outcomes of tasks."""
    searches = [whole_search(task) for task, _ in outcomes if len(task.pegs) == max(PEGS)]
    reached = sum(outcome.reached for _, outcome in outcomes)
    through = sum(outcome.passages for _, outcome in outcomes)
    times = [(len(task.pegs), *each) for task, outcome in outcomes for each in zip(
        outcome.planned, outcome.seconds, outcome.worked, strict=True)]
    filled = sum(outcome.reached for _, outcome in clips)
    rows = [f'| {k} | {task.dlo.name} | {len(task.pegs)} | {outcome.errors[0]:.1f} | '
            f'{outcome.errors[-1]:.2f} | {len(outcome.errors) - 1} | '
            f'{max(outcome.seconds, default=0.0):.1f} | {1e3 * outcome.nearest:.1f} | {outcome.passages} | '
            f'{"yes" if outcome.reached else f"no: {outcome.why}"} |'
            for k, (task, outcome) in enumerate([*outcomes, *clips], 1)]
    text = (
        f'**{reached} of {len(outcomes)} tasks reached**: within {REACHED:g} % of the length on average, and '
        f'all pegs passed at the right side. The DLO went through a peg {through} times. Each peg has a '
        f'diameter of {1e3 * DIAMETER[0]:g} to {1e3 * DIAMETER[1]:g} mm and a height of {1e3 * HEIGHT:g} mm. '
        'A hand has made the goal in reality: it led one end around the pegs at random sides, and dragged '
        f'{DRAGS} random points to random places. A goal counts if it lies on the table, clear of itself, '
        f'passes at least two pegs at less than {1e3 * NEARBY:g} mm, and some peg at another side than the '
        f'start. At most {ACTIONS} actions are executed, in a simulation with {POINTS} nodes and half the '
        'time step. Each is planned anew, with the true parameters, from a chain with a noise of '
        f'{1e3 * NOISE:g} mm. Load average of the two cores at the end: {os.getloadavg()[2]:.0f}.')
    return '\n'.join([
        '# Routing around pegs', '',
        f'Made by `python benchmark/routing.py --tasks {len(outcomes)} --seed {seed}`.', '',
        *textwrap.wrap(text, 108), '',
        *textwrap.wrap(
            f'**{filled} of {len(clips)} clips filled**, likewise, from a straight DLO that lies '
            f'{1e3 * abs(CLIPS[0][1]):g} or {1e3 * abs(CLIPS[1][1]):g} mm aside. A clip is two pegs with a '
            f'diameter of {2e3 * CLIP_RADIUS:g} mm, 1.2 diameters of the DLO apart: no hand passes between '
            f'them. They are the tasks from {len(outcomes) + 1} on.', 108), '',
        '| plans | number | s, median | s, longest | s of all processors together, median | longest |',
        '|---|---|---|---|---|---|',
        _times('all', times),
        _times('of three actions or more', [each for each in times if each[1] >= 3]),
        _times('that try up to three actions among four pegs, with 8 draws, and reach nothing', searches), '',
        '| task | DLO | pegs | start, % | end, % | actions | longest plan, s | hand to peg, mm | '
        'through a peg | reached |', '|---|---|---|---|---|---|---|---|---|---|', *rows, ''])


def _times(which: str, times: Sequence[tuple[int, int, float, float]]) -> str:
    """Return a row about plans, each with its pegs, actions, seconds, and seconds of all processors."""
    if not times:
        return f'| {which} | 0 | | | | |'
    _, _, seconds, worked = np.transpose(times)
    return (f'| {which} | {len(times)} | {np.median(seconds):.1f} | {seconds.max():.1f} | '
            f'{np.median(worked):.1f} | {worked.max():.1f} |')


def main() -> None:
    """Conduct the tasks, and write the document."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--tasks', type=int, default=20)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--only', type=int, action='append',
                        help='conduct this task alone, and write nothing')
    chosen, count = parser.parse_args(), len(CLIPS) * len(KNOWN_DLOS)
    outcomes: list[tuple[Task, Outcome]] = []
    clips: list[tuple[Task, Outcome]] = []
    with tempfile.TemporaryDirectory() as folder:
        for number in chosen.only or range(1, chosen.tasks + count + 1):
            index = number - 1
            begun = time.monotonic()
            task = random_task(index, chosen.seed, Path(folder)) if index < chosen.tasks else \
                clip_task(index - chosen.tasks, Path(folder))
            made = time.monotonic() - begun
            outcome = conduct(task, index, chosen.seed)
            (outcomes if index < chosen.tasks else clips).append((task, outcome))
            print(f'{index + 1}: {task.dlo.name}, {len(task.pegs)} pegs, made in {made:.1f} s: '
                  f'{"reached" if outcome.reached else "NOT reached"}: '
                  f'{", ".join(f"{error:.2f}" for error in outcome.errors)} %; plans '
                  f'{", ".join(f"{taken:.1f}" for taken in outcome.seconds)} s; passages {outcome.passages}, '
                  f'wrong {outcome.wrong}, nearest {1e3 * outcome.nearest:.1f} mm {outcome.why}', flush=True)
        if chosen.only is None:
            RESULT.write_text(table(outcomes, clips, chosen.seed), encoding='utf-8')


if __name__ == '__main__':
    main()
