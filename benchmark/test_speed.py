# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Measure the speed of both engines, and the time of each part of a rollout: `make bench`."""

import time

from figures import SAMPLES, side_by_side, table, write
import numpy as np
import pytest

from dlo_calibration import Action, Chain, Goal, Hand, read_session, Trial
from dlo_calibration.model.parameters import knot_names, ParameterSpace
from dlo_calibration.simulation import core
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator, NO_TABLE
from dlo_calibration.simulation.protocol import Simulator, Stop

NODES = (12, 30, 60, 120)
ROUNDS = 7
ACTIONS = ('place_end', 'drag_quarter', 'hold_middle', 'two_hands')
SETS = 12
TOGETHER = {  # what is simulated -> free parameters
    'object 1 on a table': ('flexibility', 'elasticity', 'friction', 'self_collision'),
    'a cable between two clamps': ('flexibility', 'damping', 'internal_damping', 'torsion',
                                   'bending_friction', 'natural_curvature')}
VALUES = {'flexibility': 76.9, 'friction': 69.7}  # the truth of object 1
HOW = ('Object 1; a settled round is one trial simulated until the DLO has come to rest. Shortest of '
       f'{ROUNDS} repetitions, in which the engines take turns in one process; its processor time.')


def object1():
    """Return the four trials of object 1 and its physical parameters."""
    session = read_session(SAMPLES / 'object1')
    options = session.options
    trials = session.trials
    return trials, options.space.physical(VALUES, trials[0].initial.length)


@pytest.fixture(scope='module')
def tables():
    """Collect the rows, and write the tables when they are complete."""
    speeds, trials, parts, cables, together = [], [], [], [], []
    yield speeds, trials, parts, cables, together
    wanted = [len(NODES), len(ACTIONS), len(TOGETHER), 6]
    if [len(lines) for lines in (parts, trials, together, cables)] != wanted:
        return  # a part was measured alone
    nodes = np.log([row[0] for row in speeds])
    growth = [np.polyfit(nodes, np.log([row[column] for row in speeds]), 1)[0] for column in (4, 5)]
    last = np.log(speeds[-1][5] / speeds[-2][5]) / (nodes[-1] - nodes[-2])
    rounded = [[row[0], *(f'{x:.1f}' for x in row[1:])] for row in speeds]
    write('speed', 'make bench', HOW, '\n\n'.join([
        table(['nodes', 'bullet, rounds per second', 'compiled, rounds per second', 'ratio',
               'bullet, µs per step', 'compiled, µs per step'], rounded),
        f'From {NODES[0]} to {NODES[-1]} nodes the time of a step grows with the nodes to the power of '
        f'{growth[0]:.2f} (bullet) and {growth[1]:.2f} (compiled; {last:.2f} from {NODES[-2]} to '
        f'{NODES[-1]}).',
        table(['trial, 41 nodes', 'bullet, ms', 'compiled, ms', 'ratio', 'steps'], trials),
        f'{SETS} random parameter sets, 41 nodes and 3 ms, each alone and four at a time:',
        table(['trials', 'rounds', 'alone, rounds per second', 'together, rounds per second', 'ratio',
               'alone, µs per step', 'together, µs per step'], together),
        'A cable of 41 nodes that two clamps swing in the air:',
        table(['physics', 'compiled, µs per step', 'relative to plain'], cables),
        'What a compiled round is spent on, in µs:',
        table(['nodes', 'whole', 'core', 'Python', 'Python, share'], parts)]))


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize('nodes', NODES)
def test_settled_rounds(benchmark, nodes, tables):
    trials, physical = object1()
    engines: dict[str, Simulator] = {
        'bullet': BulletSimulator(nodes=nodes), 'compiled': CompiledSimulator(nodes=nodes)}
    steps = {name: sum(engine.simulate(trial, physical).steps for trial in trials)
             for name, engine in engines.items()}
    seconds = side_by_side(benchmark, {
        name: lambda engine=engine: [engine.simulate(trial, physical) for trial in trials]
        for name, engine in engines.items()}, ROUNDS)
    rate = {name: len(trials) / seconds[name] for name in engines}
    tables[0].append([nodes, rate['bullet'], rate['compiled'], rate['compiled'] / rate['bullet'],
                      *(1e6 * seconds[name] / steps[name] for name in engines)])
    engines['bullet'].close()


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize('number', range(len(ACTIONS)), ids=ACTIONS)
def test_trial(benchmark, number, tables):
    trials, physical = object1()
    engines: dict[str, Simulator] = {'bullet': BulletSimulator(), 'compiled': CompiledSimulator()}
    steps = {name: engine.simulate(trials[number], physical).steps for name, engine in engines.items()}
    seconds = side_by_side(benchmark, {
        name: lambda engine=engine: engine.simulate(trials[number], physical)
        for name, engine in engines.items()}, 2 * ROUNDS)
    tables[1].append([ACTIONS[number], f'{1e3 * seconds["bullet"]:.1f}', f'{1e3 * seconds["compiled"]:.2f}',
                      f'{seconds["bullet"] / seconds["compiled"]:.0f}', steps['compiled']])
    engines['bullet'].close()


