# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Refinement: as many knots of the rest shape and parts as the trials support."""

from dataclasses import replace
from types import SimpleNamespace

from carried_trials import EVEN, observed, POINTS, STIFF_MIDDLE, TRUTH
import numpy as np
import pytest

from dlo_calibration import InputError
from dlo_calibration.calibration.calibrate import fitted
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.refinement import _Ladder, Rung
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import ParameterSpace, stiffness_profile
from dlo_calibration.simulation.compiled import CompiledSimulator

CURVED = ParameterSpace(('flexibility', 'torsion')).shaped(3)
CURVATURES = {'rest_curvature_x1': 56.0, 'rest_curvature_y1': 47.0, 'rest_curvature_x2': 53.0,
              'rest_curvature_y2': 54.0, 'rest_curvature_x3': 46.0, 'rest_curvature_y3': 44.0}
REST_SHAPE = {'flexibility': 58.5, 'torsion': 60.0, 'clamp_twist': 52.0, **CURVATURES}

TAPERED = {**TRUTH, 'stiffness_knot_2': 56.0, 'stiffness_knot_3': 62.0, 'stiffness_knot_4': 70.0,
           'stiffness_knot_5': 76.0}
SMOOTH = ParameterSpace(tuple(TAPERED))

STRANDS = {'flexibility': 61.9231, 'torsion': 60.0, 'bending_friction': 45.0, 'bending_slip': 50.0}


def calibrated(trials, budget=200, names=EVEN.free, parts=0, own=(), sessions='', **rest):
    options = Options(calibrate=names, evaluations=budget, parts=parts, own=own, sessions=sessions)
    return fitted(Setting(tuple(trials), options, CompiledSimulator(table=False, nodes=21), **rest))


@pytest.fixture(scope='module')
def stiff_middle():
    return observed(EVEN.divided(4), STIFF_MIDDLE)


@pytest.fixture(scope='module')
def divided(stiff_middle):
    seen = []
    return calibrated(stiff_middle, on_evaluation=seen.append), seen


@pytest.mark.long
def test_a_dlo_that_is_stiffer_in_the_middle_gets_four_parts(divided):
    # Two parts cannot show it: both have the same stiffness.
    result, _ = divided
    assert result.space.parts == 4
    for name, value in STIFF_MIDDLE.items():
        assert result.values[name] == pytest.approx(value, abs=1.5), name
    assert result.stop_reason.endswith('; 4 parts')  # noise alone explains the rest
    assert result.errors.mean < 2e-3


def test_every_evaluation_counts_and_is_stated_in_the_chosen_parts(divided):
    result, seen = divided
    for evaluations in (result.evaluations, seen):
        assert [evaluation.index for evaluation in evaluations] == list(range(len(seen)))
    assert len(seen) <= 200
    assert {tuple(evaluation.values) for evaluation in result.evaluations} == {result.space.free}
    first = result.evaluations[0].values  # of the even DLO
    assert [first[f'stiffness_{part}'] for part in (2, 3, 4)] == [50, 50, 50]
    assert result.simulations > len(seen) * 4


def test_a_dlo_divided_into_equal_parts_is_the_same_dlo(divided):
    result, seen = divided
    even = result.evaluations[0]
    simulator = CompiledSimulator(table=False, nodes=21)
    again = Evaluator(result.trials, result.space, simulator).evaluate(0, even.point)
    assert again.score == pytest.approx(seen[even.index].score, rel=1e-6)


@pytest.mark.long
def test_an_even_dlo_stays_in_one_part():
    result = calibrated(observed(EVEN, TRUTH))
    assert result.space.free == EVEN.free
    assert result.values == pytest.approx(TRUTH, abs=1.0)
    assert not result.stop_reason.endswith('parts')
    assert result.values == calibrated(observed(EVEN, TRUTH), parts=1).values


@pytest.mark.long
def test_a_rest_shape_is_recovered_where_the_trials_show_it():
    result = calibrated(observed(CURVED, REST_SHAPE, sag=0.6), budget=300, names=('flexibility', 'torsion'))
    assert result.space.knots == 3
    assert result.space.parts == 1
    assert result.errors.mean < 2e-3
    assert 'rest shape with 3 knots' in result.stop_reason
    for name, value in CURVATURES.items():
        assert result.values[name] == pytest.approx(value, abs=2.0), name


@pytest.mark.long
def test_a_straight_dlo_stays_straight():
    straight = {'flexibility': 58.5, 'torsion': 60.0}
    result = calibrated(observed(ParameterSpace(tuple(straight)), straight), names=tuple(straight))
    assert result.space.free == tuple(straight)


