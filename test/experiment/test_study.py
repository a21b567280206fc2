# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The experiment: its calibrations, their outcomes, and the journal."""

from concurrent.futures import CancelledError
from dataclasses import replace
import json

import numpy as np
import pytest
from toy_messages import toy_trials, TRUTH
from toy_simulator import ToySimulator

from dlo_calibration.calibration.calibrate import calibrate
from dlo_calibration.calibration.choice import PAPER_ROUNDS, REFINEMENT, VALLEYS
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.experiment.journal import Journal
from dlo_calibration.experiment.study import (
    judged_chains,
    Judgement,
    Observed,
    Outcome,
    perform,
    Study,
    Subject,
    Task,
)
from dlo_calibration.model.parameters import BY_NAME
from dlo_calibration.model.trial import Trial

OPTIONS = Options.of({'evaluations': 40})


def toy(options):
    return ToySimulator()


def subject(count=3, held_back=None, others=None, options=OPTIONS, name='rope'):
    held = tuple(range(count)) if held_back is None else held_back
    return Subject(name, Observed(tuple(toy_trials(count)), options), held, others)


def task(left_out=None, search='random', seed=1, engine='toy', **about):
    return Task(subject(**about), search, seed, engine, left_out)


def test_each_search_has_a_number_of_evaluations_of_its_own():
    for search, most in (('random', PAPER_ROUNDS), ('least_squares', PAPER_ROUNDS + VALLEYS + REFINEMENT)):
        for left_out in (None, 0):
            options = task(left_out, search, 7, options=Options()).options
            assert (options.search, options.seed, options.evaluations) == (search, 7, most)


def test_every_run_calibrates_on_all_trials_and_without_each_that_is_held_back():
    subjects = subject(name='a'), subject(held_back=(1,), name='b')
    study = Study(subjects, ('random', 'cma_es'), 2, 7, 'a command', samples=False)
    tasks = list(study.tasks({'a': 'x', 'b': 'y'}))
    assert [(each.subject.name, each.search, each.left_out) for each in tasks if each.seed == 7] == [
        ('a', 'random', None), ('a', 'random', 0), ('a', 'random', 1), ('a', 'random', 2),
        ('a', 'cma_es', None), ('a', 'cma_es', 0), ('a', 'cma_es', 1), ('a', 'cma_es', 2),
        ('b', 'random', None), ('b', 'random', 1), ('b', 'cma_es', None), ('b', 'cma_es', 1)]
    assert [each.seed for each in tasks] == [7] * 12 + [8] * 12
    assert {each.engine for each in tasks if each.subject.name == 'b'} == {'y'}
    assert [trial.name for trial in tasks[2].trials] == ['trial 1', 'trial 3']
    assert [trial.name for trial in tasks[2].judges.trials] == ['trial 2']
    assert tasks[0].judges.trials == ()


@pytest.mark.long
def test_a_calibration_gives_the_result_of_the_library():
    done = perform(task(search='least_squares', seed=3), toy)
    trials = toy_trials(3)
    options = replace(OPTIONS, search='least_squares', seed=3)
    result = calibrate(trials, options, make_simulator=toy)
    assert done.values == result.values
    assert (done.score, done.error) == (result.best.score, result.errors.mean)
    assert (done.evaluations, done.simulations) == (len(result.evaluations), result.simulations)
    assert done.values == pytest.approx(TRUTH, abs=0.5)
    assert done.judgements == ()


def test_the_left_out_trial_judges_the_parameters():
    calibration = task(left_out=1)
    done = perform(calibration, toy)
    judged, = done.judgements
    (trial, chains), = judged_chains(calibration, done, toy)
    distances = np.linalg.norm(chains - trial.goals[0].chain.points, axis=2)
    assert trial.name == judged.trial == 'trial 2'
    assert judged.error == pytest.approx(distances.mean())
    assert judged.share == pytest.approx(100 * distances.mean() / trial.initial.length)


def test_a_trial_judges_with_the_calibrated_parts():
    seen = []

    class Watching(ToySimulator):
        def simulate(self, trial, physical):
            seen.append(physical)
            return super().simulate(trial, physical)

    outcome = Outcome({'flexibility': 40.0, 'stiffness_2': 75.0})
    judged_chains(task(left_out=1), outcome, lambda options: Watching())
    assert seen[0]['stiffness_2'] == BY_NAME['stiffness_2'].physical(75.0)


@pytest.mark.long
def test_the_judging_trial_does_not_change_the_parameters():
    trials = list(toy_trials(3))
    other = trials[1]
    goal = replace(other.goals[0], chain=replace(other.goals[0].chain,
                                                 points=other.goals[0].chain.points + [0, 0, 0.05]))
    trials[1] = Trial(other.name, other.initial, other.actions, (goal,))
    changed = Task(Subject('rope', Observed(tuple(trials), OPTIONS), (1,)), 'least_squares', 1, 'toy', 1)
    honest = task(left_out=1, search='least_squares')
    usual, raised = perform(honest, toy), perform(changed, toy)
    assert usual.values == raised.values
    assert raised.judgements[0].error == pytest.approx(0.05, rel=0.02)
    assert usual.judgements[0].error < 0.001


