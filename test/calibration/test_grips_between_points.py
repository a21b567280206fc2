# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A hand that grips between the points of a tracker is simulated where it grips."""

from contextlib import closing

import numpy as np
import pytest

from dlo_calibration import Action, Chain, Goal, Hand, Options, Trial
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.files.request import Request, request_of, TrialRequest
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.pose import Pose

FINE, TRACKED, STEP = 201, 21, 10
BESIDE = 2  # fine points between the grip and the tracked point beside it, 3 mm each


def lifted():
    """Return a trial with all points of a DLO; a hand lifts it, carries it aside and holds it."""
    x = np.linspace(0, 0.6, FINE)
    start = np.stack([x, 0.03 * np.sin(10 * x), np.full(FINE, 0.005)], axis=1)
    grip = 4 * STEP + BESIDE
    path = start[grip] + [[0, 0, 0], [0, 0, 0.06], [0.05, 0.12, 0.06]]
    hand = Hand('hand', (grip,), [0.0, 1.0, 2.5], path)
    return Trial('lift', Chain(start), (Action((hand,)),), (Goal(Chain(start), 4.0, held_by=('hand',)),))


def seen(trial, goal, offset):
    """Return the trial as a tracker shows it, every tenth point; the hand grips beside the fourth of them."""
    hand, = trial.hands
    coarse = Hand('hand', (4,), hand.times, hand.positions, offset=offset)
    return Trial('seen', Chain(trial.initial.points[::STEP]), (Action((coarse,)),),
                 (Goal(Chain(goal[::STEP]), 4.0, held_by=('hand',)),))


def test_the_simulated_dlo_is_nearer_to_the_truth_than_with_the_nearest_point():
    whole, space = lifted(), ParameterSpace()
    physical = space.physical({}, whole.initial.length)
    with closing(make_simulator(Options.of({'engine': 'compiled'}))) as simulator:
        goal, = simulator.simulate(whole, physical).chains
        errors = []
        for offset in (0.0, BESIDE / STEP):
            trial = seen(whole, goal, offset)
            simulated, = simulator.simulate(trial, physical).chains
            errors.append(np.linalg.norm(simulated - trial.goals[0].chain.points, axis=1).mean())
    assert errors[1] < 0.5 * errors[0]


def test_a_request_keeps_where_a_hand_grips():
    trial = seen(lifted(), lifted().initial.points, -0.37)
    again = request_of(Request((TrialRequest.of(trial),)).document).trials[0].trial()
    assert (again.hands[0].grips, again.hands[0].offset) == ((4,), -0.37)


def test_another_frame_keeps_where_a_hand_grips():
    trial = seen(lifted(), lifted().initial.points, 0.4)
    turned = Pose.of('0.1 0.2 0.3 0 0 0.6 0.8').trial(trial)
    grip, = turned.initial.gripped(turned.hands[0].grips, turned.hands[0].offset)
    assert np.linalg.norm(grip - turned.hands[0].positions[0]) == pytest.approx(
        np.linalg.norm(trial.initial.gripped((4,), 0.4)[0] - trial.hands[0].positions[0]))
