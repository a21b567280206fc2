# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Evaluation: the result of one parameter set on all trials."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Mapping

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.score import PointErrors


@dataclass(frozen=True)
class Evaluation:
    """
    One parameter set tried on all trials (the paper calls it a round).

    :param index: 0, 1, ... in the order in which the search asked.
    :param point: (d,) in the unit cube.
    :param values: free parameters on the 0..100 scale.
    :param scores: difference score of each trial [cm]; empty if the evaluation failed.
    :param errors: over all points of all goals; None if the evaluation failed.
    :param residuals: (m,) [m] at the goals that the evaluator compares; kept for the best evaluation only.
    :param unsettled: names of the trials in which the DLO never came to rest.
    :param failure: why the evaluation failed; empty if it did not.
    :param skipped: number of trials that were not simulated because an earlier one failed.
    """

    index: int
    point: Floats
    values: Mapping[str, float]
    scores: tuple[float, ...] = ()
    errors: PointErrors | None = None
    residuals: Floats | None = None
    unsettled: tuple[str, ...] = ()
    failure: str = ''
    skipped: int = 0

    @cached_property
    def score(self) -> float:
        """Average difference score over the trials [cm]; infinite if the evaluation failed."""
        return float(np.mean(self.scores)) if self.scores else float('inf')