def test_other_trials_judge_where_there_are_some():
    others = Observed(tuple(toy_trials(5)[3:]), OPTIONS)
    done = perform(task(search='least_squares', held_back=(), others=others), toy)
    assert [judgement.trial for judgement in done.judgements] == ['trial 4', 'trial 5']
    assert max(judgement.error for judgement in done.judgements) < 0.001


def test_a_parameter_without_effect_is_not_excited():
    options = Options.of({'evaluations': 10, 'calibrate': ['flexibility', 'damping']})
    done = perform(task(options=options, search='least_squares'), toy)
    assert done.excited == ('flexibility',)
    assert done.values['damping'] == 50.0


def test_a_calibration_that_cannot_be_simulated_is_an_outcome():
    done = perform(task(), lambda options: ToySimulator(fail_below=101.0))
    assert 'diverged' in done.failure
    assert done.values == {}


def test_a_judge_that_cannot_be_simulated_has_no_score():
    others = Observed(tuple(toy_trials(2)), Options.of({'table': False}))
    judged = perform(task(held_back=(), others=others),
                     lambda options: ToySimulator(fail_below=-1.0 if options.table else 101.0))
    assert judged.judgements == tuple(Judgement(f'trial {k}', None, None, None) for k in (1, 2))


def test_a_stopped_calibration_has_no_outcome():
    with pytest.raises(CancelledError):
        perform(task(), toy, lambda: True)


@pytest.mark.parametrize('other', [
    task(seed=2), task(search='cma_es'), task(left_out=0), task(engine='bullet'), task(count=4),
    task(options=Options.of({'evaluations': 41})), task(options=Options.of({'evaluations': 40, 'mass': 0.1})),
    task(held_back=(), others=Observed(tuple(toy_trials(1)), OPTIONS)),
], ids=['seed', 'search', 'trials', 'engine', 'session', 'budget', 'mass', 'judges'])
def test_whatever_changes_the_outcome_changes_the_key(other):
    assert other.key != task().key


def test_what_does_not_change_the_outcome_keeps_the_key():
    options = Options.of({'evaluations': 40, 'workers': 7, 'output_directory': 'x', 'record': False})
    assert task(options=options, name='other name', held_back=(0,)).key == task().key


OUTCOME = Outcome({'friction': 0.1 + 0.2}, ('friction',), 1.5, 0.01, 40, 120, 0.5,
                  (Judgement('trial 1', 3.25, 1 / 3, 2.0), Judgement('trial 2', None, None, None)))


def test_the_journal_gives_back_every_digit(tmp_path):
    Journal(tmp_path / 'x', Outcome.of).add(task(), OUTCOME)
    assert Journal(tmp_path / 'x', Outcome.of).find(task()) == OUTCOME
    assert Journal(tmp_path / 'x', Outcome.of).find(task(seed=2)) is None


@pytest.mark.parametrize('rest', ['{"key": "a", "outc', '[1]', '{"key": "a"}', '{"key": "a", "outcome": {}}',
                                  '{"key": "a", "outcome": 3}', '\0\0', 'null\n'])
def test_broken_lines_of_a_journal_are_ignored(tmp_path, rest):
    path = tmp_path / 'x'
    Journal(path, Outcome.of).add(task(), OUTCOME)
    path.write_text(path.read_text() + rest)
    journal = Journal(path, Outcome.of)
    assert journal.find(task()) == OUTCOME
    journal.add(task(seed=2), OUTCOME)
    journal.add(task(seed=3), OUTCOME)
    again = Journal(path, Outcome.of)
    assert [again.find(task(seed=seed)) for seed in (1, 2, 3, 4)] == [OUTCOME] * 3 + [None]


def test_each_line_of_the_journal_names_its_task(tmp_path):
    Journal(tmp_path / 'x', Outcome.of).add(task(left_out=1, search='cma_es', seed=5), OUTCOME)
    entry = json.loads((tmp_path / 'x').read_text())
    assert (entry['object'], entry['search'], entry['seed'], entry['left_out'], entry['engine']) == (
        'rope', 'cma_es', 5, 2, 'toy')


def test_a_journal_that_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(InputError, match='--output'):
        Journal(tmp_path, Outcome.of)


def test_a_journal_that_cannot_be_written_says_so_and_still_has_the_outcome(tmp_path):
    journal = Journal(tmp_path / 'nowhere' / 'x', Outcome.of)
    journal.add(task(), OUTCOME)
    assert journal.failure == 'No such file or directory'
    assert journal.find(task()) == OUTCOME


@pytest.mark.parametrize(('count', 'held_back', 'said'), [
    (3, (3,), '--held-back: 4; expected 1 to 3'), (3, (-1,), '--held-back: 0'),
    (1, (0,), 'one trial')])
def test_a_trial_that_cannot_be_held_back_is_refused(count, held_back, said):
    with pytest.raises(InputError, match=said):
        subject(count, held_back)
