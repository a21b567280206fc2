# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The worker: events in order, exactly one end, whatever happens, and a stop within a moment."""

import os
import threading
import time

import numpy as np
import pytest
from toy_messages import toy_trials, TRUTH
from toy_simulator import new_toy, Stoppable, ToySimulator

from dlo_calibration import calibrate, DloCalibrationError
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.evaluation import Threads
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.workspace.worker import Failure, Progress, Worker

PATIENCE = 60.0


def finished(worker):
    """Wait for the end, and return all events."""
    assert worker.join(PATIENCE)
    return list(worker.waiting_events())


def options(**flat):
    return Options.of({'workers': 1, 'evaluations': 30, 'search': 'random', **flat})


@pytest.mark.parametrize('workers', [1, 2])
def test_the_events_are_every_evaluation_in_order_and_then_the_result(workers):
    worker = Worker(lambda _: ToySimulator())
    worker.start(toy_trials(2), options(workers=workers))
    *evaluations, result = finished(worker)
    assert [e.index for e in evaluations if isinstance(e, Evaluation)] == list(range(30))
    assert isinstance(result, CalibrationResult)
    assert result.best.score == min(e.score for e in evaluations)


def test_the_result_does_not_depend_on_the_number_of_threads():
    first, *others = (calibrate(toy_trials(2), options(workers=n, evaluations=100),
                                make_simulator=new_toy) for n in (1, 2, 3))
    for other in others:
        assert first.parameters == other.parameters
        assert first.simulations == other.simulations
        assert first.best.residuals.tobytes() == other.best.residuals.tobytes()
        assert [np.array(e.scores).tobytes() for e in first.evaluations] == [
            np.array(e.scores).tobytes() for e in other.evaluations]


@pytest.mark.parametrize('name', ['flexibility', 'elasticity', 'friction'])
def test_the_worker_finds_the_truth_of_one_parameter_where_the_others_are_given(name):
    others = {other: value for other, value in TRUTH.items() if other != name}
    result = calibrate(toy_trials(2), options(evaluations=300, calibrate=[name], **others),
                       make_simulator=new_toy)
    assert abs(result.values[name] - TRUTH[name]) < 1
    assert result.estimates[name].identifiable  # the random search does not converge


@pytest.mark.parametrize('workers', [1, 2])
def test_a_defect_of_an_engine_ends_as_a_failure_of_one_line(workers):
    worker = Worker(lambda _: ToySimulator(crash=True))
    worker.start(toy_trials(1), options(workers=workers))
    failure, = finished(worker)
    assert isinstance(failure, Failure)
    assert failure.text == 'RuntimeError: the toy is broken'
    assert 'Traceback' in failure.details


def test_an_engine_that_cannot_be_made_ends_as_a_failure():
    def broken(_):
        raise ImportError('no such engine')

    worker = Worker(broken)
    worker.start(toy_trials(1), options())
    assert 'no such engine' in finished(worker)[-1].text


def test_trials_that_cannot_be_simulated_end_as_a_failure_that_says_why():
    worker = Worker(lambda _: ToySimulator(fail_below=101))
    worker.start(toy_trials(1), options(evaluations=5))
    *evaluations, failure = finished(worker)
    assert len(evaluations) == 5
    assert 'trial 1: diverged' in failure.text
    assert not failure.details


@pytest.mark.parametrize('workers', [1, 2])
def test_a_stop_gives_the_best_so_far(workers):
    worker = Worker(lambda _: ToySimulator(0.005))
    worker.start(toy_trials(1), options(workers=workers, evaluations=10000))
    first = worker.events.get(timeout=PATIENCE)
    worker.stop()
    *evaluations, result = [first, *finished(worker)]
    assert result.stop_reason == 'stopped on request'
    assert len(result.evaluations) == len(evaluations) < 10000
    assert result.best.score == min(e.score for e in evaluations)


@pytest.mark.parametrize('workers', [1, 2])
def test_a_stop_ends_a_rollout_in_its_middle_within_a_moment(workers):
    engine, before = Stoppable(), set(threading.enumerate())
    worker = Worker(lambda _: engine)
    worker.start(toy_trials(1), options(workers=workers))
    assert engine.begun.wait(PATIENCE)
    begun = time.monotonic()
    worker.stop()
    failure, = finished(worker)
    assert time.monotonic() - begun < 0.2
    assert 'stopped before the first evaluation' in failure.text
    assert set(threading.enumerate()) <= before


def test_a_second_start_is_refused_until_the_first_has_ended():
    worker = Worker(lambda _: ToySimulator(0.005))
    worker.start(toy_trials(1), options(evaluations=10000))
    with pytest.raises(DloCalibrationError, match='under way'):
        worker.start(toy_trials(1), options())
    worker.stop()
    finished(worker)
    worker.start(toy_trials(1), options())
    assert isinstance(finished(worker)[-1], CalibrationResult)


def test_zero_workers_are_one_per_core():
    assert Threads(0).workers == len(os.sched_getaffinity(0))


def test_progress_has_speed_and_time_left():
    now = [100.0]
    progress = Progress(10, 3, clock=lambda: now[0])
    assert progress.seconds_left == float('inf')
    worse, better = (Evaluation(k, np.zeros(1), {}, (score,)) for k, score in enumerate((5.0, 3.0)))
    for evaluation in (worse, better, worse, worse):
        progress.take(evaluation)
    now[0] += 2.0
    assert progress.best is better
    assert progress.simulations_per_second == 6.0
    assert progress.seconds_left == 3.0


def test_evaluations_from_a_log_do_not_count_for_the_speed():
    now = [100.0]
    progress = Progress(10, 3, logged=2, clock=lambda: now[0])
    evaluation = Evaluation(0, np.zeros(1), {}, (1.0,))
    for seconds, speed, left in ((0.0, 0.0, float('inf')), (0.1, 0.0, float('inf')), (3.0, 1.0, 21.0),
                                 (3.0, 1.0, 18.0)):
        now[0] += seconds
        progress.take(evaluation)
        assert (progress.simulations_per_second, progress.seconds_left) == (speed, left)


def test_progress_has_the_spread_of_the_best_evaluations():
    """The best 5 % count, 8 at least, by their root mean square distance from the best; failures never do."""
    def evaluated(index, value, scores, **rest):
        return Evaluation(index, np.array([value / 100]), {'friction': value}, scores, **rest)

    progress = Progress(1000, 2)
    assert progress.spread == {}
    progress.take(evaluated(0, 40.0, (1.0, 1.0)))
    assert progress.spread == {'friction': 0.0}
    for k in range(7):
        progress.take(evaluated(1 + k, 50.0, (2.0, 2.0)))
    progress.take(evaluated(8, 0.0, (), failure='diverged'))
    for k in range(20):
        progress.take(evaluated(9 + k, 100.0, (3.0, 3.0)))
    assert progress.spread == pytest.approx({'friction': 10 * (7 / 8)**0.5})


def test_the_worker_lives_in_a_thread_of_its_own():
    threads = []
    worker = Worker(lambda _: threads.append(threading.current_thread()) or ToySimulator())
    worker.start(toy_trials(1), options(evaluations=1))
    finished(worker)
    assert threads[0] is not threading.current_thread()
