# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Drags show little more than the ratio of stiffness to friction; stick and slip make its valley rough."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_calibration import Action, calibrate, Chain, Goal, Hand, Options, Trial
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.scene import read_scene

LENGTH, MASS, NOISE = 0.6, 0.03, 1.5e-3
WAYS = {  # of the point that a hand holds, and of its way, x and y [m]
    'one end': (20, [(0.55, 0.12), (0.47, 0.22)]), 'the other end': (0, [(0.05, -0.12), (0.13, -0.22)]),
    'beside one end': (16, [(0.46, 0.16)]), 'beside the other': (4, [(0.14, -0.16)])}
PEGS = '<robot name="pegs"><link name="table">' + ''.join(
    f'<collision><origin xyz="{x} {y} 0.05"/><geometry><cylinder length="0.1" radius="0.008"/></geometry>'
    '</collision>' for x, y in ((0.38, 0.05), (0.24, -0.05))) + '</link></robot>'


def seen(ways, truth, random, obstacles=()):
    """Return trials with a rope whose parameters are known, simulated finely and seen with noise."""
    physical = ParameterSpace(fixed={**truth, 'self_collision': 25.0}, mass=MASS).physical({}, LENGTH)
    engine = CompiledSimulator(obstacles=obstacles, nodes=81, time_step=0.0015)
    level = physical['self_collision']
    points = np.column_stack([np.linspace(0, LENGTH, 21), np.zeros(21), np.full(21, level)])
    trials = []
    for name, (grip, places) in ways.items():
        way = np.array([points[grip], *[(x, y, level + 0.02) for x, y in places], (*places[-1], level)])
        times = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))) / 0.15
        goals = (Goal(Chain(points), times[-1], stable=False), Goal(Chain(points), times[-1] + 1.0))
        trial = Trial(name, Chain(points), (Action((Hand('hand', (grip,), times, way),)),), goals)
        initial, *chains = [Chain(chain + random.normal(0, NOISE, chain.shape))
                            for chain in (points, *engine.simulate(trial, physical).chains)]
        trials.append(replace(trial, initial=initial, goals=tuple(
            replace(goal, chain=chain) for goal, chain in zip(goals, chains, strict=True))))
    return trials


@pytest.mark.long
@pytest.mark.parametrize('seed', [8, 12])
def test_the_search_finds_the_right_one_of_many_minima(seed):
    random = np.random.default_rng(seed)
    truth = {'flexibility': random.uniform(55.0, 82.7), 'friction': random.uniform(50, 75)}
    result = calibrate(seen(WAYS, truth, random), Options(
        calibrate=tuple(truth), mass=MASS, engine='compiled', values={'self_collision': 25.0}))
    for name, value in truth.items():
        estimate = result.parameters[name]
        assert estimate.lower <= value <= estimate.upper, (name, value, estimate)


@pytest.mark.long
def test_a_trial_that_a_finer_simulation_leads_elsewhere_is_named(tmp_path):
    """A stiff rope that is bent around a peg and let go snaps back."""
    scene = tmp_path / 'pegs.urdf'
    scene.write_text(PEGS, encoding='utf-8')
    truth = {'flexibility': 57.4, 'friction': 55.9}
    ways = {'snap': (20, [(0.55, 0.12), (0.40, 0.14), (0.30, 0.10)]), 'gentle': WAYS['beside one end']}
    result = calibrate(seen(ways, truth, np.random.default_rng(3), read_scene(str(scene))), Options(
        calibrate=tuple(truth), mass=MASS, engine='compiled', scene=str(scene),
        values={'self_collision': 25.0}))
    named = [warning for warning in result.warnings if 'half the time step' in warning]
    assert [warning.split(':')[0] for warning in named] == ['snap'], result.warnings