@pytest.mark.long
def test_what_the_noise_of_the_starts_does_to_a_stiff_dlo_does_not_bend_it():
    straight, noise = {'flexibility': 40.0, 'torsion': 60.0}, np.random.default_rng(3)
    trials = [replace(trial, initial=Chain(trial.initial.points + noise.normal(0, 5e-4, (POINTS, 3))))
              for trial in observed(ParameterSpace(tuple(straight)), straight)]
    result = calibrated(trials, names=tuple(straight))
    assert result.examination.uncertainty.residual > 3 * 5e-4
    assert result.space.free == tuple(straight)
    assert ';' not in result.stop_reason  # no knots and parts were tried


@pytest.mark.long
def test_a_cable_that_locks_is_found():
    locks = {**STRANDS, 'locking': 62.0}
    result = calibrated(observed(ParameterSpace(tuple(locks)), locks), budget=800, names=tuple(STRANDS))
    assert result.stop_reason.endswith('; it locks; 1 part')
    for name, value in locks.items():
        assert result.values[name] == pytest.approx(value, abs=3.0), name
    assert 'locking' in result.evaluations[0].values  # of the DLO that does not lock
    assert result.evaluations[0].values['locking'] == 0


@pytest.mark.long
def test_a_cable_that_is_curved_and_locks_is_found():
    locks = {**STRANDS, 'locking': 62.0, 'clamp_twist': 52.0, **CURVATURES}
    result = calibrated(observed(ParameterSpace(tuple(locks)), locks), budget=800, names=tuple(STRANDS))
    assert result.space.knots == 3
    for name, value in locks.items():
        assert result.values[name] == pytest.approx(value, abs=1.0), name


@pytest.mark.long
def test_a_dlo_that_stands_askew_in_its_clamps_is_found():
    askew = {**REST_SHAPE, 'clamp_bend_x1': 70.0, 'clamp_bend_y1': 45.0, 'clamp_bend_x2': 40.0,
             'clamp_bend_y2': 72.0}
    result = calibrated(observed(ParameterSpace(tuple(askew)), askew), budget=400,
                        names=('flexibility', 'torsion'))
    assert 'rest shape with 3 knots, bent at its clamps' in result.stop_reason
    for name, value in askew.items():
        assert result.values[name] == pytest.approx(value, abs=4.0), name
    assert result.evaluations[0].values['clamp_bend_x1'] == 50  # of the DLO that stands straight in them


@pytest.mark.long
def test_a_dlo_whose_stiffness_varies_smoothly_is_found():
    result = calibrated(observed(SMOOTH, TAPERED))
    assert result.stop_reason.endswith('; it varies smoothly')
    found, true = (physical['flexibility'] * stiffness_profile(physical)
                   for physical in (result.physical(), SMOOTH.physical(TAPERED, 1.0)))
    assert found[10:] == pytest.approx(true[10:], rel=0.05)  # what is in the first clamp hardly shows
    assert result.evaluations[0].values['stiffness_knot_5'] == 50  # of the even DLO


@pytest.mark.long
def test_stiffness_is_chosen_where_another_parameter_is_at_the_end_of_its_scale():
    result = calibrated(observed(SMOOTH, {**TAPERED, 'damping': 102.0}))
    assert result.values['damping'] == 100
    assert '8 parts' in result.stop_reason


@pytest.fixture(scope='module')
def gripped():
    """Two grips of a DLO, and what they show if it was curved otherwise in the second one."""
    first = observed(CURVED, REST_SHAPE, sag=0.4)
    other = {**REST_SHAPE, **{name: 100.0 - value for name, value in CURVATURES.items()}}

    def sessions(shape):
        again = observed(CURVED, shape, sag=0.4)
        return *first, *(replace(trial, name=f'again {trial.name}', session=2) for trial in again)
    return other, sessions(other), sessions(REST_SHAPE)


@pytest.mark.long
def test_a_dlo_that_changed_between_two_grips_has_a_rest_shape_in_each(gripped):
    other, trials, _ = gripped
    result = calibrated(trials, 600, CURVED.free[:2], own=('rest_shape',), sessions='4 4')
    assert 'rest shape with 3 knots, another one in each session' in result.stop_reason
    for shape, session in ((REST_SHAPE, ''), (other, '_session_2')):
        for name in CURVATURES:
            estimate = result.estimates[name + session]
            assert estimate.lower <= shape[name] <= estimate.upper, name
    together = calibrated(trials, 600, CURVED.free[:2])
    assert result.errors.mean < 0.3 * together.errors.mean


