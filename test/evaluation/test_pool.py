# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A pool: the same rollouts in the same order for any number of threads, and a wait that can be stopped."""

from concurrent.futures import CancelledError
from contextlib import closing
import os
import signal
import sys
import threading
import time

import numpy as np
import pytest
from toy_messages import toy_trials
from toy_simulator import Stoppable, ToySimulator

from dlo_calibration import EvaluationLog, SimulationError
from dlo_calibration.evaluation import BatchEvaluator, Evaluator, Memory, Pool, Threads
from dlo_calibration.model.parameters import ParameterSpace

JOBS = [(toy_trials(1)[0], ParameterSpace().physical({'flexibility': value}, 1.0))
        for value in (80, 20, 60, 40, 25, 90, 70)]


@pytest.mark.parametrize('workers', [1, 2, 3])
def test_rollouts_come_in_order_and_say_which_failed(workers):
    itself = ToySimulator(fail_below=30.0)
    with closing(Threads(workers)) as threads:
        pool = Pool(itself, threads)
        for jobs in (JOBS, JOBS[:1]):
            rollouts = pool.simulate(jobs)
            failed = [k for k, rollout in enumerate(rollouts) if isinstance(rollout, SimulationError)]
            assert failed == ([1, 4] if jobs is JOBS else [])
            for rollout, job in zip(rollouts, jobs, strict=True):
                if not isinstance(rollout, SimulationError):
                    assert np.array_equal(rollout.chains, itself.simulate(*job).chains)
        assert pool.simulate([]) == []
        with pytest.raises(RuntimeError, match='the toy'):
            Pool(ToySimulator(crash=True), threads).simulate(JOBS)


@pytest.mark.parametrize('workers', [1, 2])
def test_a_stop_ends_what_is_under_way_and_what_waits(workers):
    engine, asked = Stoppable(), threading.Event()
    with closing(Threads(workers)) as threads:
        pool = Pool(engine, threads, asked.is_set)
        begun = pool.begin(JOBS)
        assert engine.begun.wait(60)
        asked.set()
        since = time.monotonic()
        for _ in range(2):
            with pytest.raises(CancelledError):
                begun()
        with pytest.raises(CancelledError):
            pool.simulate(JOBS)
        threads.close()
        assert time.monotonic() - since < 0.2


def test_ctrl_c_ends_what_is_under_way():
    engine = Stoppable()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # pytest-xdist ignores it
    try:
        with closing(Threads(2)) as threads:
            begun = Pool(engine, threads).begin(JOBS)
            assert engine.begun.wait(60)
            threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
            with pytest.raises(KeyboardInterrupt):
                begun()
            with pytest.raises(CancelledError):
                begun()
    finally:
        signal.signal(signal.SIGINT, before)


def test_rollouts_in_memory_are_not_simulated_again(tmp_path):
    simulator = ToySimulator(fail_below=30.0)
    with EvaluationLog(tmp_path / 'log') as log:
        before = Pool(simulator, memory=Memory(log)).simulate(JOBS[:5])
        after = Pool(ToySimulator(crash=True), memory=Memory(log)).simulate(JOBS[:5])
        assert list(map(str, before)) == list(map(str, after))
        with pytest.raises(RuntimeError):
            Pool(ToySimulator(crash=True), memory=Memory(log)).simulate(JOBS)


def test_a_batch_stops_at_evaluations_that_are_in_memory_too(tmp_path):
    evaluator = Evaluator(toy_trials(1), ParameterSpace(), ToySimulator())
    points = np.linspace(0.2, 0.8, 5)[:, None].repeat(evaluator.space.dimension, axis=1)
    with EvaluationLog(tmp_path / 'log') as log:
        memory = Memory(log).of(evaluator)
        assert len(list(BatchEvaluator(evaluator, Pool(evaluator.simulator), memory)(points, 0))) == 5
        indices = []
        pool = Pool(evaluator.simulator, should_stop=lambda: len(indices) == 3)
        for evaluation in BatchEvaluator(evaluator, pool, memory)(points, 0):
            indices.append(evaluation.index)
        assert indices == [0, 1, 2]


@pytest.mark.skipif(sys.platform != 'linux', reason='a thread has no priority of its own')
def test_threads_that_simulate_have_a_lower_priority():
    with closing(Threads(1)) as threads:
        def own():
            return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
        assert threads.submit(own).result(60) == min(own() + 5, 19)
