# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Together: pairs of parameters of which trials tell a ratio or product much better than each alone."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Sequence

import numpy as np

from dlo_calibration.inference.uncertainty import DEVIATIONS
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import BY_NAME, extents, number

CORRELATED = 0.943  # from here on, knowing one makes the other three times as certain
SHARP = 0.1  # a parameter that is known to 10 % needs no other
EXACT = 0.15  # an exponent this near to 1 is 1: a ratio or a product


@dataclass(frozen=True)
class Together:
    """
    Two parameters that are known only together.

    `first` times the power `exponent` of `second` is known to `known`: half its 90 % interval, as a share.

    :param alone: the same for both parameters by themselves.
    """

    first: str
    second: str
    exponent: float
    known: float
    alone: tuple[float, float]

    @property
    def formula(self) -> str:
        """The ratio or product, e.g. ``flexibility / friction``."""
        power = abs(self.exponent)
        other = self.second if power == 1 else f'{self.second}^{power:.1f}'
        return f'{self.first} {"/" if self.exponent < 0 else "*"} {other}'

    @property
    def words(self) -> str:
        """The pair in one sentence."""
        first, second = (f'{_percent(share)}' for share in self.alone)
        alone = f'each alone only to {first}' if first == second else \
            f'{self.first} alone only to {first}, {self.second} to {second}'
        return f'{self.formula}, in physical values, is known to {_percent(self.known)}, {alone}.'


def known_together(names: Sequence[str], covariance: Floats, deviations: Floats) -> tuple[Together, ...]:
    """
    Return the pairs of parameters that are known only together, the best known one first.

    :param covariance: (d, d) near the optimum, in units of a search.
    :param deviations: (d,) standard deviations of each alone, which may be larger.
    """
    scales = np.array([0.0 if BY_NAME[name].linear else
                       np.log(BY_NAME[name].at_hundred / BY_NAME[name].at_zero) for name in names])
    scales = scales / extents(names)
    physical = covariance * np.outer(scales, scales)  # of the logarithms
    std = np.sqrt(np.diag(physical))
    alone, pairs = _share(np.abs(scales) * deviations), []
    for k, other in combinations(np.flatnonzero(alone > SHARP).tolist(), 2):
        if abs(physical[k, other]) < CORRELATED * std[k] * std[other]:
            continue
        exponent = -float(physical[k, other] / physical[other, other])
        exponent = float(np.sign(exponent)) if abs(abs(exponent) - 1) < EXACT else round(exponent, 1)
        ways = np.array([1.0, exponent])
        known = float(np.sqrt(ways @ physical[np.ix_([k, other], [k, other])] @ ways))
        if exponent and 2 * known < min(std[k], std[other]):
            pairs.append(Together(names[k], names[other], exponent, float(_share(known)),
                                  (float(alone[k]), float(alone[other]))))
    return tuple(sorted(pairs, key=lambda pair: pair.known))


def _share(std: Floats | float) -> Floats:
    """Return half the 90 % interval of a value, as a share of it, from the deviation of its logarithm."""
    return np.asarray(np.expm1(DEVIATIONS * np.asarray(std)))


def _percent(share: float) -> str:
    return f'{number(float(f"{100 * share:.2g}"))} %' if share < 1 else f'a factor of {number(1 + share)}'
