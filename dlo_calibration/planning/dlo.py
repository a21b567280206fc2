# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The calibrated DLO that predictions and plans are made for, and the draws from its posterior."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Mapping, Protocol, Sequence

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import ParameterEstimate
from dlo_calibration.model.chain import Chain, Floats, frozen_array
from dlo_calibration.model.parameters import ParameterSpace, SCALE
from dlo_calibration.model.score import PointErrors
from dlo_calibration.observation.table import lying_level

Z90 = 1.6449  # standard deviations from the middle of a normal distribution to an end of its 90 % interval
INTERVAL = (5.0, 95.0)  # %


class CalibratedDlo(Protocol):
    """The part of a `CalibrationResult`, or of a `Description` from a result file, that predictions need."""

    @property
    def space(self) -> ParameterSpace:
        """The calibrated parameters, and the values of the others."""

    @property
    def parameters(self) -> Mapping[str, ParameterEstimate]:
        """The calibrated parameters by name, in the order of `space.free`."""

    @property
    def length(self) -> float:
        """Mean length of the DLO over the trials [m]."""

    @property
    def errors(self) -> PointErrors:
        """Point errors of the fit."""

    @property
    def correlations(self) -> Mapping[str, Mapping[str, float]] | None:
        """Correlation of each pair of calibrated parameters; None if it is unknown."""


@dataclass(frozen=True)
class Posterior:
    """
    The distribution of the parameters of a calibrated DLO.

    Each parameter is normal to either side of its value, so that 90 % of its draws lie in the interval of
    the result; draws beyond the scale are moved to its end.

    :param space: the calibrated parameters, and the values of the others.
    :param length: of the DLO [m].
    :param values: (d,) best values on the 0..100 scale, in the order of `space.free`.
    :param below: (d,) standard deviation below them; `above` (d,) above them.
    :param correlations: (d, d).
    :param thickest: largest self-collision radius [m] of a draw.
    """

    space: ParameterSpace
    length: float
    values: Floats
    below: Floats
    above: Floats
    correlations: Floats
    thickest: float = np.inf

    @classmethod
    def of(cls, dlo: CalibratedDlo) -> Posterior:
        """Return the posterior of a calibrated DLO."""
        names, given = dlo.space.free, dlo.correlations
        values, lower, upper = (np.array([getattr(dlo.parameters[name], end) for name in names])
                                for end in ('value', 'lower', 'upper'))
        correlations = np.eye(len(names)) if given is None else np.array(
            [[given[name][other] for other in names] for name in names])
        return cls(dlo.space, dlo.length, frozen_array(values),
                   frozen_array(np.maximum(values - lower, 0) / Z90),
                   frozen_array(np.maximum(upper - values, 0) / Z90),
                   frozen_array(np.where(np.isfinite(correlations), correlations, np.eye(len(names)))))

    def lying(self, chain: Chain, simulation: Options) -> Posterior:
        """
        Return the distribution for a DLO that was observed lying on the table.

        The height at which it lies bounds its radius: trials in which it does not touch itself leave the
        radius open, and a draw with a far larger one would push its parts away from each other.
        """
        level = lying_level(chain, simulation.table_height) if simulation.table else None
        if level is None:
            return self
        return replace(self, thickest=max(level - simulation.table_height, self.best['self_collision']))

    @property
    def best(self) -> dict[str, float]:
        """Best physical values of all parameters, in SI units."""
        return self._physical(self.values)

    def draws(self, count: int, seed: int) -> list[dict[str, float]]:
        """Return physical values of all parameters, in SI units, at `count` draws with a random seed."""
        physical = [self._physical(values) for values in self.drawn_values(count, seed)]
        return [{**draw, 'self_collision': min(draw['self_collision'], self.thickest)} for draw in physical]

    def drawn_values(self, count: int, seed: int) -> Floats:
        """Return (count, d) values on the 0..100 scale, drawn with a random seed."""
        normal = self.standard_draws(count, seed)
        return np.clip(self.values + normal * np.where(normal < 0, self.below, self.above), 0.0, SCALE)

    def standard_draws(self, count: int, seed: int) -> Floats:
        """Return (count, d) standard normal draws with the correlations."""
        variances, axes = np.linalg.eigh(self.correlations)
        normal = np.random.default_rng(seed).standard_normal((count, len(self.values)))
        return np.asarray(normal * np.sqrt(np.maximum(variances, 0)) @ axes.T)

    def _physical(self, values: Floats) -> dict[str, float]:
        named = dict(zip(self.space.free, map(float, values), strict=True))
        return self.space.physical(named, self.length)


def intervals(best: Floats, drawn: Sequence[Floats], error: float,
              finer: Floats | None = None) -> tuple[Floats, Floats]:
    """
    Return the lower and upper ends of the 90 % intervals of predicted values, both like `best`.

    They contain the spread of the draws, the residual error of the calibration (noise and model error), and
    the difference to a finer simulation.  These are independent, so their half widths add as squares.

    :param best: (..., 3) with the best parameters.
    :param drawn: the same with draws from the posterior.
    :param error: residual error of the calibration: standard deviation of one value.
    :param finer: like `best`, from a finer simulation; None: there is none.
    """
    everything = np.stack([best, *drawn])
    below, above = best - np.percentile(everything, INTERVAL, axis=0)
    residual = (Z90 * error)**2 + (0.0 if finer is None else (finer - best)**2)
    return (best - np.sqrt(np.maximum(below, 0)**2 + residual),
            best + np.sqrt(np.minimum(above, 0)**2 + residual))
