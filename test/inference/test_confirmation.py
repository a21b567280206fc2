# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A second engine confirms the result of the first."""

from dataclasses import replace
import json

from fitted import fitted
import numpy as np
import pytest
from toy_command import one_worker
from toy_messages import session_messages, toy_trials, TRUTH, write_session
from toy_simulator import Stoppable, ToySimulator

from dlo_calibration import calibrate, SimulationError
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import plain
from dlo_calibration.calibration.stages import confirmed, confirming
from dlo_calibration.cli import main as cli
from dlo_calibration.files.result import read_result, write_result
from dlo_calibration.inference.examination import disagreements
from dlo_calibration.messages.codec import bag_types
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.score import PointErrors, residuals, TrialScore
from dlo_calibration.report.page import Origin, page_of
from dlo_calibration.report.sentences import fit_facts
from dlo_calibration.ros import diagnostics
from dlo_calibration.search.sampling import RandomSearch
from dlo_calibration.simulation.protocol import Rollout
from dlo_calibration.writing import write_file

OPTIONS = Options(evaluations=20, workers=1)


class SecondToy(ToySimulator):
    """
    Another engine, that moves every point of some trials.

    :param shift: [m] along y.
    :param only: names of the trials; None: all.
    :param failure: raised in place of simulating.
    """

    name = 'second toy'

    def __init__(self, shift=0.0, only=None, failure=None):
        super().__init__()
        self.shift, self.only, self.failure = shift, only, failure

    def simulate(self, trial, physical):
        if self.failure is not None:
            raise self.failure
        rollout = super().simulate(trial, physical)
        if self.only is not None and trial.name not in self.only:
            return rollout
        return Rollout(rollout.chains + (0, self.shift, 0), rollout.settled, rollout.duration, rollout.steps)


def calibrated(second):
    result = fitted(toy_trials(2), ParameterSpace(), ToySimulator(), RandomSearch(4, 1), budget=20)
    return result, confirmed(result, OPTIONS, engines(second))


def test_the_result_stays_and_the_other_engines_figures_stand_beside_it():
    before, after = calibrated(SecondToy(0.004))
    assert after.values == before.values
    assert (after.best, after.engine, after.evaluations) == (before.best, 'toy', before.evaluations)
    other = after.confirmation
    assert other.engine == 'second toy'
    assert other.mean_distance == pytest.approx(0.004)
    assert other.max_distance == pytest.approx(0.004)
    moved = [chains + (0, 0.004, 0) for chains in after.chains]
    assert other.scores == pytest.approx(
        [TrialScore(trial)(chains) for trial, chains in zip(after.trials, moved, strict=True)])
    assert other.score == pytest.approx(np.mean(other.scores))
    residual = np.concatenate([residuals(*pair) for pair in zip(after.trials, moved, strict=True)])
    assert other.errors.mean == pytest.approx(PointErrors.of(residual).mean)


def test_a_confirmation_runs_beside_other_stages():
    before, expected = calibrated(SecondToy(0.004))
    with confirming(before, SecondToy(0.004)) as confirm:
        after = confirm(replace(before, warnings=('of another stage',)))
    assert after.confirmation == expected.confirmation
    assert after.warnings == ('of another stage', *expected.warnings)


def test_nothing_is_simulated_where_there_is_nothing_to_confirm():
    before, _ = calibrated(SecondToy())
    for options, second in ((Options(engine='compiled'), SecondToy()), (OPTIONS, ToySimulator())):
        assert confirmed(before, options, engines(second)) == before


def test_a_confirmation_costs_no_evaluation():
    before, after = calibrated(SecondToy())
    assert after.simulations == before.simulations


def test_engines_that_agree_cause_no_warning():
    for shift in (0.0, 1e-5):
        before, after = calibrated(SecondToy(shift))
        assert after.confirmation is not None
        assert after.warnings == before.warnings == ()


def test_a_disagreement_names_the_trial_and_how_much():
    _, after = calibrated(SecondToy(0.01, only=('trial 2',)))
    warning, = after.warnings
    assert warning.startswith('engine second toy disagrees with engine toy: trial 2: points 10.00 mm apart')
    assert 'trial 1' not in warning
    assert f'instead of {after.best.scores[1]:.2f}' in warning
    assert after.confirmation.max_distance == pytest.approx(0.01)
    assert after.confirmation.mean_distance == pytest.approx(0.005)


@pytest.mark.parametrize(('shift', 'score', 'other', 'reported'), [
    (0.0004, 1.0, 1.0, False), (0.0006, 1.0, 1.0, True),
    (0.0, 1.0, 1.09, False), (0.0, 1.0, 1.11, True), (0.0, 1.11, 1.0, True),
    (0.0, 10.0, 10.4, False), (0.0, 10.0, 10.6, True)])
def test_only_differences_beyond_the_tolerances_are_reported(shift, score, other, reported):
    chain = np.zeros((1, 5, 3))
    assert bool(disagreements(['a'], [chain], [chain + (shift, 0, 0)], [score], [other])) is reported


def test_a_second_engine_that_fails_leaves_the_result_with_a_warning():
    before, after = calibrated(SecondToy(failure=SimulationError('the rollout diverged')))
    assert after.confirmation is None
    assert after.values == before.values
    assert after.warnings == ('not confirmed by engine bullet: the rollout diverged',)


def engines(second):
    """Return a factory: the toy, and where PyBullet itself is asked for, another engine."""
    return lambda options: second if options.engine == 'bullet' else ToySimulator()


