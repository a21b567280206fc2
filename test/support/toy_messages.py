# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Messages of trials whose truth the toy knows."""

import functools

import numpy as np
from toy_simulator import toy_trial

from dlo_calibration import Trial
from dlo_calibration.files.record import encode
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.messages.codec import (
    ACTION,
    action_trajectory,
    ActionMessage,
    chain_cloud,
    GOAL,
    INITIAL,
    INPUT_TYPES,
    MessageTypes,
)

TRUTH = {'flexibility': 40.0, 'elasticity': 30.0, 'friction': 70.0, 'self_collision': 20.0}
SECOND = 10**9
MINUTE = 60 * SECOND


@functools.cache
def _toy(k: int) -> Trial:
    return toy_trial(TRUTH, f'trial {k + 1}', turn=0.4 * k)


def toy_trials(count: int) -> list[Trial]:
    """Return `count` different trials of one DLO."""
    return [_toy(k) for k in range(count)]


def trial_messages(types: MessageTypes, trial: Trial, stamp: int, frame_id: str = 'world') -> list:
    """Return (topic, message) of a trial that begins at `stamp` [ns]."""
    hands = trial.actions[0].hands
    action = ActionMessage(
        stamp, frame_id, tuple(hand.name for hand in hands), hands[0].times,
        np.stack([hand.positions for hand in hands], axis=1),
        np.stack([hand.orientations for hand in hands], axis=1))
    return [(INITIAL, chain_cloud(types, trial.initial, stamp, frame_id)),
            (ACTION, action_trajectory(types, action)),
            *((GOAL, chain_cloud(types, goal.chain, stamp + round(goal.time * SECOND), frame_id))
              for goal in trial.goals)]


def session_messages(types: MessageTypes, count: int = 2, first: int = 0) -> list:
    """Return (topic, message) of `count` trials, a minute apart."""
    return [pair for k, trial in enumerate(toy_trials(first + count)[first:], start=first + 1)
            for pair in trial_messages(types, trial, k * MINUTE)]


def write_session(path, pairs, options=None, node='/calibrator'):
    """Record messages of `bag_types` as a session; return its folder."""
    with SessionWriter(path, options) as writer:
        for k, (topic, message) in enumerate(pairs):
            kind = INPUT_TYPES[topic]
            writer.write(f'{node}/{topic}', kind, encode(message, kind), (k + 1) * SECOND)
        return writer.path
