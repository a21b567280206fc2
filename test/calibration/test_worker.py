# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The worker: events in order, exactly one end, whatever happens; processes that do not outlive it."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time

import numpy as np
from processes import simulating
import pytest
from toy_messages import toy_trials, TRUTH
from toy_simulator import Deadly, new_toy, ToySimulator

from dlo_calibration import calibrate, DloCalibrationError
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.progress import Progress
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.calibration.worker import Failure, Notice, Worker
from dlo_calibration.evaluation import processes
from dlo_calibration.evaluation.evaluation import Evaluation

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 60.0


def finished(worker):
    """Wait for the end, and return all events."""
    assert worker.join(PATIENCE)
    return list(worker.waiting_events())


def options(**flat):
    return Options.of({'workers': 1, 'evaluations': 30, 'search': 'random', **flat})


@pytest.mark.parametrize('workers', [1, 2])
def test_gives_every_evaluation_in_order_and_then_the_result(workers):
    worker = Worker(lambda _: ToySimulator())
    worker.start(toy_trials(2), options(workers=workers))
    *evaluations, result = finished(worker)
    assert [e.index for e in evaluations if isinstance(e, Evaluation)] == list(range(30))
    assert isinstance(result, CalibrationResult)
    assert result.best.score == min(e.score for e in evaluations)


def test_result_does_not_depend_on_the_number_of_processes():
    one, two, four = (calibrate(toy_trials(2), options(workers=n, evaluations=100),
                                make_simulator=new_toy) for n in (1, 2, 4))
    for other in (two, four):
        assert one.parameters == other.parameters
        assert one.simulations == other.simulations
        assert one.best.residuals.tobytes() == other.best.residuals.tobytes()
        assert [np.array(e.scores).tobytes() for e in one.evaluations] == [
            np.array(e.scores).tobytes() for e in other.evaluations]


@pytest.mark.parametrize('name', ['flexibility', 'elasticity', 'friction'])
def test_finds_the_truth_of_one_parameter_where_the_others_are_known(name):
    known = {other: value for other, value in TRUTH.items() if other != name}
    result = calibrate(toy_trials(2), options(evaluations=300, calibrate=[name], **known),
                       make_simulator=new_toy)
    assert abs(result.values[name] - TRUTH[name]) < 1
    assert result.parameters[name].identifiable


@pytest.mark.parametrize('workers', [1, 2])
def test_defect_of_an_engine_ends_as_a_failure_of_one_line(workers):
    worker = Worker(lambda _: ToySimulator(crash=True))
    worker.start(toy_trials(1), options(workers=workers))
    failure, = finished(worker)
    assert isinstance(failure, Failure)
    assert failure.text == 'RuntimeError: the toy is broken'
    assert 'Traceback' in failure.details


def test_engine_that_cannot_be_made_ends_as_a_failure():
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
def test_stop_gives_the_best_so_far(workers):
    worker = Worker(lambda _: ToySimulator(0.005))
    worker.start(toy_trials(1), options(workers=workers, evaluations=10000))
    first = worker.events.get(timeout=PATIENCE)
    worker.stop()
    *evaluations, result = [first, *finished(worker)]
    assert result.stop_reason == 'stopped on request'
    assert len(result.evaluations) == len(evaluations) < 10000
    assert result.best.score == min(e.score for e in evaluations)


def test_stop_does_not_wait_for_a_simulation_in_another_process():
    worker = Worker(lambda _: ToySimulator(10 * PATIENCE))
    worker.start(toy_trials(1), options(workers=2))
    children = spawned(os.getpid(), 2)
    worker.stop()
    failure, = finished(worker)
    assert 'stopped before the first evaluation' in failure.text
    assert not any(Path(f'/proc/{pid}').exists() for pid in children)


def test_refuses_a_second_start_and_takes_the_next_one():
    worker = Worker(lambda _: ToySimulator(0.005))
    worker.start(toy_trials(1), options(evaluations=10000))
    with pytest.raises(DloCalibrationError, match='under way'):
        worker.start(toy_trials(1), options())
    worker.stop()
    finished(worker)
    worker.start(toy_trials(1), options())
    assert isinstance(finished(worker)[-1], CalibrationResult)


def test_killed_process_is_told_at_once_and_in_the_result_which_stays_the_same():
    worker = Worker(lambda _: ToySimulator(0.005))
    worker.start(toy_trials(2), options(workers=2, evaluations=150))
    first = worker.events.get(timeout=PATIENCE)
    os.kill(spawned(os.getpid(), 2)[0], signal.SIGKILL)
    *events, result = [first, *finished(worker)]
    notice, = (event for event in events if isinstance(event, Notice))
    assert 'was killed by SIGKILL' in notice.text
    assert result.warnings == (notice.text,)
    alone = calibrate(toy_trials(2), options(evaluations=150), make_simulator=new_toy)
    assert result.parameters == alone.parameters
    assert result.best.residuals.tobytes() == alone.best.residuals.tobytes()
    assert [e.index for e in events if isinstance(e, Evaluation)] == list(range(150))


def test_an_evaluation_whose_process_dies_is_repeated(tmp_path):
    told = []
    result = calibrate(toy_trials(2), options(workers=2, evaluations=60),
                       make_simulator=lambda _: Deadly(tmp_path / 'died'), on_notice=told.append)
    assert len(told) == 1
    alone = calibrate(toy_trials(2), options(evaluations=60), make_simulator=new_toy)
    assert result.parameters == alone.parameters
    assert result.chains[0].tobytes() == alone.chains[0].tobytes()


