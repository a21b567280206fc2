# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Outlier: a trial that does not fit the others, because something happened that nobody described.

A trial may have larger errors because it shows more of the DLO.  So its errors are compared with how much
those of the others differ, after a fit without it.  Chaos multiplies the uncertainty of the parameters: a
sensitive trial is named, but it may be right.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Mapping

import numpy as np

from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.inference.uncertainty import at_minimum, predictive_std
from dlo_calibration.model.chain import Floats

LARGER = 1.5  # times the usual error: a trial is tried without if its error is at least so large
SURELY = 1.7  # times the usual error of the others
SPREAD, USUAL_SPREAD = 3.5, 0.12  # standard deviations of the logarithm of the others' errors; at least
#: What may be wrong with a trial that does not fit the others.
SOMETHING_ELSE = 'a hand may have slipped or let go early, or the DLO does there what the model does not know'


@dataclass(frozen=True)
class Outlier:
    """
    A trial that does not fit the others.

    :param trial: its name; `number` counts from 1.
    :param error: its mean point error with parameters from the others [m]; `usual` is the others' [m].
    :param values: the parameters without it, on the 0..100 scale.
    :param turned: whether its goal chains fit from the other end.
    :param decided: names of the parameters that it moves out of their intervals.
    :param spread: how far the uncertainty of the parameters, as the others determine them, moves its points
        on average [m].
    """

    trial: str
    number: int
    error: float
    usual: float
    values: Mapping[str, float]
    turned: bool
    decided: tuple[str, ...]
    spread: float = 0.0

    @property
    def sensitive(self) -> bool:
        """Whether the uncertainty of the parameters explains its error, so that nothing may be wrong."""
        return not self.turned and self.error < SURELY * math.hypot(self.usual, self.spread)


def candidate(errors: Floats) -> int | None:
    """Return the index of the trial that may be an outlier, or None, from (T,) mean point errors [m]."""
    if len(errors) < 3:  # of two trials, nothing says which is right
        return None
    k = int(np.argmax(errors))
    return k if errors[k] > LARGER * np.median(np.delete(errors, k)) else None


def is_outlier(k: int, errors: Floats) -> bool:
    """Tell whether trial k is an outlier, from the (T,) mean point errors [m] of a fit without it."""
    others = np.log(np.maximum(np.delete(errors, k), 1e-9))
    above = float(np.log(max(errors[k], 1e-9)) - others.mean())
    return above > max(math.log(SURELY), SPREAD * max(USUAL_SPREAD, float(others.std(ddof=1))))


def spread_without(k: int, layout: ResidualLayout, point: Floats, residuals: Floats, jacobian: Floats,
                   noise: float) -> float:
    """
    Return how far the uncertainty of the parameters without trial k moves its points, on average [m].

    :param layout: of the residuals of all trials.
    :param point: (d,) the optimum of the others, where their residuals are `residuals`, (m - m_k,) [m].
    :param jacobian: (m, d) derivative of the residuals of all trials [m per unit].
    :param noise: standard deviation of one measured coordinate [m].
    """
    own = layout.rows[k]
    fit = Linearisation(point, residuals, np.delete(jacobian, own, axis=0))
    covariance = at_minimum(fit, layout.without(k), noise=noise).covariance
    assert covariance is not None
    return float(predictive_std(jacobian[own], covariance).mean())
