# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Measured forces on hands: with them, mass and stiffnesses are known without scales."""

from dataclasses import replace

from felt_trials import felt_trials, LIFTS, ROPE
import numpy as np
import pytest

from dlo_calibration import calibrate, Options
from dlo_calibration.calibration.forces import heavier
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.observation.plausibility import implausible_trials
from dlo_calibration.report.sentences import sentences

# With less damping, the taut rope would still swing when it is seen.
SOFT = {**ROPE, 'elasticity': 30.0, 'damping': 5.0}
PULL = [((0,), (-0.05, 0, 0.3)), ((20,), (0.03, 0, 0.3))]  # stretches the rope
OFFSET = np.array([0.3, -0.2, -2.0])  # N


def calibrated(trials, **options):
    return calibrate(trials, Options(**{'seed': 1, 'workers': 1, **options}))


def holds(result, name, truth):
    estimate = result.parameters[name]
    return estimate.physical_lower <= truth <= estimate.physical_upper


def with_forces(trials, change):
    """Return trials with other forces; `change` takes one and returns those in its place."""
    return tuple(replace(trial, goals=tuple(
        replace(goal, forces=tuple(other for force in goal.forces for other in change(force)))
        for goal in trial.goals)) for trial in trials)


@pytest.fixture(scope='module')
def pulled():
    """Give two trials; in the second, two hands stretch the rope."""
    return felt_trials(2, SOFT, lifts=(LIFTS[0], PULL))


@pytest.mark.long
def test_forces_tell_mass_and_stiffnesses_that_nobody_told(pulled):
    result = calibrated(pulled)
    assert not result.unusable
    assert 'mass, because forces on the hands were measured' in result.choice.words
    for name in ('mass', 'flexibility', 'elasticity'):
        assert holds(result, name, SOFT[name]), result.parameters[name]
        assert result.parameters[name].identifiable
    assert (result.parameters['flexibility'].physical_unit, result.parameters['mass'].physical_unit) == (
        'N m^2', 'kg')
    assert np.linalg.norm(result.force_error) == pytest.approx(0.02 * 3**0.5, rel=0.3)
    words, = (text for text in sentences(result) if 'measured forces' in text)
    assert words.startswith('6 measured forces on hands are 0.0')
    assert 'they tell the mass, and so stiffnesses absolutely' in words


def test_a_heavier_dlo_has_its_stiffnesses_in_proportion():
    space = ParameterSpace(('flexibility', 'elasticity', 'friction', 'mass'))
    values = {'flexibility': 80.0, 'elasticity': 40.0, 'friction': 60.0, 'mass': 50.0}
    before, after = (space.physical(space.values(point), 0.6) for point in (
        space.point(values), heavier(space, space.point(values), 2.0)))
    ratios = {name: after[name] / before[name] for name in space.free}
    assert ratios == pytest.approx({'flexibility': 2.0, 'elasticity': 2.0, 'friction': 1.0, 'mass': 2.0})


@pytest.mark.long
def test_with_a_mass_forces_still_tell_the_stretching_stiffness(pulled):
    result = calibrated(pulled, mass=SOFT['mass'])
    assert 'mass' not in result.parameters
    assert holds(result, 'elasticity', SOFT['elasticity'])


@pytest.mark.long
def test_without_forces_nothing_changes(pulled):
    result = calibrated(with_forces(pulled, lambda force: []))
    assert 'mass' not in result.parameters
    assert result.parameters['flexibility'].physical_unit == 'N m^2 per N/m'
    assert np.isnan(result.force_error).all()


def test_a_reversed_sign_is_refused_with_a_sentence(pulled):
    assert implausible_trials(pulled, 0.0) == ()
    first, second = implausible_trials(
        with_forces(pulled, lambda force: [replace(force, vector=-force.vector)]), 0.0)
    assert first.startswith('trial 1: forces that push the hands up by')
    assert 'reverse the sign' in second


@pytest.mark.long
def test_the_weight_of_forces_follows_from_their_own_noise():
    weights = [calibrated(felt_trials(1, lifts=LIFTS[:2], force_noise=noise)).trials[0].force_scale[2]
               for noise in (0.01, 0.3)]
    assert weights[0] > 5 * weights[1]


@pytest.mark.long
@pytest.mark.parametrize('offset', [None, OFFSET], ids=['tared', 'unknown offset'])
def test_intervals_hold_the_truth_in_most_of_many_sessions(offset):
    held, widths = {'mass': [], 'flexibility': []}, []
    for seed in range(1, 13):
        result = calibrated(felt_trials(seed, offset=offset))
        for name, hits in held.items():
            hits.append(holds(result, name, ROPE[name]))
        mass = result.parameters['mass']
        widths.append(mass.physical_upper / mass.physical_lower)
    assert all(sum(hits) >= 10 for hits in held.values()), held
    assert np.median(widths) < (1.5 if offset is None else 12)