def test_an_evaluation_that_kills_every_process_ends_the_calibration():
    told = []
    with pytest.raises(DloCalibrationError, match='3 processes one after the other .* fewer workers'):
        calibrate(toy_trials(1), options(workers=2, evaluations=60),
                  make_simulator=lambda _: Deadly(), on_notice=told.append)
    assert len(told) >= 3


class Compiling(ToySimulator):
    """It simulates only where it was prepared before it was copied."""

    ready = False

    def prepare(self):
        self.ready = True

    def simulate(self, trial, physical):
        assert self.ready, 'a copy was made before prepare'
        return super().simulate(trial, physical)


def test_the_simulator_is_prepared_before_any_copy_is_made():
    result = calibrate(toy_trials(1), options(workers=2, evaluations=4), make_simulator=lambda _: Compiling())
    assert len(result.evaluations) == 4


def spawned(parent, count):
    """Wait until a process has `count` spawned children, and return their ids."""
    begun = time.monotonic()
    while time.monotonic() - begun < PATIENCE:
        found = simulating(parent)
        if len(found) >= count:
            return found
        time.sleep(0.02)
    raise AssertionError(f'no {count} processes')


PROGRAM = """
import sys, threading, time
assert __name__ == '__main__', 'the main module was imported by a child'
sys.modules['heavy'] = sys
from dlo_calibration.evaluation import processes

executor = processes.ProcessExecutor(2)
print(executor.submit(eval, "'heavy' in __import__('sys').modules").result(), flush=True)
for _ in range(8):
    executor.submit(time.sleep, 600)
time.sleep(600)
"""


@pytest.fixture
def parent():
    process = subprocess.Popen([sys.executable, '-c', PROGRAM], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    yield process
    process.kill()
    process.wait()


def gone(pids):
    begun = time.monotonic()
    while time.monotonic() - begun < PATIENCE:
        if not any(Path(f'/proc/{pid}').exists() for pid in pids):
            return True
        time.sleep(0.02)
    return False


@pytest.mark.long
def test_processes_do_not_import_the_main_module_and_end_with_a_killed_parent(parent):
    assert parent.stdout.readline() == 'False\n'
    children = spawned(parent.pid, 2)
    parent.kill()
    parent.wait()
    assert gone(children)


def test_a_program_that_ends_without_closing_does_not_wait_for_its_processes():
    program = PROGRAM.replace('time.sleep(600)\n', '')
    subprocess.run([sys.executable, '-c', program], cwd=ROOT, stdout=subprocess.DEVNULL, check=True,
                   timeout=PATIENCE)


def test_processes_leave_signals_to_their_parent(parent):
    parent.stdout.readline()
    children = spawned(parent.pid, 2)
    for number in (signal.SIGINT, signal.SIGTERM):
        for pid in children:
            os.kill(pid, number)
    time.sleep(0.3)
    assert spawned(parent.pid, 2) == children


def test_closing_a_pool_ends_what_is_under_way():
    executor = processes.ProcessExecutor(2)
    future = executor.submit(time.sleep, 10 * PATIENCE)
    children = spawned(os.getpid(), 1)
    executor.close()
    assert gone(children)
    with pytest.raises(BaseException):  # noqa: B017 - cancelled or broken, but not waiting for ever
        future.result(timeout=PATIENCE)


def test_zero_workers_are_one_per_core():
    executor = processes.ProcessExecutor(0)
    try:
        for _ in range(2 * processes.cores()):
            executor.submit(time.sleep, 10 * PATIENCE)
        assert len(spawned(os.getpid(), len(os.sched_getaffinity(0)))) == processes.cores()
    finally:
        executor.close()


def test_progress_tells_speed_and_time_left():
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


def test_what_a_log_answers_does_not_make_progress_look_fast():
    now = [100.0]
    progress = Progress(10, 3, known=2, clock=lambda: now[0])
    one = Evaluation(0, np.zeros(1), {}, (1.0,))
    for seconds, speed, left in ((0.0, 0.0, float('inf')), (0.1, 0.0, float('inf')), (3.0, 1.0, 21.0),
                                 (3.0, 1.0, 18.0)):
        now[0] += seconds
        progress.take(one)
        assert (progress.simulations_per_second, progress.seconds_left) == (speed, left)


def test_progress_tells_how_far_good_evaluations_lie_apart():
    """The best 5 % count, 8 at least, by their root mean square distance from the best; failures never do."""
    def tried(index, value, scores, **rest):
        return Evaluation(index, np.array([value / 100]), {'friction': value}, scores, **rest)

    progress = Progress(1000, 2)
    assert progress.spread == {}
    progress.take(tried(0, 40.0, (1.0, 1.0)))
    assert progress.spread == {'friction': 0.0}
    for k in range(7):
        progress.take(tried(1 + k, 50.0, (2.0, 2.0)))
    progress.take(tried(8, 0.0, (), failure='diverged'))
    for one in (tried(9 + k, 100.0, (3.0, 3.0)) for k in range(20)):
        progress.take(one)
    assert progress.spread == pytest.approx({'friction': 10 * (7 / 8)**0.5})


def test_worker_lives_in_a_thread_of_its_own():
    threads = []
    worker = Worker(lambda _: threads.append(threading.current_thread()) or ToySimulator())
    worker.start(toy_trials(1), options(evaluations=1))
    finished(worker)
    assert threads[0] is not threading.current_thread()
