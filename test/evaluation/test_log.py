# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The log of evaluations: it survives kills, and a damaged or a stranger's log does no harm."""

from dataclasses import replace
import os
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest
from toy_messages import toy_trials, TRUTH
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration import InputError
from dlo_calibration.evaluation import EvaluationLog, Evaluator, Memory
from dlo_calibration.evaluation.digest import digest
from dlo_calibration.evaluation.log import Entry
from dlo_calibration.model.parameters import ParameterSpace

POINTS = np.random.default_rng(1).random((5, 4))


@pytest.fixture
def path(tmp_path):
    """Give the path of a log."""
    return tmp_path / 'evaluations.log'


@pytest.fixture
def evaluator():
    """Give an evaluator of two trials."""
    return Evaluator(toy_trials(2), ParameterSpace(), ToySimulator(fail_below=30.0))


def remembered(path, evaluator, points=POINTS):
    """Return what a log remembers of points."""
    with EvaluationLog(path) as log:
        memory = Memory(log).of(evaluator)
        return [memory.find(k, point) for k, point in enumerate(points)]


def write(path, evaluator, points=POINTS):
    """Write the evaluations of points to a log; return them."""
    evaluations = [evaluator.evaluate(k, point) for k, point in enumerate(points)]
    with EvaluationLog(path) as log:
        for evaluation in evaluations:
            Memory(log).of(evaluator).add(evaluation)
    return evaluations


def same(first, second):
    """Return whether two evaluations are equal, bit for bit."""
    return repr(first) == repr(second) and (
        first.residuals is second.residuals is None
        or first.residuals.tobytes() == second.residuals.tobytes())


def test_evaluations_also_failed_ones_are_read_back_bit_for_bit(path, evaluator):
    evaluations = write(path, evaluator)
    assert {bool(evaluation.failure) for evaluation in evaluations} == {True, False}
    assert all(map(same, remembered(path, evaluator), evaluations))


def test_an_evaluation_of_a_stream_is_read_back_with_the_errors_of_every_goal(path):
    trial, = toy_trials(1)
    goals = [replace(trial.goals[0], time=2 + k / 100, stable=False) for k in range(100)]
    streamed = replace(trial, goals=tuple(goals))
    evaluator = Evaluator([streamed], ParameterSpace(), ToySimulator(), every_goal=False)
    evaluations = write(path, evaluator)
    assert all(map(same, remembered(path, evaluator), evaluations))
    every = Evaluator([streamed], ParameterSpace(), ToySimulator())
    assert remembered(path, every) == [None] * 5  # its residuals are others


def test_evaluations_of_another_trial_space_engine_or_point_are_not_found(path, evaluator):
    write(path, evaluator)
    others = [Evaluator(toy_trials(3)[1:], evaluator.space, evaluator.simulator),
              Evaluator(evaluator.trials, ParameterSpace(mass=0.1), evaluator.simulator)]
    assert not any(evaluation for other in others for evaluation in remembered(path, other))
    with EvaluationLog(path) as log:
        assert Memory(log, 'other settings').of(evaluator).find(0, POINTS[0]) is None
        assert Memory(log).of(evaluator, finer=True).find(0, POINTS[0]) is None


def test_a_damaged_byte_costs_one_evaluation_and_a_cut_the_last(path, evaluator):
    evaluations = write(path, evaluator)
    whole = path.read_bytes()
    for place in np.linspace(0, len(whole) - 1, 60).astype(int):
        damaged = bytearray(whole)
        damaged[place] ^= 4
        path.write_bytes(damaged)
        intact = remembered(path, evaluator)
        assert intact.count(None) in (1, 2)  # two if the end of a line was damaged
        assert all(same(*pair) for pair in zip(intact, evaluations, strict=True) if pair[0])
        path.write_bytes(whole[:place])
        assert sum(map(bool, remembered(path, evaluator))) == whole[:place].count(b'\n')


def test_a_cut_log_is_continued(path, evaluator):
    write(path, evaluator)
    path.write_bytes(path.read_bytes()[:-9])
    assert remembered(path, evaluator)[4] is None
    evaluations = write(path, evaluator)
    assert all(map(same, remembered(path, evaluator), evaluations))


def test_entries_that_no_evaluator_can_have_written_are_ignored(path, evaluator):
    """A stranger can compute check sums, too."""
    write(path, evaluator)
    keys = [line.split()[0].decode() for line in path.read_bytes().splitlines()]
    path.unlink()
    with EvaluationLog(path) as log:
        for key, numbers in zip(keys, ([], [7.0], [np.nan] * 70, [0.0] * 71, [-1.0]), strict=True):
            log.add(key, Entry(np.array(numbers), 'x' * 1000))
    with path.open('ab') as stream:
        stream.write(b'a b c\n\xff\xfe \n' + b' ' * 100000 + b'\n' + b'\0' * 1000)
    assert remembered(path, evaluator) == [None] * 5


def test_only_one_calibration_uses_a_log(path):
    with EvaluationLog(path), pytest.raises(InputError, match='another calibration is using'):
        EvaluationLog(path)
    EvaluationLog(path).close()


@pytest.mark.parametrize('make', [os.mkfifo, os.mkdir, lambda path: path.symlink_to('/dev/null')])
def test_a_log_that_is_no_regular_file_is_refused_at_once(path, make):
    make(path)
    with pytest.raises(InputError, match=r'log .*evaluations\.log'):
        EvaluationLog(path)


def test_a_full_disk_gives_one_warning_and_the_log_written_so_far_stays(path, evaluator, monkeypatch):
    warnings = []
    with EvaluationLog(path) as log:
        memory = Memory(log, '', warnings.append).of(evaluator)
        evaluations = [evaluator.evaluate(k, point) for k, point in enumerate(POINTS)]
        memory.add(evaluations[0])
        real = os.write
        monkeypatch.setattr(os, 'write', lambda file, octets: real(file, octets[:40]) if len(octets) > 40
                            else (_ for _ in ()).throw(OSError(28, 'No space left on device')))
        for evaluation in evaluations[1:]:
            memory.add(evaluation)
        monkeypatch.undo()
        assert same(memory.find(0, POINTS[0]), evaluations[0])
        assert memory.find(1, POINTS[1]) is None
    text, = warnings
    assert 'No space left on device; the calibration goes on' in text
    assert sum(map(bool, remembered(path, evaluator))) == 1


def test_digest_is_the_same_in_another_process(tmp_path):
    program = ('from toy_messages import toy_trials\nfrom dlo_calibration.evaluation.digest import digest\n'
               'print(digest(toy_trials(2), {"b": 1.5, "a": None}))')
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True, check=True, env={
        **os.environ, 'PYTHONPATH': os.pathsep.join(sys.path), 'PYTHONHASHSEED': '7'})
    assert done.stdout.strip() == digest(toy_trials(2), {'a': None, 'b': 1.5})


def test_different_values_have_different_digests():
    array = np.arange(6.0)
    values = [1, 1.0, True, '1', b'1', (1,), ((1,),), (1, 1), ('1', 1), None, 'None', {}, (), {'1': 1}, array,
              array[:5], array.reshape(2, 3), array.astype('f4'), toy_trial(TRUTH), toy_trial(TRUTH, 'other'),
              toy_trial({**TRUTH, 'friction': 70.1}), 0.0, -0.0]
    assert len({digest(value) for value in values}) == len(values)
    assert digest(array.astype('>f8')) == digest(array)
    assert digest(np.float64(0.1), np.int64(3)) == digest(0.1, 3)
    with pytest.raises(TypeError, match='Path'):
        digest(Path('x'))
