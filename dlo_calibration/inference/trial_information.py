# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Gain: what one trial tells of the parameters, beside what is known without it.

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

from dlo_calibration.inference.advice import sensitivity
from dlo_calibration.inference.outcome import Calibrated
from dlo_calibration.inference.uncertainty import UNKNOWN_STD
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import ParameterSpace, SCALE
from dlo_calibration.model.trial import Goal, shown_goals, Trial
from dlo_calibration.observation.estimate import start_point
from dlo_calibration.observation.excitation import excites
from dlo_calibration.observation.noise import noise
from dlo_calibration.simulation.protocol import Simulator

NEW = 0.6  # share of the standard deviation that is left, at most, where a trial tells something: a repeat of
# a trial leaves 0.71
NOTHING = 0.95  # share of the standard deviation of what is not known at all that is left at least
MODEL_ERROR = 1e-3  # m, of a simulation with the right parameters, until a result says better
UNKNOWN_NOISE = 2e-3  # m, of chains with too few points to tell
ALIKE = 4.0  # neighbouring residuals that count as one, until a result says better


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
        return np.sqrt(np.diag(np.linalg.inv(self.information)))

    def after(self, information: Floats) -> Knowledge:
        """Return what is known with a trial of that (d, d) information, too."""
        return replace(self, information=self.information + information)


@dataclass(frozen=True, eq=False)
class Gain:
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
    def unknown(cls, trial: str, names: tuple[str, ...], problem: str) -> Gain:
        """Return the gain of a trial that could not be simulated."""
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
              result: Calibrated | None = None) -> Knowledge:
    """
    Return what is known without the trials that `result` does not have.

    With a result, its values, and its covariance where that holds.  Without one,
    the values that the chains alone say, or the defaults.

    :param table_height: [m]; None where there is no table.
    :param result: of the same parameters; None: there is none.
    """
    if result is not None and covers(result):
        assert result.examination is not None
        found = result.examination.uncertainty
        assert found.covariance is not None
        return Knowledge(space.free, result.best.point, frozen_array(np.linalg.inv(found.covariance)),
                         found.scale)
    if result is not None:
        point = result.best.point
    else:
        start = start_point(trials, space, table_height)
        point = np.where(np.isnan(start), space.default_point(), start)
    rough = noise(trials)
    residual = np.hypot(UNKNOWN_NOISE if np.isnan(rough) else rough, MODEL_ERROR)
    return Knowledge(space.free, point, frozen_array(np.eye(space.dimension) / UNKNOWN_STD**2),
                     float(residual * np.sqrt(ALIKE)))


def covers(result: Calibrated) -> bool:
    """Tell whether a result says what is known after its trials."""
    found = result.examination
    return found is not None and found.regular and found.uncertainty.covariance is not None


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


def information(trial: Trial, known: Knowledge, space: ParameterSpace, simulator: Simulator, length: float,
                table_height: float | None) -> Floats:
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
    return np.asarray(matrix.T @ matrix / known.scale**2)


def told_by(result: Calibrated) -> Floats:
    """
    Return (T, d) standard deviations in the unit cube: what each trial of a result would tell alone.

    :raises ValueError: for a result that was not examined.
    """
    found = result.examination
    if found is None:
        raise ValueError('the result was not examined')
    rows, at = [], 0
    for trial in result.trials:
        end = at + 3 * len(trial.goals) * len(trial.initial)
        matrix = found.jacobian[at:end]
        alone = matrix.T @ matrix / found.uncertainty.scale**2 + np.eye(matrix.shape[1]) / UNKNOWN_STD**2
        rows.append(np.sqrt(np.diag(np.linalg.inv(alone))))
        at = end
    return np.array(rows)


def silent(result: Calibrated) -> tuple[str, ...]:
    """Return the names of the trials of a result that told nothing at all; none where that is not known."""
    if not covers(result):
        return ()
    return tuple(trial.name for trial, std in zip(result.trials, told_by(result), strict=True)
                 if (std > NOTHING * UNKNOWN_STD).all())
