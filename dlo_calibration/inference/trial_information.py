# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Trial information: how much more certain one trial makes the parameters, before any calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Sequence

import numpy as np

from dlo_calibration.evaluation.linearisation import information, standard_deviations
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.inference.examination import Examination
from dlo_calibration.inference.uncertainty import (
    IDENTIFIABLE,
    NOT_IDENTIFIABLE,
    prior_information,
    UNKNOWN_STD,
    WEAK,
)
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import knot_names, KNOTS, SCALE
from dlo_calibration.model.trial import Trial

#: A trial is informative if it reduces a standard deviation below this share; repeating one leaves 0.71.
NEW = 0.6


@dataclass(frozen=True, eq=False)
class TrialInformation:
    """
    How one trial changes the standard deviations of the parameters.

    :param trial: its name.
    :param names: of the d parameters.
    :param before: (d,) standard deviations without the trial, in the unit cube.
    :param after: (d,) standard deviations with the trial.
    :param verdicts: on each parameter, with the trial.
    :param problem: why they are unknown (nan); empty if they are known.
    """

    trial: str
    names: tuple[str, ...]
    before: Floats
    after: Floats
    verdicts: tuple[str, ...] = ()
    problem: str = ''

    def __post_init__(self) -> None:
        for name in ('before', 'after'):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    @classmethod
    def unknown(cls, trial: str, names: tuple[str, ...], problem: str) -> TrialInformation:
        """Return the information of a trial that could not be simulated: unknown."""
        nothing = np.full(len(names), np.nan)
        return cls(trial, names, nothing, nothing, problem=problem)

    @property
    def improved(self) -> tuple[str, ...]:
        """Names of the parameters that the trial makes more certain."""
        return tuple(name for name, before, after in zip(self.names, self.before, self.after, strict=True)
                     if after < NEW * before)

    @property
    def words(self) -> str:
        """One sentence for the user."""
        if self.problem:
            return f'the information of {self.trial} is unknown: {self.problem}'
        improved = self.improved
        if not improved:
            return f'{self.trial} adds nothing new: repeat it only to average noise{self._so_far}'
        knots = [name for name in self.names if name in knot_names(KNOTS[-1])]
        certain = [f'{name} (± {SCALE * before:.1f} -> ± {SCALE * after:.1f} of 100)'
                   for name, before, after in zip(self.names, self.before, self.after, strict=True)
                   if name in improved and name not in knots]
        rest = [name for name in self.names if name not in improved and name not in knots]
        if knots:  # up to 18 of them
            bent = sum(name in improved for name in knots)
            where = certain if bent else rest
            where.append(f'{bent} of {len(knots)} components of the rest shape' if bent else 'the rest shape')
        first, _, values = certain[0].partition(' (')
        certain[0] = f'{first} more certain' + (f' ({values}' if values else '')
        nothing = f'; it adds nothing about {", ".join(rest)}' if rest else ''
        return f'{self.trial} makes {", ".join(certain)}{nothing}{self._so_far}'

    @property
    def _so_far(self) -> str:
        """The verdicts in words; those on knots of a rest shape are left out."""
        told = []
        for verdict in (IDENTIFIABLE, WEAK, NOT_IDENTIFIABLE):
            names = [name for name, one in zip(self.names, self.verdicts, strict=False) if one == verdict
                     and name not in knot_names(KNOTS[-1])]
            told += [f'{verdict}: {", ".join(names)}'] * bool(names)
        return f'; so far {"; ".join(told)}' if told else ''

    @property
    def values(self) -> dict[str, Any]:
        """Standard deviations (0..100) and verdicts, under the keys of a status; empty if unknown."""
        if self.problem:
            return {}
        return {f'{key}_{name}': float(std) * SCALE for key, column in (
            ('std_before', self.before), ('std_after', self.after))
            for name, std in zip(self.names, column, strict=True)} | {
                f'verdict_{name}': one for name, one in zip(self.names, self.verdicts, strict=False)}


def std_of_each_alone(trials: Sequence[Trial], examination: Examination) -> Floats:
    """Return (T, d): the standard deviations in the unit cube that each calibrated trial would give alone."""
    scale, prior = examination.uncertainty.scale, prior_information(examination.jacobian.shape[1])
    return np.array([standard_deviations(information(examination.jacobian[rows], scale) + prior)
                     for rows in ResidualLayout.compared(trials).rows])


def uninformative(trials: Sequence[Trial], examination: Examination | None) -> tuple[str, ...]:
    """
    Return the names of the calibrated trials that say nothing about any parameter; () if that is unknown.

    Each of them alone would leave every standard deviation above 95 % of that of the prior.
    """
    if examination is None or not examination.regular:
        return ()
    return tuple(trial.name for trial, std in zip(trials, std_of_each_alone(trials, examination), strict=True)
                 if (std > 0.95 * UNKNOWN_STD).all())
