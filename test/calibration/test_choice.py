# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The options that the trials decide where the user leaves them open."""

from contextlib import closing
from dataclasses import replace
import sys

import numpy as np
import pytest
from toy_messages import toy_trials
from toy_simulator import new_toy

from dlo_calibration import Action, calibrate, Chain, Goal, Hand, Options, Trial
from dlo_calibration.calibration.choice import (
    BETWEEN_CLAMPS,
    choose,
    IN_MOTION,
    may_lock,
    PAPER_ROUNDS,
    REFINEMENT,
    VALLEYS,
)
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.experiment.study import Observed
from dlo_calibration.files.result import read_result, write_result
from dlo_calibration.model.parameters import PAPER_PARAMETERS
from dlo_calibration.report.terminal import print_result
from dlo_calibration.workspace.folder import calibration_digest
from dlo_calibration.workspace.live_information import LiveInformation

ALL = (*PAPER_PARAMETERS, *IN_MOTION, *BETWEEN_CLAMPS)
QUICK = Options(nodes=16, engine='compiled', workers=1, table=False, mass=0.03)
TRUTH = {'flexibility': 61.9, 'damping': 60.0, 'internal_damping': 40.0, 'torsion': 70.0}


def stream():
    """Return a trial in which two clamps come together, turn and rise, with goals in motion."""
    points = np.stack([np.linspace(0, 0.6, 13), np.zeros(13), np.ones(13)], axis=1)
    times, half = np.linspace(0, 1.2, 7), np.linspace(0, 1.2, 7) / 2
    turn = np.stack([np.sin(half), 0 * half, 0 * half, np.cos(half)], axis=1)  # about the DLO
    left = Hand('left', (0, 1), times, points[0] + np.outer(times, [0.1, 0.05, 0.0]), turn)
    right = Hand('right', (11, 12), times, points[11] + np.outer(times, [-0.15, 0.0, 0.1]))
    return Trial('between', Chain(points), (Action((left, right)),), tuple(
        Goal(Chain(points), float(time), False) for time in np.linspace(0.1, 1.2, 6)))


def in_motion():
    """Return a trial of the toy with a goal in motion."""
    trial, = toy_trials(1)
    return replace(trial, goals=(replace(trial.goals[0], time=trial.hands[0].end, stable=False),))


def test_trials_at_rest_give_the_papers_four_and_the_same_result():
    trials, options = toy_trials(2), Options(workers=1)
    choice = choose(trials, options)
    assert (choice.options.calibrate, choice.options.evaluations) == (
        PAPER_PARAMETERS, PAPER_ROUNDS + VALLEYS + REFINEMENT)
    assert choice.words == ('Calibrated: flexibility, elasticity, friction, self_collision; '
                            'not damping, internal_damping, because no goal was seen in motion.')
    auto, named = (calibrate(trials, replace(each, evaluations=20), make_simulator=new_toy)
                   for each in (options, choice.options))
    assert [evaluation.score for evaluation in auto.evaluations] == [
        evaluation.score for evaluation in named.evaluations]
    assert auto.parameters == named.parameters
    assert named.choice.words == ''


def test_motion_adds_parameters_and_the_result_says_why(tmp_path, capsys):
    trials, options = [*toy_trials(1), in_motion()], Options(workers=1, evaluations=20)
    result = calibrate(trials, options, make_simulator=new_toy)
    assert tuple(result.parameters) == (*PAPER_PARAMETERS, *IN_MOTION)
    assert 'damping, internal_damping, because goals were seen in motion' in result.choice.words
    print_result(result, sys.stdout)
    assert result.choice.words in ' '.join(capsys.readouterr().out.split())
    write_result(tmp_path / 'result.xml', result, options.flat())
    file = read_result(tmp_path / 'result.xml')
    assert file.choice == result.choice.words
    assert file.file_options.values['calibrate'] == [*PAPER_PARAMETERS, *IN_MOTION]
    again = calibrate(trials, replace(file.file_options.options(), workers=1), make_simulator=new_toy)
    assert again.parameters == result.parameters


def test_a_motion_between_two_clamps_adds_torsion_and_friction_between_strands():
    choice = choose([stream()], Options())
    assert choice.options.calibrate == ALL
    assert f'{", ".join(BETWEEN_CLAMPS)}, because a motion between two clamps was seen' in choice.words


def test_names_and_numbers_that_are_given_stay():
    options = Options(calibrate=('friction',), evaluations=7)
    assert choose([stream()], options) == choose([], options)
    assert choose([stream()], options).options is options


def test_more_parameters_get_more_evaluations():
    def most(**given):
        return choose(toy_trials(2), Options(**given)).options.evaluations

    assert most(parts=1) == most(calibrate='friction') == most(parts=2) == 250
    assert most(parts=8) > 250
    assert most() > most(parts=8)
    assert most(search='random') == most(search='cma_es') == 150


def test_only_a_dlo_of_strands_may_lock():
    assert not may_lock(choose(toy_trials(2), Options()).options.space)
    trials = [stream(), replace(stream(), name='again')]
    choice = choose(trials, Options()).options
    assert may_lock(choice.space) and choice.evaluations == (
        PAPER_ROUNDS + VALLEYS + 2 * REFINEMENT)
    for locking in ({'calibrate': (*ALL, 'locking')}, {'calibrate': ALL, 'locking': 30.0}):
        assert not may_lock(Options.of(locking).space)


def test_a_log_serves_the_names_that_auto_stands_for():
    trials = toy_trials(2)
    assert calibration_digest(trials, Options()) == calibration_digest(
        trials, Options(calibrate=PAPER_PARAMETERS, evaluations=PAPER_ROUNDS + VALLEYS + REFINEMENT))


def test_trials_are_appraised_with_the_parameters_that_they_show():
    live = LiveInformation(new_toy)
    live.start([in_motion()], Options(workers=1))
    assert live.join(60)
    information, = live.waiting_information()
    assert information.names == (*PAPER_PARAMETERS, *IN_MOTION)


def test_an_experiment_finds_the_same_parameters_whichever_trial_is_left_out():
    observed = Observed((*toy_trials(2), in_motion()), Options())
    assert observed.options.calibrate == (*PAPER_PARAMETERS, *IN_MOTION)


@pytest.mark.long
def test_a_stream_between_clamps_gives_its_parameters_back():
    draft = stream()
    others = {name: 25.0 if name == 'elasticity' else 50.0 for name in PAPER_PARAMETERS}
    options = replace(QUICK, calibrate=ALL)
    with closing(make_simulator(options)) as simulator:
        physical = options.space.physical({**others, **TRUTH}, draft.initial.length)
        seen = simulator.simulate(draft, physical).chains
    noise = np.random.default_rng(1).normal(0, 1e-4, seen.shape)
    trial = replace(draft, goals=tuple(
        replace(goal, chain=Chain(points)) for goal, points in zip(draft.goals, seen + noise, strict=True)))
    result = calibrate([trial], QUICK)
    assert tuple(result.parameters) == ALL
    for name, value in TRUTH.items():
        estimate = result.parameters[name]
        assert estimate.value == pytest.approx(value, abs=5), name
        assert estimate.lower < value < estimate.upper, name
