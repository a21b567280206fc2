# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Trial information: how much more certain one trial makes the parameters, before any calibration.

The information of a trial is that of linear regression: J^T J / scale^2, with the
derivative J of its simulated chains and the error of the residuals.  It is added
to the information of the trials before it; the prior is uniform on the scale.
The standard deviations before and after a trial follow without a calibration
(Chaloner and Verdinelli, Bayesian Experimental Design: A Review, 1995, section 2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Sequence

import numpy as np

from dlo_calibration.evaluation.linearisation import information, standard_deviations
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.inference.advice import sensitivity
from dlo_calibration.inference.examination import Examination
from dlo_calibration.inference.uncertainty import prior_information, UNKNOWN_STD
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import knot_names, KNOTS, ParameterSpace, SCALE
from dlo_calibration.model.trial import Goal, shown_goals, Trial
from dlo_calibration.observation.estimate import start_point
from dlo_calibration.observation.excitation import excites
from dlo_calibration.observation.noise import noise
from dlo_calibration.simulation.protocol import Simulator

#: A trial is informative if it reduces a standard deviation below this share; repeating one leaves 0.71.
NEW = 0.6


@dataclass(frozen=True)
class Posterior:
    """
    The posterior of d parameters after some trials, in the unit cube.

    :param names: of the parameters.
    :param point: (d,) their estimated values.
    :param information: (d, d) inverse of their covariance.
    :param scale: standard deviation of one coordinate's residual, enlarged because neighbouring residuals
        are correlated [m].
    """

    names: tuple[str, ...]
    point: Floats
    information: Floats
    scale: float

    def __post_init__(self) -> None:
        for name in ('point', 'information'):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    @property
    def std(self) -> Floats:
        """(d,) standard deviations."""
        return standard_deviations(self.information)

    def after(self, information: Floats) -> Posterior:
        """Return the posterior after one more trial, which has that (d, d) information."""
        return replace(self, information=self.information + information)


@dataclass(frozen=True, eq=False)
class TrialInformation:
    """
    How one trial changes the standard deviations of the parameters.

    :param trial: its name.
    :param names: of the d parameters.
    :param before: (d,) standard deviations without the trial, in the unit cube.
    :param after: (d,) standard deviations with the trial.
    :param problem: why they are unknown (nan); empty if they are known.
    """

    trial: str
    names: tuple[str, ...]
    before: Floats
    after: Floats
    problem: str = ''

    def __post_init__(self) -> None:
        for name in ('before', 'after'):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    @classmethod
    def unknown(cls, trial: str, names: tuple[str, ...], problem: str) -> TrialInformation:
        """Return the information of a trial that could not be simulated: unknown."""
        nothing = np.full(len(names), np.nan)
        return cls(trial, names, nothing, nothing, problem)

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
            return f'{self.trial} adds nothing new: repeat it only to average noise'
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
        return f'{self.trial} makes {", ".join(certain)}{nothing}'

    @property
    def values(self) -> dict[str, Any]:
        """Standard deviations on the 0..100 scale, under the keys of a status; empty if they are unknown."""
        if self.problem:
            return {}
        return {f'{key}_{name}': float(std) * SCALE for key, column in (
            ('std_before', self.before), ('std_after', self.after))
            for name, std in zip(self.names, column, strict=True)}


def posterior(trials: Sequence[Trial], space: ParameterSpace, table_height: float | None,
              best: Floats | None = None, examination: Examination | None = None) -> Posterior:
    """
    Return what is known before the trials that were not calibrated yet.

    After a calibration, these are the values that it found, with their covariance if it is valid.
    Without one, they are the values estimated from the chains alone, or the defaults.

    :param table_height: [m]; None if there is no table.
    :param best: (d,) the values that a calibration of the same parameters found; None: there was none.
    :param examination: of that calibration; None if it had no time for one.
    """
    if best is not None and examination is not None and examination.regular:
        found = examination.uncertainty
        assert found.covariance is not None
        return Posterior(space.free, best, np.asarray(np.linalg.inv(found.covariance)), found.scale)
    if best is None:
        start = start_point(trials, space, table_height)
        best = np.where(np.isnan(start), space.default_point(), start)
    # Before a calibration, a residual is noise (2 mm if it cannot be estimated) and the error of a simulation
    # with the right parameters (1 mm); four neighbours are assumed to count as one.
    level = noise(trials)
    residual = np.hypot(2e-3 if np.isnan(level) else level, 1e-3)
    return Posterior(space.free, best, prior_information(space.dimension), float(residual * np.sqrt(4.0)))


def without_repeated_goals(trial: Trial) -> Trial:
    """
    Return a trial without the goals that add little.

    Of several goals of the same DLO at rest, the first stays; of those in motion, a few stay, evenly spread.
    The outcome does not change while a tracker continues to show a DLO at rest.
    """
    goals: list[Goal] = []
    moving = [goal for goal in trial.goals if not goal.stable]
    shown = {id(moving[k]) for k in shown_goals(len(moving))} if moving else set()
    rests = set()
    for goal in trial.goals:
        rest = (sum(hand.start <= goal.time for hand in trial.hands), goal.held_by)
        if id(goal) in shown or goal.stable and rest not in rests:
            goals.append(goal)
            if goal.stable:
                rests.add(rest)
    return replace(trial, goals=tuple(goals))


def simulated_information(trial: Trial, known: Posterior, space: ParameterSpace, simulator: Simulator,
                          length: float, table_height: float | None) -> Floats:
    """
    Return the (d, d) information of one trial, from simulations around the known values.

    A parameter that the trial certainly cannot show is not varied.

    :param length: of the DLO [m].
    :param table_height: [m]; None if there is no table.
    :raises SimulationError: if the trial cannot be simulated.
    """
    shown = excites([trial], space, table_height)[0]
    matrix = sensitivity(without_repeated_goals(trial), space, simulator, known.point, known.std, length,
                         shown=shown, at_rest=False)
    return information(matrix, known.scale)


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
