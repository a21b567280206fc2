# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""DLOs of all sizes, from 1 cm to 15 m: thick and stiff ones are on the scale, thin ones with a remedy."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_calibration import Action, calibrate, Chain, Goal, Hand, Options, Trial
from dlo_calibration.model.parameters import BY_NAME, GRAVITY, ParameterSpace
from dlo_calibration.simulation.compiled import CompiledSimulator

LIFT = np.array([(0, 0, 0), (0, 0, 0.35), (0.05, 0.05, 0.35)])
DRAG = np.array([(0, 0, 0), (0.1, 0.15, 0.0), (0.1, 0.3, 0.0)])
#: Grips of a hand, its path in lengths of the DLO, and whether it holds the DLO at the end.
ACTIONS = (((0, 1), LIFT, True), ((19, 20), LIFT * [-1, 1, 0.7], True),
           ((5,), DRAG * [-1, 1, 1], False), ((15,), DRAG, False))
#: Length [m], mass [kg], EI [N m^2], radius [m], EA [N]
HOSE, CABLE = (2.0, 1.0, 2.0, 0.012, 5e3), (1.5, 0.9, 0.14, 0.01, 5e3)
SUTURE, HAIR = (0.1, 8e-6, 1e-6, 1.5e-4, 170.0), (0.01, 2e-6, 1e-9, 1e-4, 10.0)
LONG_HOSE = (15.0, 7.5, 8.0, 0.012, 5e3)


def seen(thing, actions=ACTIONS):
    """Return trials with 0.03 % of the length as noise, from finer nodes and steps than a fit has."""
    length, mass, bending, radius, stretching = thing
    along, generator = np.linspace(0, length, 21), np.random.default_rng(1)
    points = np.stack([along, 0.03 * length * np.sin(6 * along / length), 0 * along + radius], axis=1)
    physical = {**ParameterSpace(mass=mass).physical({}, length), 'flexibility': bending,
                'elasticity': stretching, 'self_collision': radius}
    simulator = CompiledSimulator(nodes=61, time_step=1e-3 * min(4.0, (length / 0.6)**0.5))
    second, trials = max(1.0, length), []
    for grips, way, held in actions:
        start = points[grips[0]] if len(grips) == 1 else 0.0
        hand = Hand('hand', grips, np.arange(3) * second, start + length * way)
        goal = Goal(Chain(points), 2 * second + 3, held_by=('hand',) if held else ())
        trial = Trial(f'trial {len(trials) + 1}', Chain(points), (Action((hand,)),), (goal,))
        chain = simulator.simulate(trial, physical).chains[0]
        noisy = [Chain(each + generator.normal(0, 3e-4 * length, each.shape)) for each in (points, chain)]
        trials.append(replace(trial, initial=noisy[0], goals=(replace(goal, chain=noisy[1]),)))
    return trials


def fit(thing, mass, actions=ACTIONS, **options):
    return calibrate(seen(thing, actions), Options(
        mass=mass, engine='compiled', workers=1, seed=1, **options))


@pytest.mark.long
@pytest.mark.parametrize('thing', [pytest.param(HOSE, id='hose'), pytest.param(CABLE, id='20 mm cable')])
def test_the_stiffness_of_a_thick_thing_is_recovered(thing):
    values = {'elasticity': BY_NAME['elasticity'].value(thing[4]),
              'self_collision': BY_NAME['self_collision'].value(thing[3])}
    result = fit(thing, thing[1], ACTIONS[:1], calibrate=('flexibility',), values=values)
    found = result.parameters['flexibility']
    assert found.identifiable and not result.unusable
    assert found.physical_value == pytest.approx(thing[2], rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize('thing, times, time_step', [
    pytest.param(HOSE, 1, 4e-3, id='hose'), pytest.param(SUTURE, 0, 1e-3, id='suture of unknown mass'),
    pytest.param(SUTURE, 1000, 1e-3, id='suture'), pytest.param(HAIR, 1e5, 3e-4, id='hair of 1 cm'),
    pytest.param(LONG_HOSE, 1, 4e-3, id='hose of 15 m')])
def test_the_stiffness_of_a_thing_of_any_size_is_in_its_interval(thing, times, time_step):
    """Given a mass that is `times` its own, its stiffness is found as many times as large."""
    result = fit(thing, times * thing[1], time_step=time_step)
    found = result.parameters['flexibility']
    truth = thing[2] * (times or thing[0] / (thing[1] * GRAVITY))
    assert not result.unusable
    assert found.verdict != 'not identifiable'
    assert found.physical_lower < truth < found.physical_upper
    assert found.physical_value == pytest.approx(truth, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize('thing, mass, words', [
    (SUTURE, SUTURE[1], 'give a mass of 0.008 kg, 1000 times its own, and divide all stiffnesses by 1000'),
    (HAIR, 0.0, 'times what is assumed, and divide all stiffnesses by its weight')])
def test_a_stiffness_beyond_the_scale_is_refused_with_the_remedy(thing, mass, words):
    result = fit(thing, mass, time_step=1e-3 if thing is SUTURE else 3e-4)
    assert 'beyond the end of its scale' in result.unusable
    assert words in result.unusable
