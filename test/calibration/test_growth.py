# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Work grows linearly with goals, trials, points and nodes."""

import sys
import time

import numpy as np
import pytest
from toy_simulator import toy_trial, ToySimulator

from dlo_calibration import Action, Chain, Goal, Hand, Options, Trial
from dlo_calibration.calibration.calibrate import calibrate
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.model.parameters import PAPER_PARAMETERS, ParameterSpace
from dlo_calibration.simulation.compiled import CompiledSimulator

TRUTH = dict(zip(PAPER_PARAMETERS, (30.0, 60.0, 45.0, 20.0), strict=True))


def dragged(points, goals):
    """Return a trial: a hand drags a DLO by one end, with a number of goals."""
    x = np.linspace(0, 0.6, points)
    chain = Chain(np.stack([x, np.zeros(points), np.full(points, 0.004)], axis=1))
    hand = Hand('hand', (points - 1,), [0.0, 3.0], chain.points[-1] + [[0, 0, 0], [-0.1, 0.1, 0]])
    return Trial('dragged', chain, (Action((hand,)),), tuple(
        Goal(chain, time, stable=False, held_by=('hand',)) for time in np.linspace(0.05, 2.9, goals)))


def calls_of(work):
    """Return the number of function calls of some work."""
    calls = 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event in ('call', 'c_call')

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        work()
    finally:
        sys.setprofile(before)
    return calls


def is_linear(work):
    """Tell whether work grows linearly, from that of 1, 2 and 4 units."""
    few, some, many = work
    return many - some <= 2.2 * (some - few) + 0.05 * few


@pytest.mark.parametrize('grows', ['goals', 'trials', 'points', 'nodes'])
def test_an_evaluation_calls_linearly_more_functions(grows):
    calls = []
    for size in (4, 8, 16):
        many = {'goals': 10, 'trials': 1, 'points': 20, 'nodes': 20}
        many[grows] *= size
        trials = [dragged(many['points'], many['goals']) for _ in range(many['trials'])]
        evaluator = Evaluator(trials, ParameterSpace(PAPER_PARAMETERS, mass=0.03),
                              CompiledSimulator(nodes=many['nodes']))
        evaluator.evaluate(0, np.full(4, 0.5))  # fills the caches
        calls.append(calls_of(lambda evaluator=evaluator: evaluator.evaluate(0, np.full(4, 0.5))))
    assert is_linear(calls)


class Counting(ToySimulator):
    """It counts its rollouts."""

    count = 0

    def simulate(self, trial, physical):
        """Count and simulate."""
        self.count += 1
        return super().simulate(trial, physical)


@pytest.mark.long
def test_a_calibration_simulates_linearly_more():
    rollouts = []
    for size in (5, 10, 20):
        simulator = Counting()
        trials = [toy_trial(TRUTH, f'trial {k}', turn=k / size) for k in range(size)]
        calibrate(trials, Options(workers=1, engine='compiled'),
                  make_simulator=lambda _, simulator=simulator: simulator)
        rollouts.append(simulator.count)
    assert is_linear(rollouts)


def test_a_step_of_four_times_the_nodes_takes_far_less_than_sixteen_times_as_long():
    physical = ParameterSpace(PAPER_PARAMETERS, mass=0.03).physical(
        dict.fromkeys(PAPER_PARAMETERS, 50.0), 0.6)
    trial, simulators = dragged(20, 2), [CompiledSimulator(nodes=nodes) for nodes in (100, 400)]
    seconds = [np.inf, np.inf]
    for _ in range(8):
        for k, simulator in enumerate(simulators):
            begun = time.process_time()
            simulator.simulate(trial, physical)
            seconds[k] = min(seconds[k], time.process_time() - begun)
    assert seconds[1] < 10 * seconds[0]
