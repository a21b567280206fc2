# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Trial information: what one trial tells about the parameters, beside what is known without it.

The information of a trial is that of linear regression: J^T J / scale^2, with the
change J of its simulated chains with the parameters and the error of the
residuals.  Informations add up, from a prior that knows nothing but the scale's
ends, so that the standard deviations before and after a trial follow without a
calibration (Chaloner and Verdinelli, Bayesian Experimental Design: A Review,
1995, section 2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Sequence

import numpy as np

from dlo_calibration.evaluation.linearisation import information, standard_deviations
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.inference.advice import sensitivity
from dlo_calibration.inference.examination import Examination
from dlo_calibration.inference.uncertainty import unknown, UNKNOWN_STD
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import ParameterSpace, SCALE
from dlo_calibration.model.trial import Goal, shown_goals, Trial
from dlo_calibration.observation.estimate import start_point
from dlo_calibration.observation.excitation import excites
from dlo_calibration.observation.noise import noise
from dlo_calibration.simulation.protocol import Simulator

NEW = 0.6  # of the standard deviation is left at most, where a trial tells something; a repeat leaves 0.71
NOTHING = 0.95  # share of the standard deviation of what is not known at all that is left at least
# Until a result says better, a residual's error is that of a simulation with the right parameters and that
# of the noise [m], assumed where chains have too few points to tell; that many neighbours count as one.
SIMULATION_ERROR, ASSUMED_NOISE, ALIKE = 1e-3, 2e-3, 4.0


@dataclass(frozen=True)
class Knowledge:
    """
    What is known of d parameters, in the unit cube, after some trials.

    :param names: of the parameters.
    :param point: (d,) their values, as far as they are known.
    :param information: (d, d) inverse of their covariance.
    :param scale: error of one coordinate's residual as it counts, neighbours that err alike as one [m].
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

    def after(self, information: Floats) -> Knowledge:
        """Return what is known with a trial of that (d, d) information, too."""
        return replace(self, information=self.information + information)


@dataclass(frozen=True, eq=False)
class TrialInformation:
    """
    What one trial adds.

    :param trial: its name.
    :param names: of the d parameters.
    :param before: (d,) standard deviations without it, in the unit cube; `after` with it.
    :param problem: why they are not known (nan), in words; empty where they are.
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
        """Return that of a trial that could not be simulated."""
        nothing = np.full(len(names), np.nan)
        return cls(trial, names, nothing, nothing, problem)

    @property
    def told(self) -> tuple[str, ...]:
        """Names of the parameters that it tells something new about."""
        return tuple(name for name, before, after in zip(self.names, self.before, self.after, strict=True)
                     if after < NEW * before)

    @property
    def words(self) -> str:
        """The same in a sentence."""
        if self.problem:
            return f'what {self.trial} tells is not known: {self.problem}'
        told = self.told
        if not told:
            return f'{self.trial} adds nothing new: repeat it only to average noise'
        shown = [f'{name} (± {SCALE * before:.1f} -> ± {SCALE * after:.1f} of 100)'
                 for name, before, after in zip(self.names, self.before, self.after, strict=True)
                 if name in told]
        rest = ', '.join(name for name in self.names if name not in told)
        return f'{self.trial} tells {", ".join(shown)}' + (f'; nothing new about {rest}' if rest else '')

    @property
    def values(self) -> dict[str, Any]:
        """The standard deviations on the 0..100 scale, by the keys of a status; empty where not known."""
        if self.problem:
            return {}
        return {f'{key}_{name}': float(std) * SCALE for key, column in (
            ('std_before', self.before), ('std_after', self.after))
            for name, std in zip(self.names, column, strict=True)}


def knowledge(trials: Sequence[Trial], space: ParameterSpace, table_height: float | None,
              best: Floats | None = None, examination: Examination | None = None) -> Knowledge:
    """
    Return what is known without the trials that were not calibrated on.

    That is what a calibration found, and its covariance where that holds.  Without a
    calibration, the values that the chains alone say, or the defaults.

    :param table_height: [m]; None where there is no table.
    :param best: (d,) what a calibration of the same parameters found; None: there was none.
    :param examination: of that; None where there was no time for it.
    """
    if best is not None and examination is not None and examination.regular:
        found = examination.uncertainty
        assert found.covariance is not None
        return Knowledge(space.free, best, np.asarray(np.linalg.inv(found.covariance)), found.scale)
    if best is None:
        start = start_point(trials, space, table_height)
        best = np.where(np.isnan(start), space.default_point(), start)
    rough = noise(trials)
    residual = np.hypot(ASSUMED_NOISE if np.isnan(rough) else rough, SIMULATION_ERROR)
    return Knowledge(space.free, best, unknown(space.dimension), float(residual * np.sqrt(ALIKE)))


def glimpse(trial: Trial) -> Trial:
    """
    Return a trial with those goals only that tell something of their own.

    Of goals of the same rest, the first; of those in motion, some, evenly spread.
    What is left does not change while a tracker goes on to show a DLO at rest.
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


def simulated_information(trial: Trial, known: Knowledge, space: ParameterSpace, simulator: Simulator,
                          length: float, table_height: float | None) -> Floats:
    """
    Return the (d, d) information of one trial, simulated beside what is known.

    A parameter that the trial surely cannot show is not simulated.

    :param length: of the DLO [m].
    :param table_height: [m]; None where there is no table.
    :raises SimulationError: where it cannot be simulated.
    """
    shown = excites([trial], space, table_height)[0]
    matrix = sensitivity(glimpse(trial), space, simulator, known.point, known.std, length,
                         shown=shown, at_rest=False)
    return information(matrix, known.scale)


def told_by(trials: Sequence[Trial], examination: Examination) -> Floats:
    """Return (T, d) standard deviations in the unit cube that each calibrated trial alone would give."""
    scale, prior = examination.uncertainty.scale, unknown(examination.jacobian.shape[1])
    return np.array([standard_deviations(information(examination.jacobian[rows], scale) + prior)
                     for rows in ResidualLayout.of(trials).rows])


def silent(trials: Sequence[Trial], examination: Examination | None) -> tuple[str, ...]:
    """Return the names of the trials of a calibration that told nothing; none where that is not known."""
    if examination is None or not examination.regular:
        return ()
    return tuple(trial.name for trial, std in zip(trials, told_by(trials, examination), strict=True)
                 if (std > NOTHING * UNKNOWN_STD).all())
