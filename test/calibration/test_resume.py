# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""An interrupted calibration continues: nothing is simulated twice, and the result is the same."""

from dataclasses import replace

import pytest
from toy_messages import toy_trials
from toy_simulator import CountingToy

from dlo_calibration import calibrate, EvaluationLog, Options
from dlo_calibration.calibration.engines import engine_digest
from dlo_calibration.calibration.result import evaluation_rows, plain
from dlo_calibration.workspace.folder import calibration_digest

CHOICES = {
    'least squares': {'evaluations': 40},
    'random': {'search': 'random', 'evaluations': 20},
    'cma-es': {'search': 'cma_es', 'evaluations': 25, 'calibrate': ['flexibility', 'friction']},
    'stream': {'evaluations': 30},
    'parts': {'parts': 0, 'evaluations': 60, 'calibrate': ['flexibility', 'friction']},
}


class Killed(BaseException):
    """Stands for kill -9: nothing handles it."""


def die():
    raise Killed


class Engines:
    """The engines of one calibration: the searching one and the confirming one, which count together."""

    def __init__(self, last=None):
        self.last, self.made, self.counted = last, [], []

    def __call__(self, options):
        name = 'toy' if options.engine == 'auto' else 'bullet'
        self.made.append(CountingToy(name, self.last, die, self.counted))
        return self.made[-1]

    @property
    def count(self):
        return len(self.counted)


def outcome(result):
    """Return all values of a result, except for its duration."""
    return repr({**plain(result), 'seconds': 0}), repr(evaluation_rows(result))


def options_of(name, workers=1):
    return Options.of({'workers': workers, **CHOICES[name]})


def trials_of(name):
    trials = toy_trials(3)
    if name == 'stream':
        goals = [replace(trials[0].goals[0], time=2 + k / 50, stable=False) for k in range(60)]
        trials[0] = replace(trials[0], goals=tuple(goals))
    return trials


@pytest.mark.parametrize('name', [
    pytest.param(name, marks=pytest.mark.long) if name in ('cma-es', 'stream') else name for name in CHOICES])
def test_nothing_is_simulated_twice_and_the_result_is_the_same(name, tmp_path):
    """The kills hit the search, the examination, the advice and the confirmation by another engine."""
    options, trials, whole = options_of(name), trials_of(name), Engines()
    expected = outcome(calibrate(trials, options, make_simulator=whole))
    assert len(whole.made) == 2
    path = tmp_path / 'log'
    simulated, kills = 0, 0
    while True:
        engines = Engines(last=whole.count // 6 + 2)
        try:
            with EvaluationLog(path) as log:
                result = calibrate(trials, options, make_simulator=engines, log=log)
            break
        except Killed:
            simulated += engines.count
            kills += 1
    assert outcome(result) == expected
    assert kills >= 4
    # Each kill costs at most the trials of the evaluation under way.
    assert simulated + engines.count <= whole.count + kills * (len(trials) - 1)


@pytest.fixture(scope='module')
def unkilled(tmp_path_factory):
    """Return the outcome of an uninterrupted calibration, and its number of rollouts."""
    options, whole = options_of('least squares'), Engines()
    with EvaluationLog(tmp_path_factory.mktemp('whole') / 'log') as log:
        return outcome(calibrate(toy_trials(2), options, make_simulator=whole, log=log)), whole.count


@pytest.mark.parametrize('rest', [
    *range(1, 60, 14), *(pytest.param(rest, marks=pytest.mark.long) for rest in range(8, 60, 14))])
def test_later_stages_simulate_nothing_twice_either(rest, unkilled, tmp_path):
    """Advice, missing parameters and confirmation are rollouts: each counts."""
    options, trials = options_of('least squares'), toy_trials(2)
    expected, count = unkilled
    with EvaluationLog(tmp_path / 'log') as log:
        with pytest.raises(Killed):
            calibrate(trials, options, make_simulator=Engines(last=count - rest + 1), log=log)
        engines = Engines()
        assert outcome(calibrate(trials, options, make_simulator=engines, log=log)) == expected
    assert rest <= engines.count <= rest + (len(trials) - 1)  # one evaluation in the examination


@pytest.mark.parametrize('first, then', [(1, 2), (2, 1)])
def test_it_continues_with_another_number_of_threads(first, then, tmp_path):
    trials, seen = toy_trials(3), []

    def stop_late(evaluation):
        seen.append(evaluation)
        if len(seen) == 20:
            raise Killed

    expected = outcome(calibrate(trials, options_of('random'), make_simulator=Engines()))
    with EvaluationLog(tmp_path / 'log') as log:
        with pytest.raises(Killed):
            calibrate(trials, options_of('random', first), make_simulator=Engines(), log=log,
                      on_evaluation=stop_late)
        assert log.evaluations >= len(seen)
        engines, again = Engines(), []
        result = calibrate(trials, options_of('random', then), make_simulator=engines, log=log,
                           on_evaluation=again.append)
    assert outcome(result) == expected
    assert [evaluation.index for evaluation in again] == list(range(20))


def test_a_stopped_calibration_continues_on_request(tmp_path):
    trials, options = toy_trials(2), options_of('random')
    expected = outcome(calibrate(trials, options, make_simulator=Engines()))
    seen = []
    with EvaluationLog(tmp_path / 'log') as log:
        for count in (5, 9):
            seen.clear()
            result = calibrate(trials, options, make_simulator=Engines(), log=log, on_evaluation=seen.append,
                               should_stop=lambda count=count: len(seen) >= count)
            assert (len(result.evaluations), result.stop_reason) == (count, 'stopped on request')
        assert outcome(calibrate(trials, options, make_simulator=Engines(), log=log)) == expected


def test_the_digest_ignores_the_machine_and_the_path_of_the_scene(tmp_path):
    trials, options = toy_trials(2), Options()
    digest = calibration_digest(trials, options)
    for other in (replace(options, workers=7, output_directory='elsewhere', record=False),):
        assert calibration_digest(trials, other) == digest
    for other in (replace(options, seed=7), replace(options, nodes=21), replace(options, mass=0.1)):
        assert calibration_digest(trials, other) != digest
    assert calibration_digest(trials[::-1], options) != digest
    scene = ('<robot name="a"><link name="b"><collision><geometry><box size="1 1 {}"/></geometry>'
             '</collision></link></robot>')
    digests = []
    for name, height in (('a', 1), ('b', 1), ('c', 2)):
        (tmp_path / name).write_text(scene.format(height), encoding='utf-8')
        digests.append(engine_digest(Options(scene=str(tmp_path / name))))
    assert digests[0] == digests[1] != digests[2] != engine_digest(options)
