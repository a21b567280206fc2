# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Compare the two engines: simulate the same trials with the same random parameters in both.

    python benchmark/agreement.py [--trials N] [--seed S]

The trials are the nine actions of each reference object if DLO_DATA names the measured
data, else the four of each object in msg_samples.  Nothing is fitted.
The table is written to benchmark/results/agreement.md and README.md.
"""

from __future__ import annotations

import argparse
from typing import Iterator

from discretisation import DATA, exact_trials
from figures import SAMPLES, table, write
import numpy as np

from dlo_calibration import SimulationError, Trial
from dlo_calibration.files.session import read_session
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.protocol import Simulator

OBJECTS = tuple(f'object{k}' for k in range(1, 6))
RANDOM = ('flexibility', 'elasticity', 'friction', 'damping')
NEVER_TOUCHES = 1e-9  # m
SHARES = (1e-10, -1e-10, 1e-9, -1e-9, 1e-8)  # by which the friction is changed
SAME = 1e-3  # m; a point with a larger distance is elsewhere


def reference_trials() -> list[tuple[str, float, Trial]]:
    """Return object, mass [kg] and trial."""
    reference = []
    for name in OBJECTS:
        if DATA.is_dir():
            properties, trials = exact_trials(name)
            reference += [(name, properties['mass'], trial) for trial in trials]
        else:
            session = read_session(SAMPLES / name)
            options = session.options
            reference += [(name, options.mass, trial) for trial in session.trials]
    return reference


def cases(count: int, seed: int) -> Iterator[tuple[str, Trial, dict[str, float], float]]:
    """Draw object, trial, physical parameters of a DLO without self-contact, and a random radius [m]."""
    generator = np.random.default_rng(seed)
    trials = reference_trials()
    order = np.concatenate([generator.permutation(len(trials)) for _ in range(-(-count // len(trials)))])
    space = ParameterSpace((*RANDOM, 'self_collision'))
    for k in order[:count]:
        name, mass, trial = trials[k]
        physical = space.physical(space.values(generator.uniform(size=space.dimension)), trial.initial.length)
        radius = physical['self_collision']
        yield name, trial, {**physical, 'mass': mass, 'self_collision': NEVER_TOUCHES}, radius


def difference(engines: tuple[Simulator, Simulator], trial: Trial, physical: dict[str, float]) -> Floats:
    """Return the distances between the points of two engines [m]; none if both fail."""
    chains = []
    for engine in engines:
        try:
            chains.append(engine.simulate(trial, physical).chains)
        except SimulationError:
            chains.append(None)
    if chains[0] is None and chains[1] is None:
        return np.zeros(0)
    if chains[0] is None or chains[1] is None:
        return np.full(1, np.inf)
    distances: Floats = np.linalg.norm(chains[0] - chains[1], axis=-1).ravel()
    return distances


def own_spread(engine: Simulator, trial: Trial, physical: dict[str, float]) -> float:
    """Return the largest displacement of an engine's points [m] if the friction changes by one of SHARES."""
    chains = engine.simulate(trial, physical).chains
    return max(float(np.linalg.norm(engine.simulate(
        trial, {**physical, 'friction': physical['friction'] * (1 + share)}).chains - chains, axis=-1).max())
        for share in SHARES)


def cells(distances: list[Floats]) -> list[object]:
    """Return mean, 99th percentile and worst [mm], trials with a point elsewhere, and failed ones."""
    points = 1e3 * np.concatenate(distances)
    return [f'{points.mean():.2g}', f'{np.percentile(points, 99):.2g}', f'{points.max():.2g}',
            sum(each.max(initial=0) > SAME for each in distances), sum(not len(each) for each in distances)]


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--trials', type=int, default=200)
    parser.add_argument('--seed', type=int, default=1)
    arguments = parser.parse_args()
    engines = BulletSimulator(), CompiledSimulator()
    separate: dict[str, list[Floats]] = {}
    touching: dict[str, list[Floats]] = {}
    worst: list[tuple[float, int, str, Trial, dict[str, float]]] = []
    for number, (name, trial, physical, radius) in enumerate(
            cases(arguments.trials, arguments.seed), start=1):
        for kind, series, parameters in (('without', separate, physical),
                                         ('with', touching, {**physical, 'self_collision': radius})):
            distances = difference(engines, trial, parameters)
            series.setdefault(name, []).append(distances)
            what = f'{name}, {trial.name}, {kind}'
            worst.append((float(distances.max(initial=0)), number, what, trial, parameters))
    worst.sort(key=lambda case: -case[0])
    spreads = [[number, what, *(f'{parameters[key]:.2g}' for key in (*RANDOM, 'self_collision')),
                f'{1e3 * far:.2g}',
                *(f'{1e3 * own_spread(engine, trial, parameters):.2g}' for engine in engines)]
               for far, number, what, trial, parameters in worst[:6] if np.isfinite(far)]
    engines[0].close()
    columns = ['objects', 'self-contact', 'trials', 'mean, mm', '99th percentile, mm', 'worst, mm',
               'trials with a point beyond 1 mm', 'failed in both']
    rows = [[label, kind, sum(len(series[name]) for name in names),
             *cells([distances for name in names for distances in series[name]])]
            for label, names in (('all', OBJECTS), *((name, (name,)) for name in OBJECTS))
            for kind, series in (('without', separate), ('with', touching))
            if all(name in series for name in names)]
    text = [table(columns, rows),
            'The worst, and how far each engine is from itself where the friction changes by '
            f'{min(SHARES, key=abs):g} to {max(SHARES):g} of its value (the largest of {len(SHARES)} '
            'rollouts): some rollouts magnify the smallest change.',
            table(['number', 'object, action, self-contact', *RANDOM, 'radius', 'difference, mm',
                   'bullet to itself, mm', 'compiled to itself, mm'], spreads)]
    write('agreement', f'python benchmark/agreement.py --trials {arguments.trials} --seed {arguments.seed}',
          f'The {len(reference_trials())} trials of five objects '
          f'({"DLO_DATA" if DATA.is_dir() else "samples"}), '
          f'drawn {arguments.trials} times in random order, each with random {", ".join(RANDOM)} '
          f'(0 to 100); without self-contact the radius is {NEVER_TOUCHES:g} m, with it random, too. '
          'Distances of the goal points; parameters in SI units.', '\n\n'.join(text))


if __name__ == '__main__':
    main()
