# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Slow errors: those that change slowly along a DLO and in time, as those of chains and hands in a film do.

Neighbouring points share them, so the roughness of chains does not show them (see `noise`).  How large they
are is given; copies of trials that have them show how far they move the optimum.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Callable, Sequence

import numpy as np

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats, grip_place
from dlo_calibration.model.trial import Trial

WAVES = 5  # half waves along the DLO, from 0 on, in the error of a chain
DRIFT = 1 / 3  # of the error of a hand's grip: that of its way from there, halfway and at its end


def with_slow_errors(trials: Sequence[Trial], chain_error: float, hand_error: float
                     ) -> list[tuple[Trial, ...]]:
    """
    Return copies of all trials, each with one more error, of one standard deviation in every trial.

    An initial chain is off over the table, in waves along the DLO.  A hand grips another place, and its path
    is the one of that place as it turns; and it drifts over the table on its way.

    :param chain_error: standard deviation of a coordinate of a chain's points [m]; 0: no error.
    :param hand_error: that of the place along the DLO that a hand grips [m]; 0: no error.
    """
    changes: list[Callable[[Trial], Trial]] = []
    for axis in np.eye(3)[:2]:
        if chain_error:
            # The mean squares of the waves add up to that of the error; they are 1 for a shift, else 1/2.
            size = chain_error / np.sqrt((WAVES + 1) / 2)
            changes += [partial(_waved, wave=wave, error=size * axis) for wave in range(WAVES)]
        if hand_error:
            changes += [partial(_drifted, late=late, error=DRIFT * hand_error * axis)
                        for late in (False, True)]
    if hand_error:
        changes.append(partial(_all_beside, way=hand_error))
    return [tuple(map(change, trials)) for change in changes]


def _waved(trial: Trial, wave: int, error: Floats) -> Trial:
    """Return a trial whose initial chain is off by an error (3,) [m] times a cosine along the DLO."""
    along = np.cos(np.pi * wave * np.linspace(0.0, 1.0, len(trial.initial)))
    points = trial.initial.points + along[:, None] * error
    return replace(trial, initial=replace(trial.initial, points=points))


def _drifted(trial: Trial, late: bool, error: Floats) -> Trial:
    """Return a trial whose hands are off by an error (3,) [m] at their ends, or halfway."""
    def drifted(hand: Hand) -> Hand:
        share = (hand.times - hand.start) / max(hand.end - hand.start, 1e-9)
        weight = np.clip(2.0 * share - 1.0, 0.0, 1.0) if late else 1.0 - np.abs(2.0 * share - 1.0)
        return replace(hand, positions=hand.positions + weight[:, None] * error)
    return _with_hands(trial, drifted)


def gripping_beside(hand: Hand, chain: Chain, way: float) -> Hand:
    """Return a hand that grips a chain some way [m] farther along it, and otherwise does the same."""
    point, offset = chain.grip(grip_place(chain.arc_lengths(), hand.grips[0], hand.offset) + way)
    moved = chain.gripped((point,), offset) - chain.gripped(hand.grips[:1], hand.offset)
    return replace(hand, grips=(point,), offset=offset,
                   positions=hand.positions + hand.poses(hand.times)[1] @ moved[0])


def _all_beside(trial: Trial, way: float) -> Trial:
    """Return a trial whose hands grip some way [m] farther along the DLO; clamps grip where they did."""
    chain, places = trial.initial, trial.initial.arc_lengths()

    def beside(hand: Hand) -> Hand:
        if len(hand.grips) > 1:
            return hand
        place = grip_place(places, hand.grips[0], hand.offset)
        return gripping_beside(hand, chain, way if place + way <= places[-1] else -way)
    return _with_hands(trial, beside)


def _with_hands(trial: Trial, change: Callable[[Hand], Hand]) -> Trial:
    return replace(trial, actions=tuple(Action(tuple(map(change, action.hands)))
                                        for action in trial.actions))
