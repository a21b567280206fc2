# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The motion of a DLO between the chains of a prediction."""

from made_up_dlo import HOSE, MadeUpDlo, straight
import numpy as np
import pytest

from dlo_calibration import Options
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.model.named_actions import Drag, LiftAndHold, Release
from dlo_calibration.planning import Posterior
from dlo_calibration.planning.prediction import simulate
from dlo_calibration.planning.rehearsal import CALM, motion_of_actions
from dlo_calibration.simulation.motion import hands_at

DLO = MadeUpDlo(HOSE)


@pytest.fixture(scope='module')
def shown():
    """Give a prediction, the trial of its course, and the motion."""
    prediction = simulate(DLO, straight(), [LiftAndHold(point=20, height=0.1, hand='a'), Drag(
        point=0, direction=(0, 1, 0), distance=0.1, hand='b'), Release(hands=('a',))], draws=0)
    return prediction, *motion_of_actions(prediction.start, [step.step for step in prediction.steps],
                                         make_simulator(Options()), Posterior.of(DLO).best, frame_rate=20)


def test_a_motion_passes_through_the_predicted_chains(shown):
    prediction, trial, motion = shown
    for action, following, step in zip(trial.actions, [*trial.actions[1:], None], prediction.steps,
                                       strict=True):
        until = action.end + CALM if following is None else following.start
        frame = motion.chains[np.searchsorted(motion.times, until, side='right') - 1]
        assert np.linalg.norm(frame - step.chain, axis=1).max() < 5e-3
    np.testing.assert_array_equal(trial.goals[-1].chain.points, motion.ends[-1])


def test_a_motion_shows_a_fall(shown):
    _, trial, motion = shown
    heights = motion.chains[motion.times > trial.actions[-1].end - 0.05, 20, 2]
    assert heights[0] > 0.09 and heights[-1] < 0.02
    assert ((0.02 < heights) & (heights < 0.09)).any()


def test_a_motion_shows_when_hands_are_closed(shown):
    _, trial, _ = shown
    lift, drag, release = trial.actions
    closed = [{name: closed for name, (_, closed) in hands_at(trial, time).items()} for time in (
        (lift.start + lift.end) / 2, (lift.end + drag.start) / 2, (drag.start + drag.end) / 2,
        (drag.end + release.start) / 2, release.end + 1)]
    assert [hands['a'] for hands in closed] == [True, True, True, True, False]
    assert [hands['b'] for hands in closed] == [False, False, True, False, False]


def test_a_long_motion_has_no_more_frames_than_permitted():
    action = Drag(point=0, direction=(0, 1, 0), distance=0.5, speed=0.02).action(straight())
    steps = [step.step for step in simulate(DLO, straight(), [action], draws=0).steps]
    for most in (7, 30):
        _, motion = motion_of_actions(straight(), steps, make_simulator(Options()), Posterior.of(DLO).best,
                                     most=most)
        assert motion.chains.shape == (most, 21, 3)
