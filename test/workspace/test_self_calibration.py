# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The whole loop, with a rope that has physics of its own: look, ask, do, learn."""

from dataclasses import replace
from pathlib import Path
import sys

import numpy as np
import pytest

from dlo_calibration import Action, AdviceOptions, advise, calibrate, Chain, Goal, Options, Trial
from dlo_calibration.observation.grips import GripEvidence

sys.path.append(str(Path(__file__).resolve().parents[2] / 'examples'))

from played_rope import observed_trial, PlayedRope, STEADY  # noqa: E402

TRUTH = {'flexibility': 61.9, 'elasticity': 35.0, 'friction': 60.0, 'self_collision': 45.0}
OPTIONS = Options(engine='compiled')
LIMITS = AdviceOptions(wanted='flexibility 1.4, friction 3', height=0.1)
MOST = 8


def slipped_trial(rope, start, advice):
    """Let the hand lose the rope half way, and return the trial of a robot that does not know."""
    hand, end = advice.action.hands[0], advice.action.end
    some = 1 + len(hand.times) // 3
    *_, rest = rope.do({hand.name: (hand.times[:some], hand.positions[:some])})
    point, offset, _ = start.interpolated(start.arc_lengths()).nearest(hand.positions[0])
    known = replace(hand, grips=(point,), offset=offset, nearest=True)
    goals = (Goal(Chain(rest), advice.pause[1] - STEADY, stable=False, held_by=(hand.name,)),
             Goal(Chain(rest), end + 1.0))
    return Trial('slipped', start, (Action((known,)),), goals)


@pytest.mark.long
def test_a_rope_is_known_after_few_trials_though_the_hand_has_lost_it_once():
    rope = PlayedRope(TRUTH, np.random.default_rng(4))
    trials = []
    while len(trials) < MOST:
        start = Chain(rope.look())
        advice = advise(trials, OPTIONS, LIMITS, start=start)
        if advice.action is None:
            break
        trials.append(slipped_trial(rope, start, advice) if len(trials) == 1 else
                      observed_trial(f'trial {len(trials) + 1}', rope, advice.action, advice.pause))
    assert advice.reached
    loss, = GripEvidence.of(trials).losses
    assert loss.trial == 'slipped'
    found = calibrate([trial for trial in trials if trial.name != 'slipped'], OPTIONS).parameters
    for name, width in (('flexibility', 2.8), ('friction', 6.0)):
        assert found[name].value == pytest.approx(TRUTH[name], abs=width)
