# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Sentences: a prediction in plain English."""

from __future__ import annotations

from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Chain, Floats, grip_place
from dlo_calibration.model.quantity import measured, number
from dlo_calibration.planning.prediction import PredictedStep, Prediction
from dlo_calibration.report.plan_sentences import FLAT


def prediction_sentences(prediction: Prediction) -> list[str]:
    """Return a sentence for each action, and the remarks."""
    return [*(f'{k}. {step.name}: {_hands(prediction.start, step)}; then the first point is at '
              f'{_place(step.chain[0])} m, the last one at {_place(step.chain[-1])} m, and the 90 % '
              f'intervals are {width(step)} wide on average'
              f'{"" if step.settled else "; the DLO did not come to rest"}.'
              for k, step in enumerate(prediction.steps, start=1)), *prediction.remarks]


def width(step: PredictedStep) -> str:
    """Say how wide the 90 % interval of a coordinate is, on average over all points."""
    return measured(float((step.upper - step.lower).mean()), 'm')


def _hands(start: Chain, step: PredictedStep) -> str:
    """Say what the hands do."""
    return '; '.join(_hand(start, hand, step) for hand in step.step.action.hands)


def _hand(start: Chain, hand: Hand, step: PredictedStep) -> str:
    """Say what a hand does."""
    places, rise = start.arc_lengths(), float(hand.positions[:, 2].max() - hand.positions[0, 2])
    after = 'holds it' if hand.name in step.step.held_by else 'opens'
    if len(hand.times) == 1:
        return f'{hand.name} {after}'
    way = f'lifts {number(100 * rise)} cm, carries' if rise > FLAT else 'moves'
    grip = grip_place(places, hand.grips[0], hand.offset) / places[-1]
    return (f'{hand.name} grips at {grip:.2f} of the length, {way} it to '
            f'{_place(hand.positions[-1])} m and {after}')


def _place(point: Floats) -> str:
    """Return a place (3,) [m] in words."""
    return f'({", ".join(f"{one:.3f}" for one in point.round(3) + 0.0)})'  # no -0.000
