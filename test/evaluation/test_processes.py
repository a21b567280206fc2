# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The executor of processes: answers, errors, deaths and ends."""

from concurrent.futures import CancelledError
import os
import signal
import sys
import time

from processes import simulating
import pytest

from dlo_calibration import DloCalibrationError, InputError
from dlo_calibration.evaluation import processes

PATIENCE = 60.0


@pytest.fixture
def told():
    return []


@pytest.fixture
def executor(told):
    executor = processes.ProcessExecutor(2, told.append)
    yield executor
    executor.close()


def refuse():
    raise InputError('it', 'this', 'that', 'do so')


class Unsendable(Exception):
    def __init__(self, first, second):
        super().__init__(first)


def fail_strangely():
    raise Unsendable(1, 2)


def loaded():
    return processes.LOADED in sys.modules


def die_once(file):
    if not file.exists():
        file.touch()
        os._exit(7)
    return 'done'


def test_processes_begin_with_what_the_fork_server_has_loaded(executor):
    assert simulating(os.getpid()) == []
    assert executor.submit(loaded).result(PATIENCE)
    assert len(simulating(os.getpid())) == 2


def test_fresh_processes_begin_with_nothing_loaded():
    with processes.ProcessExecutor(1, fresh=True) as executor:
        assert not executor.submit(loaded).result(PATIENCE)


def test_answers_come_whatever_the_order(executor):
    slow = executor.submit(time.sleep, 0.3)
    assert [executor.submit(pow, 2, k).result(PATIENCE) for k in range(20)] == [2**k for k in range(20)]
    assert slow.result(PATIENCE) is None


def test_errors_come_back_as_they_are_with_where_they_were_raised(executor):
    with pytest.raises(InputError, match='it: got this, expected that; do so') as caught:
        executor.submit(refuse).result(PATIENCE)
    assert 'in refuse' in caught.value.__notes__[0]
    with pytest.raises(RuntimeError, match='Unsendable'):
        executor.submit(fail_strangely).result(PATIENCE)
    assert executor.submit(abs, -1).result(PATIENCE) == 1


def test_what_cannot_be_sent_is_an_error_of_its_call_alone(executor):
    for call in (lambda: None, lambda: 1):
        with pytest.raises(Exception, match='pickle'):
            executor.submit(call).result(PATIENCE)
    assert executor.submit(abs, -1).result(PATIENCE) == 1


def test_a_call_whose_process_dies_is_made_again(executor, told, tmp_path):
    others = [executor.submit(pow, 2, k) for k in range(10)]
    assert executor.submit(die_once, tmp_path / 'died').result(PATIENCE) == 'done'
    assert [other.result(PATIENCE) for other in others] == [2**k for k in range(10)]
    assert told == ['a process that simulates ended unexpectedly with exit code 7; '
                    'its evaluation is repeated']


def test_a_call_that_kills_three_processes_is_given_up_alone(executor, told):
    deadly = executor.submit(os._exit, 3)
    with pytest.raises(DloCalibrationError, match='3 processes .* exit code 3; free memory, or use fewer'):
        deadly.result(PATIENCE)
    assert len(told) == 3
    assert [executor.submit(abs, -k).result(PATIENCE) for k in range(10)] == list(range(10))


def test_a_process_that_died_while_it_had_nothing_to_do_is_replaced(executor):
    assert executor.submit(abs, -1).result(PATIENCE) == 1
    for pid in simulating(os.getpid()):
        os.kill(pid, signal.SIGKILL)
    assert [executor.submit(abs, -k).result(PATIENCE) for k in range(10)] == list(range(10))


def test_what_waits_can_be_cancelled(executor):
    busy = [executor.submit(time.sleep, 10 * PATIENCE) for _ in range(2)]
    waiting = executor.submit(abs, -1)
    assert waiting.cancel()
    executor.close()
    for future in busy:
        with pytest.raises(CancelledError):
            future.result(PATIENCE)
    with pytest.raises(RuntimeError, match='closed'):
        executor.submit(abs, -1)


def test_shutdown_waits_for_what_was_submitted():
    with processes.ProcessExecutor(2) as executor:
        futures = [executor.submit(pow, 2, k) for k in range(10)]
    assert [future.result(0) for future in futures] == [2**k for k in range(10)]


def test_processes_are_nicer_than_their_parent(executor):
    assert executor.submit(os.nice, 0).result(PATIENCE) == min(os.nice(0) + 5, 19)
