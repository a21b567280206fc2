# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Count how often a calibration gives a plain rod what it does not have: a rest shape, stiffer parts, locking.

    python benchmark/plain_rods.py [RODS]

Rods that are straight, even and made of one strand move between two clamps.  They are simulated with finer
nodes and steps, and seen with noise.  No option is named.  It takes ten seconds for each rod.  The table is
printed, and written to benchmark/results/plain_rods.md.
"""

from dataclasses import replace
import sys

from figures import HERE, table
import numpy as np

from dlo_calibration import Action, calibrate, Chain, Goal, Hand, Options, Trial
from dlo_calibration.calibration.choice import BETWEEN_CLAMPS, IN_MOTION
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.compiled import CompiledSimulator

RODS, TRIALS, POINTS = 40, 4, 21
FIRST = 100  # seed; the rules were made with rods of others
LENGTH, MASS, NOISE = 0.6, 0.03, 2e-4  # m; kg; m of a point in each coordinate, as of markers
SECONDS, GOALS = 2.0, 20  # of a trial
#: What is drawn, on the scale of 0 to 100.
DRAWN = {'flexibility': (55, 75.8), 'damping': (30, 60), 'internal_damping': (20, 60), 'torsion': (40, 70)}


def hands(points: np.ndarray, times: np.ndarray, left: np.ndarray, right: np.ndarray) -> tuple[Hand, ...]:
    """Return two clamps that move by (t, 3) [m] from a chain (n, 3)."""
    return (Hand('left', (0, 1), times, points[0] + left),
            Hand('right', (POINTS - 2, POINTS - 1), times, points[-2] + right))


def hanging(engine: CompiledSimulator, physical: dict) -> np.ndarray:
    """Return the rod (n, 3) [m] at rest between two clamps that have come together."""
    points = np.column_stack([np.linspace(0, LENGTH, POINTS), np.zeros(POINTS), np.ones(POINTS)])
    times = np.array([0.0, 2.0])
    both = hands(points, times, np.zeros((2, 3)), np.array([[0, 0, 0], [-0.35 * LENGTH, 0, 0]]))
    trial = Trial('together', Chain(points), (Action(both),), (
        Goal(Chain(points), times[-1] + 1.0, held_by=('left', 'right')),))
    return engine.simulate(trial, physical).chains[-1]


def trials(engine: CompiledSimulator, physical: dict, random: np.random.Generator) -> list[Trial]:
    """Return the trials as they are seen: both clamps move to random places and back."""
    points, seen = hanging(engine, physical), []
    times = np.linspace(0.0, SECONDS, 41)
    for k in range(TRIALS):
        ways = [np.sum([random.uniform(-0.05, 0.05, 3) * np.sin(np.pi * m * times / SECONDS)[:, None]
                        for m in (1, 2, 3)], axis=0) for _ in range(2)]
        goals = tuple(Goal(Chain(points), float(at), False, held_by=('left', 'right'))
                      for at in np.linspace(0.1, SECONDS, GOALS))
        draft = Trial(f'swing {k + 1}', Chain(points), (Action(hands(points, times, *ways)),), goals)
        chains = engine.simulate(draft, physical).chains
        start, *noisy = (Chain(chain + random.normal(0, NOISE, chain.shape)) for chain in (points, *chains))
        seen.append(replace(draft, initial=start, goals=tuple(
            replace(goal, chain=chain) for goal, chain in zip(goals, noisy, strict=True))))
    return seen


def main() -> None:
    """Calibrate each rod, print the table and write it."""
    rows, plain = [], []
    count = int(sys.argv[1]) if len(sys.argv) > 1 else RODS
    names = ('flexibility', 'elasticity', *IN_MOTION, *BETWEEN_CLAMPS)
    for k in range(FIRST, FIRST + count):
        random = np.random.default_rng(k)
        truth = {name: random.uniform(*between) for name, between in DRAWN.items()}
        fixed = {**truth, 'bending_friction': 0.0, 'elasticity': 20.0}
        physical = ParameterSpace(fixed=fixed, mass=MASS).physical({}, LENGTH)
        seen = trials(CompiledSimulator(table=False, nodes=121, time_step=0.001), physical, random)
        result = calibrate(seen, Options(calibrate=names, mass=MASS, table=False, engine='compiled', seed=k))
        space = result.space
        smooth = 'stiffness_knot_2' in space.free
        plain.append(space.parts == 1 and not smooth and not space.knots and 'locking' not in space.free)
        stiffness = result.parameters['flexibility']
        rows.append([k, f'{truth["flexibility"]:.1f}',
                     f'{stiffness.value:.1f} [{stiffness.lower:.1f}, {stiffness.upper:.1f}]',
                     f'{1e3 * result.best.errors.mean:.2f}', 'smooth' if smooth else space.parts, space.knots,
                     'yes' if 'locking' in space.free else 'no'])
        print(*rows[-1], result.stop_reason, flush=True)
    text = '\n\n'.join([
        '# Plain rods', f'`python benchmark/plain_rods.py{f" {count}" if count != RODS else ""}`',
        'Straight and even rods of one strand between two clamps, simulated with 121 nodes and a third of '
        f'the time step; {TRIALS} trials of {SECONDS:g} s, noise of {1e3 * NOISE:g} mm in each coordinate.',
        table(['rod', 'flexibility', 'found', 'error, mm', 'parts', 'knots of a rest shape', 'locks'], rows),
        f'**{sum(plain)} of {count} stay plain**: one part of even stiffness, no rest shape (so no bends at '
        'clamps), no locking.']) + '\n'
    print(text)
    (HERE / 'results' / 'plain_rods.md').write_text(text, encoding='utf-8')


if __name__ == '__main__':
    main()
