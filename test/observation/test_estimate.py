# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What chains alone say of the parameters: the truth is in the range, and the range is no tautology."""

import os
from pathlib import Path

import numpy as np
import pytest
from rods_at_rest import hung, LENGTH, observed, trial_of

from dlo_calibration.files.session import read_session
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace
from dlo_calibration.model.trial import Goal, Trial
from dlo_calibration.observation.estimate import prior_estimates
from dlo_calibration.observation.noise import noise

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get('DLO_DATA', ROOT / '../shared/data'))
MASS = 0.03
SPACE = ParameterSpace(mass=MASS)
MILLIMETRE = 1e-3
CLAMP = {0: (0, 0, 1), 1: (0.01, 0, 1)}

#: EI [N m^2], EA [N], friction, radius [m] of msg_samples/README.md
OBJECTS = {'object1': (1e-4, 300, 0.4, 0.004), 'object2': (2e-3, 800, 0.5, 0.007),
           'object3': (1e-5, 100, 0.3, 0.0025), 'object4': (3e-4, 4, 0.6, 0.003),
           'object5': (2e-2, 3000, 0.5, 0.01)}
NAMES = ('flexibility', 'elasticity', 'friction', 'self_collision')


def on_scale(name, physical):
    return float(np.clip(BY_NAME[name].value(physical), 0, 100))


def sample(name):
    session = read_session(ROOT / 'msg_samples' / name)
    return session.trials, ParameterSpace(mass=session.options.mass)


@pytest.fixture(scope='module', params=OBJECTS)
def reference(request):
    trials, space = sample(request.param)
    return trials, prior_estimates(trials, space, 0.0), dict(zip(NAMES, OBJECTS[request.param], strict=True))


def test_ranges_of_the_reference_objects_hold_the_truth(reference):
    _, estimates, truth = reference
    for name, estimate in estimates.items():
        assert estimate.lower <= on_scale(name, truth[name]) <= estimate.upper, estimate


def test_flexibility_of_the_reference_objects_is_near_the_truth(reference):
    _, estimates, truth = reference
    flexibility = estimates['flexibility']
    assert flexibility.value == pytest.approx(on_scale('flexibility', truth['flexibility']), abs=10)
    assert flexibility.upper - flexibility.lower < 45


def test_radius_of_the_reference_objects_is_their_height_above_the_table(reference):
    _, estimates, truth = reference
    assert estimates['self_collision'].value == pytest.approx(
        on_scale('self_collision', truth['self_collision']), abs=5)


def test_friction_of_the_reference_objects_is_roughly_known(reference):
    _, estimates, truth = reference
    assert estimates['friction'].value == pytest.approx(
        on_scale('friction', truth['friction']), abs=20)


def test_noise_of_the_reference_objects_is_known(reference):
    assert noise(reference[0]) == pytest.approx(MILLIMETRE, rel=0.15)


@pytest.mark.parametrize('bending', [1e-3, 1e-2, 5e-2])
@pytest.mark.parametrize('seed', range(5))
def test_range_of_a_cantilever_holds_the_truth(bending, seed):
    goal = observed(hung(bending, CLAMP), 31, MILLIMETRE, seed)
    estimate = prior_estimates([trial_of(goal, [(0, 1)])], SPACE, None)['flexibility']
    assert estimate.lower <= on_scale('flexibility', bending) <= estimate.upper
    assert estimate.upper - estimate.lower < 73


def test_more_stretch_is_more_elastic():
    values = [prior_estimates([trial_of(observed(hung(1e-4, {0: (0, 0, 1)}, 1.0, stretching), 31), [(0,)])],
                      ParameterSpace(mass=1.0), None)['elasticity'] for stretching in (60.0, 5e3)]
    for estimate, truth in zip(values, (60.0, 5e3), strict=True):
        assert estimate.lower <= on_scale('elasticity', truth) <= estimate.upper
    assert values[0].lower > 40 and values[0].value == pytest.approx(on_scale('elasticity', 60.0), abs=15)
    assert values[1].upper < 80 and np.isnan(values[1].value)


def changed(trial, change):
    goals = tuple(Goal(Chain(change(goal.chain.points)), goal.time, goal.stable, goal.held_by)
                  for goal in trial.goals)
    return Trial(trial.name, Chain(change(trial.initial.points)), trial.actions, goals)


TURN = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])


@pytest.mark.parametrize('change', [lambda p: p @ TURN, lambda p: p + [3, -2, 0], lambda p: p * [1, -1, 1]],
                         ids=['turned', 'moved', 'mirrored'])