@pytest.mark.long
def test_auto_confirms_and_a_named_engine_does_not():
    trials = toy_trials(1)
    result = calibrate(trials, OPTIONS, make_simulator=engines(SecondToy(0.001)))
    assert (result.engine, result.confirmation.engine) == ('toy', 'second toy')
    named = Options.of({**OPTIONS.flat(), 'engine': 'compiled'})
    assert calibrate(trials, named, make_simulator=engines(SecondToy(0.001))).confirmation is None
    # Where auto is PyBullet already, it is not asked twice.
    assert calibrate(trials, OPTIONS, make_simulator=lambda _: SecondToy()).confirmation is None


@pytest.mark.parametrize('failure', [RuntimeError('broken\nhere'), MemoryError()])
def test_a_second_engine_that_breaks_does_not_lose_the_result(failure):
    result = calibrate(toy_trials(1), OPTIONS, make_simulator=engines(SecondToy(failure=failure)))
    assert result.confirmation is None
    assert 'not confirmed by engine bullet: ' + type(failure).__name__ in result.warnings[-1]
    assert '\n' not in result.warnings[-1]


def test_a_second_engine_that_cannot_be_made_does_not_lose_the_result():
    def make(options):
        if options.engine == 'bullet':
            raise ImportError('no pybullet')
        return ToySimulator()
    assert 'no pybullet' in calibrate(toy_trials(1), OPTIONS, make_simulator=make).warnings[-1]


def test_pybullet_is_not_made_again_to_confirm_itself():
    asked = []

    class Bullet(ToySimulator):
        name = 'bullet'

    calibrate(toy_trials(1), OPTIONS, make_simulator=lambda options: asked.append(options) or Bullet())
    assert len(asked) == 1


def test_a_stopped_search_is_confirmed_too():
    count = []
    result = calibrate(toy_trials(2), OPTIONS,
                       make_simulator=engines(SecondToy(0.001)), on_evaluation=count.append,
                       should_stop=lambda: len(count) >= 3)
    assert len(result.evaluations) == 3
    assert result.confirmation.mean_distance == pytest.approx(0.001)


def test_a_confirmation_that_takes_too_long_after_a_stop_is_given_up(monkeypatch):
    monkeypatch.setattr('dlo_calibration.calibration.stages.STOPPED_PATIENCE', 0.2)
    seen, second = [], Stoppable()
    second.name = 'second toy'
    result = calibrate(toy_trials(2), OPTIONS, make_simulator=engines(second), on_evaluation=seen.append,
                       should_stop=lambda: len(seen) >= 3)
    assert result.confirmation is None
    assert result.warnings == ('not confirmed by engine bullet: stopped on request',)


@pytest.fixture
def command(capsys, tmp_path):
    """Give a function that does what a command line says on a session, and returns its JSON document."""
    session = write_session(tmp_path / 'recorded', session_messages(bag_types(), 2),
                            {'evaluations': 20})

    def act(verb, *words):
        capsys.readouterr()
        before = (tmp_path / 'out/result.xml',) if verb == 'validate' else ()
        assert cli.main(one_worker((verb, *before, session, '--json', *words)),
                        engines(SecondToy(0.004))) == 0
        return json.loads(capsys.readouterr().out)
    return act


@pytest.mark.long
def test_fit_and_validate_print_both_engines(command, tmp_path):
    fitted = command('fit', '--output', tmp_path / 'out')
    checked = command('validate')
    for document in (fitted, checked):
        assert document['engine'] == 'toy'
        other = document['confirmation']
        assert (other['engine'], len(other['scores'])) == ('second toy', 2)
        assert other['mean_distance_m'] == pytest.approx(0.004)
        assert other['max_distance_m'] == pytest.approx(0.004)
        assert 'second toy disagrees' in document['warnings'][-1]
    assert checked['score'] == fitted['score']
    assert checked['confirmation'] == fitted['confirmation']
    assert fitted['evaluations'] == 20
    assert read_result(tmp_path / 'out/result.xml').confirmation.score == fitted['confirmation']['score']
    assert command('fit', '--engine', 'compiled')['confirmation'] is None


@pytest.mark.long
def test_sentences_name_the_confirmation(tmp_path):
    before, after = calibrated(SecondToy(0.004))
    assert dict(fit_facts(plain(after)))['confirmed by second toy'].endswith(
        'points 4 mm from those of toy, 4 mm at most')
    assert 'confirmed by second toy' not in dict(fit_facts(plain(before)))
    write_file(tmp_path / 'report.html', page_of(after, Origin('session', 'fit', Options())))
    assert 'confirmed by second toy' in (tmp_path / 'report.html').read_text(encoding='utf-8')


def test_result_files_hold_it_exactly(tmp_path):
    before, after = calibrated(SecondToy(1 / 300))
    for result in (before, after):
        write_result(tmp_path / 'result.xml', result)
        assert read_result(tmp_path / 'result.xml').confirmation == result.confirmation


def test_the_message_holds_it():
    before, after = calibrated(SecondToy(0.004))
    whole = {pair.key: pair.value for pair in diagnostics.result(bag_types(), after, 0).status[-1].values}
    assert whole['confirmation_engine'] == 'second toy'
    assert float(whole['confirmation_score']) == after.confirmation.score
    assert [float(word) for word in whole['confirmation_scores'].split()] == list(after.confirmation.scores)
    assert float(whole['confirmation_mean_distance_mm']) == pytest.approx(4.0)
    bare = diagnostics.result(bag_types(), before, 0).status[-1].values
    assert not any(pair.key.startswith('confirmation') for pair in bare)


def test_truth_is_where_the_toy_says():
    """Both engines agree at the truth itself, with scores of nothing."""
    trial, = toy_trials(1)
    physical = ParameterSpace().physical(TRUTH, trial.initial.length)
    assert TrialScore(trial)(SecondToy().simulate(trial, physical).chains) == pytest.approx(0, abs=1e-9)
