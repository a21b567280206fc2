# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Confirmation: the final parameter set simulated by a second engine, and how far the two agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.score import PointErrors

#: Mean distance [m] between two engines' points of a trial from which on they disagree: about the
#: error of nodes and time step themselves, 0.43 mm on the reference objects (doc/physics.md).
DISTANCE_TOLERANCE = 0.5e-3
#: A score may differ by that share of it, and by that much [cm]: less than that decides between no two sets.
SCORE_SHARE, SCORE_TOLERANCE = 0.05, 0.1


@dataclass(frozen=True)
class Confirmation:
    """
    What a second engine gives for the parameter set that a first one found.

    :param engine: the second engine's name.
    :param score: its average difference score over the trials [cm].
    :param scores: its difference score of each trial [cm].
    :param errors: its point errors against the observed chains.
    :param mean_distance: between both engines' points, over all goals [m].
    :param max_distance: the largest of those [m].
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
    :param others: by the second engine.
    :param scores: difference score of each trial, by the first engine.
    :param other_scores: by the second engine.
    """
    words = []
    for name, one, other, score, other_score in zip(
            names, chains, others, scores, other_scores, strict=True):
        distance = float(np.linalg.norm(one - other, axis=2).mean())
        apart = abs(other_score - score)
        if distance > DISTANCE_TOLERANCE or apart > max(SCORE_TOLERANCE, SCORE_SHARE * score):
            words.append(f'{name}: points {distance * 1e3:.2f} mm apart on average, '
                         f'score {other_score:.2f} instead of {score:.2f}')
    return words
