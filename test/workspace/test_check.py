# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Whether a session still shows the DLO of a result, with an engine that knows the truth."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from toy_simulator import new_toy, toy_trial, ToySimulator

from dlo_calibration import Chain, Options
from dlo_calibration.calibration.calibrate import fitted
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.files.result import Description
from dlo_calibration.model.parameters import BY_NAME
from dlo_calibration.workspace.check import AGREES, CANNOT_TELL, checked, HAS_CHANGED, plain_check

TRUTH = {'flexibility': 40.0, 'elasticity': 50.0, 'friction': 60.0, 'self_collision': 30.0}
NOISE = 1.5e-3  # m; 90 % intervals of EI are 6 % to either side


def session(seed, **changed):
    """Return noisy trials of the DLO, of which physical values may be larger by a factor."""
    values = {**TRUTH, **{name: BY_NAME[name].value(factor * BY_NAME[name].physical(TRUTH[name]))
                          for name, factor in changed.items()}}
    generator = np.random.default_rng(seed)
    return [replace(trial, goals=tuple(replace(goal, chain=Chain(
        goal.chain.points + generator.normal(0, NOISE, goal.chain.points.shape))) for goal in trial.goals))
        for trial in (toy_trial(values, f'trial {k}', turn=0.5 * k) for k in range(1, 4))]


@cache
def result():
    """Return the result for one session."""
    return Description.of(fitted(Setting(tuple(session(0)), Options(workers=1), ToySimulator())))


def check(trials, file=None):
    """Return the check of a session."""
    return checked(file or result(), trials, Options(workers=1), new_toy)


def named(found):
    """Return the names of the parameters that are said to have changed."""
    return [name for name, parameter in plain_check(found)['parameters'].items() if parameter.get('changed')]


@pytest.mark.parametrize(('name', 'factor'), [('flexibility', 1.2), ('flexibility', 0.8), ('friction', 1.2)])
def test_a_changed_parameter_is_named(name, factor):
    found = check(session(7, **{name: factor}))
    assert found.verdict == HAS_CHANGED
    assert named(found) == [name]
    change = BY_NAME[name].value(factor * BY_NAME[name].physical(TRUTH[name])) - TRUTH[name]
    told = plain_check(found)['parameters'][name]
    assert told['lower'] < change < told['upper']
    assert any(f'{name} has changed' in words for words in found.words)


@pytest.mark.long
def test_the_same_dlo_agrees():
    found = check(session(8))
    assert found.verdict == AGREES
    assert plain_check(found)['probability_of_agreement'] > 0.03
    assert named(found) == []


@pytest.mark.long
def test_false_alarms_and_changes_that_are_missed_are_rare():
    """At most 8 of 100 unchanged sessions are called changed; 90 of 100 changes are found and named."""
    files = [Description.of(fitted(Setting(tuple(session(seed)), Options(workers=1), ToySimulator())))
             for seed in range(100, 110)]

    def verdicts(**changed):
        return [(found.verdict, named(found)) for found in (
            check(session(1000 + 17 * k, **changed), files[k % 10]) for k in range(100))]

    assert sum(verdict == HAS_CHANGED for verdict, _ in verdicts()) <= 8
    for name, factor in (('flexibility', 1.2**(6.5 / 4.5)), ('friction', 1.2)):  # the toy shows 0..100
        assert sum(each == (HAS_CHANGED, [name]) for each in verdicts(**{name: factor})) >= 90


@cache
def result_of_two_tables():
    """Return the result for a session on each of two tables."""
    other = [replace(trial, session=2) for trial in session(1, friction=1.3)]
    options = Options(workers=1, own=('friction',), sessions='3 3')
    return Description.of(fitted(Setting((*session(0), *other), options, ToySimulator())))


def test_what_sessions_have_for_themselves_may_change():
    file = result_of_two_tables()
    assert 'friction_session_2' in file.parameters
    found = check(session(7, friction=0.8), file)
    assert found.verdict == AGREES
    assert not any('friction' in words for words in found.words)
    assert any('friction: each session' in warning for warning in found.validation.warnings)
    assert named(check(session(7, friction=0.8, flexibility=1.25), file)) == ['flexibility']


def test_the_session_of_two_tables_has_the_values_of_both():
    other = [replace(trial, session=2) for trial in session(1, friction=1.3)]
    validation = check((*session(0), *other), result_of_two_tables()).validation
    assert 'friction_session_2' in validation.space.free
    assert not any('friction' in warning for warning in validation.warnings)


def test_another_length_is_another_dlo():
    longer = [replace(trial, initial=Chain(1.3 * trial.initial.points)) for trial in session(8)]
    found = check(longer)
    assert found.verdict == HAS_CHANGED
    assert 'long' in found.words[0]
    assert plain_check(found)['probability_of_agreement'] is None


def test_what_no_parameter_explains_has_changed():
    trials = [replace(trial, goals=tuple(replace(goal, chain=Chain(
        goal.chain.points + 0.05 * np.sin(9 * np.linspace(0, np.pi, 11))[:, None])) for goal in trial.goals))
        for trial in session(8)]
    found = check(trials)
    assert found.verdict == HAS_CHANGED
    assert named(found) == []
    assert 'No parameter explains' in found.words[0]


def test_an_unusable_result_is_not_compared():
    found = check(session(8), replace(result(), unusable='the frames differ'))
    assert found.verdict == CANNOT_TELL
    assert 'the frames differ' in found.words[0]
