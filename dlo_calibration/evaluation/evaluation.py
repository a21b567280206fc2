# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Evaluation: what one parameter set gave on all trials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Mapping

import numpy as np

from dlo_calibration.model.chain import Floats
from dlo_calibration.model.score import PointErrors


@dataclass(frozen=True)
class Evaluation:
    """
    One parameter set tried on all trials (the paper calls it a round).

    :param index: 0, 1, ... in the order asked.
    :param point: (d,) in the unit cube.
    :param values: free parameters on the 0..100 scale.
    :param scores: difference score of each trial; empty where it failed.
    :param errors: over all goal points; None where it failed.
    :param residuals: (m,) [m]; kept for the best evaluation only.
    :param unsettled: names of trials that never came to rest.
    :param failure: why it failed; empty where it did not.
    :param skipped: number of trials that were not simulated any more, as one before them failed.
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

    @property
    def score(self) -> float:
        """Average difference score over the trials [cm]; infinite where it failed."""
        return float(np.mean(self.scores)) if self.scores else float('inf')