def test_the_frame_does_not_matter(change):
    trials, space = sample('object1')
    before = prior_estimates(trials, space, 0.0)
    after = prior_estimates([changed(trial, change) for trial in trials], space, 0.0)
    for name, estimate in before.items():
        other = after[name]
        assert (other.value, other.lower, other.upper) == pytest.approx(
            (estimate.value, estimate.lower, estimate.upper), abs=0.5, nan_ok=True)


def test_the_order_of_the_points_does_not_matter():
    goal = observed(hung(1e-2, CLAMP), 31, MILLIMETRE)
    first = trial_of(goal, [(0, 1)])
    turned = trial_of(goal[::-1], [(30, 29)], first.initial.points[::-1])
    forward, backward = (prior_estimates([trial], SPACE, None)['flexibility'] for trial in (first, turned))
    assert backward.value == pytest.approx(forward.value, abs=0.5)


def test_a_heavier_dlo_of_that_shape_is_stiffer():
    trials = [trial_of(observed(hung(1e-3, CLAMP), 31), [(0, 1)])]
    light, heavy = (prior_estimates(trials, ParameterSpace(mass=mass), None)['flexibility']
                    for mass in (MASS, 10 * MASS))
    assert light.value - heavy.value == pytest.approx(100 / 6.5)


def test_stiffness_is_not_estimated_if_the_mass_is_free():
    trials = [trial_of(observed(hung(1e-3, CLAMP), 31), [(0, 1)])]
    estimates = prior_estimates(trials, ParameterSpace(free=('flexibility', 'mass')), None)
    assert (estimates['flexibility'].lower, estimates['flexibility'].upper) == (0, 100)
    assert (estimates['mass'].lower, estimates['mass'].upper) == (0, 100)


@pytest.mark.parametrize('count', [3, 4, 6])
@pytest.mark.parametrize('table_height', [None, 0.0, 1.0])
def test_few_points_give_finite_ranges(count, table_height):
    goal = observed(hung(1e-3, CLAMP), count, MILLIMETRE)
    for estimate in prior_estimates([trial_of(goal, [(0,)])], SPACE, table_height).values():
        assert 0 <= estimate.lower <= estimate.upper <= 100


def test_a_moving_dlo_gives_no_estimate_of_stiffness():
    goal = observed(hung(1e-3, CLAMP), 31)
    estimate = prior_estimates([trial_of(goal, [(0, 1)], stable=False)], SPACE, None)['flexibility']
    assert (estimate.lower, estimate.upper) == (0, 100) and np.isnan(estimate.value)


def test_a_bend_on_the_table_bounds_stiffness_by_friction():
    angle = np.linspace(0, 3, 31)
    bent = 0.1 * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle + 0.05], axis=1)
    estimates = prior_estimates([trial_of(bent, None, bent)], SPACE, 0.0)
    assert estimates['flexibility'].lower > 20 and estimates['flexibility'].upper == 100
    straight = np.stack([np.linspace(0, LENGTH, 31), 0 * angle, 0 * angle + 0.005], axis=1)
    assert prior_estimates([trial_of(straight, None, straight)], SPACE, 0.0)['flexibility'].lower == 0


def test_nearby_strands_bound_the_radius():
    angle = np.linspace(0, np.pi, 16)
    legs = np.linspace(0.2, 0, 12)[:-1]
    hairpin = np.concatenate([
        np.stack([-legs, 0 * legs, 0 * legs], axis=1),
        0.006 * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1),
        np.stack([-legs[::-1], 0.012 + 0 * legs, 0 * legs], axis=1)]) + [0, 0, 0.004]
    estimate = prior_estimates([trial_of(hairpin, None, hairpin)], SPACE, 0.0)['self_collision']
    assert on_scale('self_collision', 0.006) <= estimate.upper < on_scale('self_collision', 0.012)


@pytest.mark.parametrize('name', ['white', 'black'])
def test_ranges_of_hanging_wires_hold_the_published_stiffness(name):
    file = DATA / 'hanging' / f'{name}.npz'
    if not file.is_file():
        pytest.skip(f'{file} is not there; DLO_DATA names the folder of measured data')
    with np.load(file) as wire:
        points, published = wire['points'].astype(float), wire['published_EI']
        length, mass = float(wire['length_m']), float(wire['length_m'] * wire['mass_per_m'])
    spacing = np.array([length / 50, 0, 0])
    trials = []
    for repeat in points:
        clamped = np.concatenate([[repeat[0] - spacing], repeat, [repeat[-1] + spacing]])
        trials.append(trial_of(clamped, [(0, 1), (51, 52)], length=length * 52 / 50))
    estimate = prior_estimates(trials, ParameterSpace(mass=mass * 52 / 50), None)['flexibility']
    for stiffness in published:
        assert estimate.lower <= on_scale('flexibility', stiffness) <= estimate.upper
    assert estimate.upper - estimate.lower < 40