@pytest.mark.benchmark(timer=time.process_time)
def test_cables(benchmark, tables):
    """Measure a step with each piece of physics, and with all of it."""
    places, held, count = np.linspace(0, 1.2, 41), [0, 1, 39, 40], 200
    points = np.stack([places, 0.05 * np.sin(4 * places), np.zeros(41)], axis=1)
    plain = {**ParameterSpace().physical({}, 1.2), 'flexibility': 2e-3, 'mass': 0.1, 'damping': 1.0,
             'self_collision': 0.003}
    frame = {'torsion': 0.7, **{name: 3.0 * (-1)**k for k, name in enumerate(knot_names(9))}}
    friction, locking = {'bending_friction': 1.0, 'bending_slip': 0.1}, {'locking': 0.1}
    swing = np.sin(np.linspace(0, np.pi, count + 1))[1:, None, None] * np.array(
        [(0, 0.1, 0), (0, 0.1, 0), (-0.2, 0, 0.1), (-0.2, 0, 0.1)])
    turns = np.tile(np.eye(3).reshape(9), (count, 1))
    start = core.Start(places, points, np.zeros_like(points))
    grips = [core.Grip([k], points[node] + swing[:, k], None, turns)
             for k, node in enumerate(held)]
    script = core.Script([
        *(core.Event.close(k, [node], points[node]) for k, node in enumerate(held)),
        core.Event.hold(held), core.Event.advance(grips, count)], 0.001, 100)
    cables = {name: {**plain, **more} for name, more in {
        'plain': {}, 'natural curvature': {'natural_curvature': 2.0}, 'material frame': frame,
        'friction between strands': friction, 'locking': locking,
        'all of it': {**frame, **friction, **locking}}.items()}
    seconds = side_by_side(benchmark, {
        name: lambda physical=physical: core.roll_out([(script, start, physical, NO_TABLE)], 0.003)
        for name, physical in cables.items()}, 10 * ROUNDS)
    tables[3].extend([name, f'{1e6 * elapsed / count:.1f}', f'{elapsed / seconds["plain"]:.2f}']
                     for name, elapsed in seconds.items())


def swung():
    """Return a trial: two clamps swing a cable in the air, one of them turns."""
    chain = Chain(np.linspace(0, 1.2, 41)[:, None] * [1.0, 0, 0])
    left = Hand('left', (0, 1), [0.0, 1.0], [(0, 0, 0), (0.1, 0.3, 0)])
    right = Hand('right', (39, 40), [0.0, 0.5, 1.0], [(1.17, 0, 0), (0.9, 0.2, 0.1), (0.8, 0.0, 0)],
                 [(0, 0, 0, 1), (0.25, 0, 0, 0.97), (0.5, 0, 0, 0.87)])
    goals = tuple(Goal(chain, time, stable=False, held_by=('left', 'right')) for time in (0.5, 1.0, 1.5))
    return Trial('swung', chain, (Action((left, right)),), goals)


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize('name', TOGETHER)
def test_together(benchmark, name, tables):
    lies = name.endswith('table')
    trials, simulator = object1()[0] if lies else [swung()] * 4, CompiledSimulator(table=lies)
    space, random = ParameterSpace(TOGETHER[name]), np.random.default_rng(1)
    sets = [space.physical(space.values(random.random(len(space.free))), 0.6) for _ in range(SETS)]
    jobs = [(trial, physical) for physical in sets for trial in trials]
    steps = sum(simulator.simulate(*job).steps for job in jobs)
    simulator.simulate_together(jobs, Stop())
    seconds = side_by_side(benchmark, {'alone': lambda: [simulator.simulate(*job) for job in jobs],
                                       'together': lambda: simulator.simulate_together(jobs, Stop())}, ROUNDS)
    rates = [len(jobs) / elapsed for elapsed in seconds.values()]
    tables[4].append([name, len(jobs), *(f'{rate:.0f}' for rate in rates), f'{rates[1] / rates[0]:.2f}',
                      *(f'{1e6 * elapsed / steps:.2f}' for elapsed in seconds.values())])


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize('nodes', NODES)
def test_parts(benchmark, nodes, tables, monkeypatch):
    """Measure the core where Python calls it."""
    trials, physical = object1()
    simulator, roll_out = CompiledSimulator(nodes=nodes), core.roll_out
    whole, inside = [], []

    def watched(*arguments, **named):
        begun = time.process_time()
        try:
            return roll_out(*arguments, **named)
        finally:
            inside[-1] += time.process_time() - begun

    def take():
        inside.append(0.0)
        begun = time.process_time()
        for trial in trials:
            simulator.simulate(trial, physical)
        whole.append(time.process_time() - begun)

    monkeypatch.setattr(core, 'roll_out', watched)
    benchmark.pedantic(take, rounds=2 * ROUNDS, warmup_rounds=1)
    total, stepping = (1e6 * float(np.median(x)) / len(trials) for x in (whole, inside))
    tables[2].append([nodes, *(f'{x:.0f}' for x in (total, stepping, total - stepping)),
                      f'{1 - stepping / total:.0%}'])
