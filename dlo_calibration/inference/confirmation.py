# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Confirmation: a second engine simulates the final parameter set, and both engines are compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.score import PointErrors

#: Two engines agree if their points of a trial are no further apart on average [m]: about the
#: discretisation error of nodes and time step, 0.43 mm on the reference objects (doc/physics.md).
DISTANCE_TOLERANCE = 0.5e-3


@dataclass(frozen=True)
class Confirmation:
    """
    The outcome of a second engine for the parameter set that was found with the first one.

    :param engine: the second engine's name.
    :param score: its average difference score over the trials [cm].
    :param scores: its difference score of each trial [cm].
    :param errors: its point errors against the observed chains.
    :param mean_distance: mean distance between the points of both engines, over all goals [m].
    :param max_distance: the largest of these distances [m].
    """

    engine: str
    score: float
    scores: tuple[float, ...]
    errors: PointErrors
    mean_distance: float
    max_distance: float


def disagreements(names: Sequence[str], chains: Sequence[Floats], others: Sequence[Floats],
                  scores: Sequence[float], other_scores: Sequence[float]) -> list[str]:
    """
    Return a phrase for each trial on which two engines disagree.

    :param names: of the trials.
    :param chains: (g, n, 3) [m] simulated points of each trial, by the first engine.
    :param others: the same by the second engine.
    :param scores: difference score of each trial, by the first engine.
    :param other_scores: the same by the second engine.
    """
    words = []
    for name, one, other, score, other_score in zip(
            names, chains, others, scores, other_scores, strict=True):
        distance = float(np.linalg.norm(one - other, axis=2).mean())
        # A difference of scores below 5 % or 0.1 cm is too small to prefer one parameter set to another.
        if distance > DISTANCE_TOLERANCE or abs(other_score - score) > max(0.1, 0.05 * score):
            words.append(f'{name}: points {distance * 1e3:.2f} mm apart on average, '
                         f'score {other_score:.2f} instead of {score:.2f}')
    return words
