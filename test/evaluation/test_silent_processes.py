# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Processes that hang are replaced; those that are only slow are not."""

from contextlib import closing
import os
import signal
import time

from processes import simulating
import pytest
from toy_messages import toy_trials
from toy_simulator import new_toy, ToySimulator

from dlo_calibration import calibrate, DloCalibrationError
from dlo_calibration.calibration.options import Options
from dlo_calibration.evaluation.processes import ProcessExecutor
from dlo_calibration.simulation.protocol import advanced

LIMIT = 2.0  # s
PATIENCE = 60.0
TOLD = 'a process that simulates gave no answer for 2 s and is replaced; its evaluation is repeated'


def stop_once(file):
    """Be stopped, as by a debugger, in the first call."""
    if not file.exists():
        file.touch()
        time.sleep(0.5)  # a first sign of life
        os.kill(os.getpid(), signal.SIGSTOP)
    return 'went on'


def hang_once(file):
    """Advance, and then no more, in the first call."""
    advanced()
    if not file.exists():
        file.touch()
        time.sleep(10 * PATIENCE)
    return 'went on'


def advance_slowly():
    """Take longer than the limit, and advance all the time."""
    for _ in range(15):
        advanced()
        time.sleep(0.2)
    return os.getpid()


def test_a_process_that_hangs_is_replaced_and_one_that_is_slow_is_not(tmp_path):
    told = []
    with closing(ProcessExecutor(4, told.append, LIMIT)) as executor:
        slow = [executor.submit(advance_slowly), executor.submit(time.sleep, LIMIT + 1)]
        hanging = [executor.submit(call, tmp_path / call.__name__) for call in (stop_once, hang_once)]
        assert [future.result(PATIENCE) for future in hanging] == ['went on', 'went on']
        assert slow[0].result(PATIENCE) in simulating(os.getpid())
        assert slow[1].result(PATIENCE) is None  # it never began to simulate: it may be loading
    assert told == [TOLD, TOLD]


@pytest.mark.long
def test_a_call_that_always_hangs_is_given_up(monkeypatch):
    monkeypatch.setattr('dlo_calibration.evaluation.processes.DEATHS', 1)
    with closing(ProcessExecutor(1, answer_limit=1.0)) as executor:
        with pytest.raises(DloCalibrationError, match='gave no answer for 1 s .*; raise answer_limit'):
            executor.submit(hang_once, _Nowhere()).result(PATIENCE)


class _Nowhere:
    def exists(self):
        return False

    def touch(self):
        """Make nothing."""


def test_a_worker_stopped_in_the_middle_of_a_search_is_told_and_changes_nothing():
    options = Options(search='random', evaluations=60, workers=1)
    whole = calibrate(toy_trials(2), options, make_simulator=new_toy)
    told = []

    def stop(evaluation):
        if evaluation.index == 10:
            worker = max(simulating(os.getpid()))
            os.kill(worker, signal.SIGSTOP)

    torn = calibrate(toy_trials(2), Options(**{**vars(options), 'workers': 2, 'answer_limit': LIMIT}),
                     make_simulator=lambda _: ToySimulator(0.005), on_evaluation=stop, on_notice=told.append)
    assert told == [TOLD]
    assert torn.warnings == (TOLD,)
    assert torn.parameters == whole.parameters
    assert torn.best.residuals.tobytes() == whole.best.residuals.tobytes()
    assert [one.score for one in torn.evaluations] == [one.score for one in whole.evaluations]
