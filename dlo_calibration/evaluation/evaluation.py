# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Evaluation: the result of one parameter set on all trials; Evaluator: computes it."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Mapping, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.residuals import compared_rows, ResidualLayout
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import HANDS, of_session, ParameterSpace
from dlo_calibration.model.score import force_residuals, PointErrors, residuals, TrialScore
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.protocol import Job, Rollout, simulate_all, Simulator, Stop


@dataclass(frozen=True)
class Evaluation:
    """
    One parameter set tried on all trials (the paper calls it a round).

    :param index: 0, 1, ... in the order in which the search asked.
    :param point: (d,) in the box.
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


def mean_length(trials: Sequence[Trial]) -> float:
    """Return the mean length [m] of the initial chains of the trials."""
    return float(np.mean([trial.initial.length for trial in trials]))


def with_hands(trial: Trial, physical: Mapping[str, float]) -> Trial:
    """
    Return a trial with the hands where and when they really were.

    :param physical: parameters by name (SI units), of which those in HANDS are used.
    """
    late, *shift = (physical.get(name, 0.0) for name in HANDS)
    if any(shift):
        trial = trial.with_shifted_hands(np.array(shift))
    return trial.with_late_hands(late) if late else trial


class Evaluator:
    """
    Tries parameter sets on trials.

    :param every_goal: whether residuals are those of every goal, or only those of the `compared_goals`.
        Scores and errors are always those of every goal.
    """

    def __init__(self, trials: Sequence[Trial], space: ParameterSpace, simulator: Simulator,
                 every_goal: bool = True) -> None:
        self.trials = tuple(trials)
        self.space = space
        self.simulator = simulator
        self._rows = None if every_goal else compared_rows(trials)
        self._length = mean_length(trials)
        self._scores = tuple(TrialScore(trial) for trial in trials)
        # Most points that are tried together have the same errors of the hands.
        self._with_hands = lru_cache(maxsize=16)(self._trials_with_hands)

    def of(self, space: ParameterSpace) -> Evaluator:
        """Return an evaluator with other parameters."""
        other = copy.copy(self)  # shares what depends on the trials alone
        other.space = space
        return other

    @property
    def layout(self) -> ResidualLayout:
        """The layout of the residuals."""
        return ResidualLayout.of(self.trials) if self._rows is None else ResidualLayout.compared(self.trials)

    def evaluate(self, index: int, point: Floats) -> Evaluation:
        """Try a (d,) point of the box on every trial, in this thread."""
        return self.evaluated(index, point, simulate_all(self.simulator, self.jobs(point), Stop()))

    def jobs(self, point: Floats) -> list[Job]:
        """Return the jobs of a (d,) point of the box, one for each trial."""
        physical = self.space.physical(self.space.values(point), self._length)
        own = {session: of_session(physical, session)
               for session in sorted({trial.session for trial in self.trials})}
        errors = tuple((session, *(values.get(name, 0.0) for name in HANDS))
                       for session, values in own.items())
        return [(trial, own[trial.session]) for trial in self._with_hands(errors)]

    def _trials_with_hands(self, errors: tuple[tuple[float, ...], ...]) -> tuple[Trial, ...]:
        named = {session: dict(zip(HANDS, shifts, strict=True)) for session, *shifts in errors}
        return tuple(with_hands(trial, named[trial.session]) for trial in self.trials)

    def evaluated(self, index: int, point: Floats, outcomes: Sequence[Rollout | SimulationError]
                  ) -> Evaluation:
        """Return the evaluation of a (d,) point from the outcomes of its `jobs`."""
        evaluation = Evaluation(index, frozen_array(point), self.space.values(point))
        rollouts: list[Rollout] = []
        for rollout in outcomes:
            if isinstance(rollout, SimulationError):
                return replace(evaluation, failure=str(rollout),
                               skipped=len(self.trials) - len(rollouts) - 1)
            rollouts.append(rollout)
        evaluation = replace(
            evaluation, scores=tuple(float(score(rollout.chains))
                                     for score, rollout in zip(self._scores, rollouts, strict=True)),
            unsettled=tuple(trial.name for trial, rollout in zip(self.trials, rollouts, strict=True)
                            if not all(rollout.settled)))
        each = [residuals(trial, rollout.chains)
                for trial, rollout in zip(self.trials, rollouts, strict=True)]
        forces = [force_residuals(trial, rollout.forces)
                  for trial, rollout in zip(self.trials, rollouts, strict=True)]
        residual = np.concatenate([part for both in zip(each, forces, strict=True) for part in both])
        compared = residual if self._rows is None else residual[self._rows]
        return replace(evaluation, errors=PointErrors.of(np.concatenate(each)),
                       residuals=frozen_array(compared))
