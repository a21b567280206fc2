# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrate ropes from trials among two pegs, whose truth is known.

    python benchmark/pegs.py

The trials are simulated with finer nodes and steps, and seen with noise.  Hands hold the rope until it rests
with little bending at the pegs: a stiff rope that is bent around one and let go snaps back, and where it
lands depends on nodes and steps, which `fit` says of such trials.

It takes two minutes.  The table is printed, and written to benchmark/results/pegs.md.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from figures import HERE, table
import numpy as np

from dlo_calibration import Action, calibrate, Chain, Goal, Hand, Options, Trial
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.scene import read_scene

OBJECTS, NOISE, MASS, LENGTH = 20, 1.5e-3, 0.03, 0.6  # of ropes; m; kg; m
PEGS = ((0.38, 0.05), (0.24, -0.05))  # m
SCENE = '<robot name="pegs"><link name="table">' + ''.join(
    f'<collision><origin xyz="{x} {y} 0.05"/><geometry><cylinder length="0.1" radius="0.008"/></geometry>'
    '</collision>' for x, y in PEGS) + '</link></robot>'
WAYS = {  # what a hand does with a point of 21: its way [m], 2 cm above the table
    'end beside the first peg': (20, [(0.55, 0.12), (0.47, 0.22)]),
    'end beside the second peg': (0, [(0.05, -0.12), (0.13, -0.22)]),
    'a point beside the first peg': (16, [(0.46, 0.16)]),
    'a point beside the second peg': (4, [(0.14, -0.16)]),
    'unseen: end farther around the first peg': (20, [(0.55, 0.12), (0.45, 0.24), (0.36, 0.26)]),
    'unseen: other end farther around': (0, [(0.05, -0.12), (0.15, -0.24), (0.24, -0.26)])}


def straight(level: float) -> np.ndarray:
    """Return the chain at the start, (21, 3) [m]."""
    return np.column_stack([np.linspace(0, LENGTH, 21), np.zeros(21), np.full(21, level)])


def missed(engine: CompiledSimulator, trials: list[Trial], physical: dict) -> float:
    """Return the mean distance [m] of simulated chains from those that were seen."""
    return float(np.mean([np.linalg.norm(engine.simulate(trial, physical).chains
                                         - [goal.chain.points for goal in trial.goals], axis=2).mean()
                          for trial in trials]))


def trials(engine: CompiledSimulator, physical: dict, level: float, random: np.random.Generator
           ) -> list[Trial]:
    """Return the trials as they are seen."""
    points = straight(level)
    seen = []
    for name, (grip, places) in WAYS.items():
        way = np.array([points[grip], *[(x, y, level + 0.02) for x, y in places], (*places[-1], level)])
        times = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))) / 0.15
        goals = (Goal(Chain(points), times[-1], stable=False, held_by=('hand',)),
                 Goal(Chain(points), times[-1] + 1.0))
        trial = Trial(name, Chain(points), (Action((Hand('hand', (grip,), times, way),)),), goals)
        chains = engine.simulate(trial, physical).chains
        noisy = [Chain(chain + random.normal(0, NOISE, chain.shape)) for chain in (points, *chains)]
        seen.append(replace(trial, initial=noisy[0], goals=tuple(
            replace(goal, chain=chain) for goal, chain in zip(goals, noisy[1:], strict=True))))
    return seen


def main() -> None:
    """Calibrate each rope, print the table and write it."""
    rows, held, misses = [], [], []
    with TemporaryDirectory() as folder:
        scene = Path(folder) / 'pegs.urdf'
        scene.write_text(SCENE, encoding='utf-8')
        for k in range(OBJECTS):
            random = np.random.default_rng(k)
            truth = {'flexibility': random.uniform(55.0, 82.7), 'friction': random.uniform(50, 75)}
            space = ParameterSpace(fixed={**truth, 'self_collision': 25.0}, mass=MASS)
            physical = space.physical({}, LENGTH)
            engine = CompiledSimulator(obstacles=read_scene(str(scene)), nodes=81, time_step=0.0015)
            made_from = Chain(straight(physical['self_collision']))
            made = trials(engine, physical, physical['self_collision'], random)
            fitted = [trial for trial in made if not trial.name.startswith('unseen')]
            options = Options(calibrate=('flexibility', 'friction'), mass=MASS, scene=str(scene),
                              engine='compiled', values={'self_collision': 25.0})
            result = calibrate(fitted, options)
            best = result.space.physical(result.values, LENGTH)
            default = CompiledSimulator(obstacles=read_scene(str(scene)))
            unseen = [trial for trial in made if trial.name.startswith('unseen')]
            errors = [missed(default, unseen, best), missed(default, unseen, physical)]
            fine = [engine.simulate(replace(trial, initial=made_from), physical).chains for trial in unseen]
            disturbed = [engine.simulate(trial, physical).chains for trial in unseen]
            errors.append(float(np.mean([np.linalg.norm(a - b, axis=2).mean()
                                         for a, b in zip(fine, disturbed, strict=True)])))
            misses.append(errors)
            row = [k + 1]
            for name, value in truth.items():
                estimate = result.parameters[name]
                held.append(estimate.lower <= value <= estimate.upper)
                row += [f'{value:.1f}', f'{estimate.value:.1f} [{estimate.lower:.1f}, {estimate.upper:.1f}]']
            rows.append([*row, f'{1e3 * result.best.errors.mean:.2f}',
                         *(f'{1e3 * error:.2f}' for error in errors)])
    twice = 2 * NOISE * np.sqrt(8 / np.pi)  # m
    text = '\n\n'.join([
        '# Trials among pegs', '`python benchmark/pegs.py`',
        'Four trials with two pegs each, simulated with 81 nodes and half the time step, and seen with a '
        f'noise of {1e3 * NOISE:g} mm in each coordinate ({1e3 * NOISE * np.sqrt(8 / np.pi):.1f} mm in the '
        'mean). Two others are predicted. Values on the scale of 0 to 100, with 90 % intervals.',
        table(['rope', 'flexibility', 'found', 'friction', 'found', 'fitted, mm', 'unseen, mm',
               'unseen, true values, mm', 'moved by noise, mm'], rows),
        'Fitted and unseen: the mean distance from the noisy points, with what was found. True values: the '
        'same with the truth, at the nodes and steps of a calibration. Moved by noise: how far the noise of '
        'the initial chain alone moves the finer simulation.',
        f'{sum(held)} of {len(held)} intervals hold the truth. Of the ropes, '
        f'{sum(found <= twice for found, *_ in misses)} are predicted within twice the noise, '
        f'{1e3 * twice:.1f} mm, and {sum(found <= max(twice, true) for found, true, _ in misses)} '
        'within that or what the true values give.']) + '\n'
    print(text)
    (HERE / 'results' / 'pegs.md').write_text(text, encoding='utf-8')


if __name__ == '__main__':
    main()