def test_sessions_without_clamps_have_no_rest_shape_and_the_outcome_says_so(stiff_middle):
    again = [replace(trial, session=2) for trial in stiff_middle]
    result = calibrated((*stiff_middle, *again), 60, own=('rest_shape',), sessions='4 4')
    assert 'no rest shape: only trials that all begin between two clamps show one' in result.stop_reason


@pytest.mark.parametrize('option', [{'parts': 1}, {'names': ('damping',)}])
def test_rest_shapes_of_sessions_that_nothing_would_choose_are_refused(stiff_middle, option):
    with pytest.raises(InputError, match='parameter own: rest_shape.*expected search least_squares'):
        calibrated(stiff_middle, 60, own=('rest_shape',), sessions='2 2', **option)


def test_the_outcome_says_that_noise_explains_what_rest_shapes_might():
    result = calibrated(observed(EVEN, TRUTH), own=('rest_shape',), sessions='2 2')
    assert result.stop_reason.endswith('; one rest shape: noise alone explains the residuals')


@pytest.mark.long
def test_a_dlo_that_is_the_same_in_two_grips_has_one_rest_shape(gripped):
    *_, trials = gripped
    result = calibrated(trials, 600, CURVED.free[:2], own=('rest_shape',), sessions='4 4')
    assert 'in each session' not in result.stop_reason
    assert set(result.space.free) == {'flexibility', 'torsion', 'clamp_twist', *CURVATURES}


@pytest.mark.long
def test_a_rod_whose_errors_have_another_cause_does_not_lock():
    damped = {'flexibility': 61.9, 'torsion': 60.0, 'damping': 65.0}
    result = calibrated(observed(ParameterSpace(tuple(damped)), damped), budget=800, names=tuple(STRANDS))
    assert result.errors.mean > 4e-3  # much more than noise
    assert 'locking would' in result.stop_reason
    assert 'locking' not in result.values


@pytest.mark.parametrize('first, kept', [((-0.8, -0.6, -0.3, 0.5), 3), ((0.1, 0.1, 0.1, 0.1), 0)])
def test_rungs_that_predict_better_but_not_significantly_do_not_end_a_climb(monkeypatch, first, kept):
    assert climbed(monkeypatch, np.zeros(4), np.array(first), np.array(first), np.full(4, -1.0)) == kept


@pytest.mark.parametrize('finer, kept', [((-0.8, -0.6, -0.3, 0.5), 2), ((0.1, 0.1, 0.1, 0.1), 1)])
def test_once_a_rung_is_kept_a_finer_one_need_only_predict_better_in_the_mean(monkeypatch, finer, kept):
    assert climbed(monkeypatch, np.zeros(4), np.full(4, -1.0), np.array(finer) - 1, np.zeros(4)) == kept


def climbed(monkeypatch, *logarithms):
    """Return which rung a climb keeps, from the logarithms of the errors of each."""
    rungs = [SimpleNamespace(space=EVEN, best=SimpleNamespace(point=None), evaluations=(), validated=0,
                             errors=np.exp(logarithm), explained=lambda level: False)
             for logarithm in logarithms]
    ladder = _Ladder(Setting(tuple(observed(EVEN, TRUTH)), Options(), None), rungs[0], 100, 1e-3)
    coming = iter(rungs[1:])
    monkeypatch.setattr(ladder, '_fitted', lambda *arguments: next(coming))
    monkeypatch.setattr(ladder, '_fold_errors', lambda rung: rung.errors)
    ladder.climb([Rung(str(count), lambda space, point, count=count: (replace(space, mass=count), point))
                  for count in (3, 5, 9)])
    return [rung is ladder.best for rung in rungs].index(True)


@pytest.mark.long
def test_a_small_budget_leaves_the_dlo_even_and_says_so(stiff_middle):
    result = calibrated(stiff_middle, budget=13)
    assert result.space.free == EVEN.free
    assert len(result.evaluations) <= 13
    assert result.stop_reason.endswith('1 part: the rest of the budget is too small to try 2')


def test_one_trial_cannot_be_cross_validated_so_the_dlo_stays_even(stiff_middle):
    assert calibrated(stiff_middle[:1], budget=30).space.free == EVEN.free


def test_a_stop_gives_the_parts_so_far(stiff_middle, divided):
    even = next(k for k, evaluation in enumerate(divided[1]) if 'stiffness_2' in evaluation.values)
    seen = []
    result = calibrated(stiff_middle, on_evaluation=seen.append, should_stop=lambda: len(seen) > even + 3)
    assert result.space.free == EVEN.free
    assert len(result.evaluations) == len(seen) == even + 4
    assert result.stop_reason.endswith('1 part: stopped before 4 were fitted')
