# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Processes that are kept from plan to plan: the same ones simulate again, and none outlives the session."""

from concurrent.futures import CancelledError
import os
import queue
import signal
import time

import numpy as np
from processes import simulating
import pytest
from toy_simulator import new_toy, toy_trial, ToySimulator

from dlo_calibration import DloCalibrationError, InputError
from dlo_calibration.calibration.options import Options
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.ros.planner_processes import PlannerProcesses

PATIENCE = 60.0  # s
TRIAL = toy_trial({'flexibility': 40.0, 'elasticity': 30.0, 'friction': 70.0, 'self_collision': 20.0})
PHYSICAL = ParameterSpace().physical({}, 1.0)


def refuse(_):
    raise InputError('engine', 'none', 'one', 'install it')


@pytest.fixture
def kept():
    """Give a function that makes processes, which end after the test; `deaths` tells of those that died."""
    made = []

    def make(factory=new_toy, deaths=None):
        made.append(PlannerProcesses(factory, (deaths or queue.SimpleQueue()).put))
        return made[-1]

    yield make
    for one in made:
        one.close()


def simulated_there(executor, factory=new_toy):
    simulator = factory(Options())
    return executor.submit(simulator.simulate, TRIAL, PHYSICAL).result(PATIENCE).chains


def test_the_same_processes_simulate_until_their_number_changes(kept):
    processes = kept()
    processes.prepare(Options(), 1)
    first = processes.ready(Options(), 1)
    assert np.array_equal(simulated_there(first), ToySimulator().simulate(TRIAL, PHYSICAL).chains)
    process = first.submit(os.getpid).result(PATIENCE)
    again = processes.ready(Options(), 1)
    assert again is first and again.submit(os.getpid).result(PATIENCE) == process != os.getpid()
    two = processes.ready(Options(), 2)
    assert process not in simulating(os.getpid())
    assert np.array_equal(simulated_there(two), ToySimulator().simulate(TRIAL, PHYSICAL).chains)


def test_a_process_that_dies_is_replaced_and_told(kept):
    deaths = queue.SimpleQueue()
    executor = kept(deaths=deaths).ready(Options(), 1)
    os.kill(executor.submit(os.getpid).result(PATIENCE), signal.SIGKILL)
    assert len(simulated_there(executor)) == 1
    assert 'was killed by SIGKILL' in deaths.get(timeout=PATIENCE)


def test_an_engine_that_cannot_be_used_is_told_to_each_plan(kept):
    processes = kept(refuse)
    processes.prepare(Options(), 1)
    for _ in range(2):
        with pytest.raises(InputError, match='engine: got none'):
            processes.ready(Options(), 1)


def sleep(_):
    time.sleep(1000)


def test_whoever_waits_for_the_compiler_can_be_stopped(kept):
    processes = kept(sleep)
    processes.prepare(Options(), 1)
    with pytest.raises(DloCalibrationError, match='it was stopped while the engine was being loaded'):
        processes.ready(Options(), 1, lambda: True)


def test_closing_ends_the_processes_and_what_they_do(kept):
    processes = kept()
    executor = processes.ready(Options(), 1)
    process = executor.submit(os.getpid).result(PATIENCE)
    waiting = executor.submit(time.sleep, 1000)
    processes.close()
    assert process not in simulating(os.getpid())
    with pytest.raises((CancelledError, RuntimeError)):
        waiting.result(PATIENCE)


def test_nothing_starts_after_closing(kept):
    processes = kept()
    processes.prepare(Options(), 1)
    processes.close()
    with pytest.raises(CancelledError):
        processes.ready(Options(), 1)
    assert not simulating(os.getpid())
