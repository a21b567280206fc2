# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rollouts that workers share: the same ones in the same order, and a wait that can be stopped."""

from concurrent.futures import CancelledError
from contextlib import closing
import time

import numpy as np
import pytest
from toy_messages import toy_trials
from toy_simulator import ToySimulator

from dlo_calibration import SimulationError
from dlo_calibration.evaluation import ProcessExecutor
from dlo_calibration.evaluation.executed import Executed
from dlo_calibration.model.parameters import ParameterSpace


def test_workers_give_the_rollouts_in_order_and_say_which_failed():
    space, (trial,), itself = ParameterSpace(), toy_trials(1), ToySimulator(fail_below=30.0)
    jobs = [(trial, space.physical({'flexibility': value}, 1.0)) for value in (80, 20, 60, 40, 25, 90, 70)]
    with closing(ProcessExecutor(2)) as executor:
        executed = Executed(itself, executor)
        for some in (jobs, jobs[:1]):
            found = executed.simulate_together(some)
            failed = [k for k, one in enumerate(found) if isinstance(one, SimulationError)]
            assert failed == ([1, 4] if some is jobs else [])
            for one, (_, physical) in zip(found, some, strict=True):
                if not isinstance(one, SimulationError):
                    assert np.array_equal(one.chains, itself.simulate(trial, physical).chains)
        assert executed.simulate_together([]) == []
        with pytest.raises(SimulationError, match='diverged'):
            executed.simulate(*jobs[1])


def test_who_stops_does_not_wait_for_the_rollouts():
    def stop():
        raise CancelledError

    begun = time.monotonic()
    with closing(ProcessExecutor(2)) as executor, pytest.raises(CancelledError):
        Executed(ToySimulator(seconds=1000.0), executor).simulate_together(
            [(toy_trials(1)[0], ParameterSpace().physical({}, 1.0))] * 3, stop)
    assert time.monotonic() - begun < 60
