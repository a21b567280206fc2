# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Evaluator: tries one parameter set on all trials."""

from __future__ import annotations

from concurrent.futures import CancelledError
import copy
from dataclasses import replace
from itertools import islice
from typing import Callable, Iterable, Mapping, Sequence

import numpy as np

from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.residuals import compared_rows, ResidualLayout
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.score import PointErrors, TrialScore
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.protocol import Rollout, simulate_all, Simulator


def mean_length(trials: Sequence[Trial]) -> float:
    """Return the mean length [m] of the initial chains of the trials."""
    return float(np.mean([trial.initial.length for trial in trials]))


class Evaluator:
    """
    Tries parameter sets on trials.

    Worker processes get a pickled one and worker threads a copy; see `Simulator`.

    :param every_goal: whether its residuals are those of every goal; if not, they are those of the
        `compared_goals`. Scores and errors are always those of every goal.
    """

    def __init__(self, trials: Sequence[Trial], space: ParameterSpace, simulator: Simulator,
                 every_goal: bool = True) -> None:
        self.trials = tuple(trials)
        self.space = space
        self.simulator = simulator
        self._rows = None if every_goal else compared_rows(trials)
        self._length = mean_length(trials)
        self._scores = tuple(TrialScore(trial) for trial in trials)

    def __copy__(self) -> Evaluator:
        """Return an evaluator with a simulator of its own."""
        return self._with(simulator=copy.copy(self.simulator))

    def of(self, space: ParameterSpace) -> Evaluator:
        """Return an evaluator with other parameters."""
        return self._with(space=space)

    def _with(self, **changes: object) -> Evaluator:
        other = Evaluator.__new__(Evaluator)
        vars(other).update({**vars(self), **changes})  # what belongs to the trials never changes
        return other

    @property
    def layout(self) -> ResidualLayout:
        """The order of its residuals."""
        return ResidualLayout.of(self.trials) if self._rows is None else ResidualLayout.compared(self.trials)

    def simulate(self, values: Mapping[str, float]) -> list[Rollout]:
        """Simulate every trial with free parameters on the 0..100 scale."""
        physical = self.space.physical(values, self._length)
        return [self.simulator.simulate(trial, physical) for trial in self.trials]

    def evaluate(self, index: int, point: Floats,
                 should_stop: Callable[[], bool] = lambda: False) -> Evaluation:
        """
        Try a (d,) point of the unit cube on every trial.

        :raises CancelledError: if `should_stop` is True before a trial.
        """
        return self.evaluate_all([(index, point)], should_stop)[0]

    def evaluate_all(self, points: Sequence[tuple[int, Floats]],
                     should_stop: Callable[[], bool] = lambda: False) -> list[Evaluation]:
        """
        Try points of the unit cube, each with its index; to some simulators, several at a time are less work.

        :raises CancelledError: if `should_stop` is True before a trial.
        """
        def between() -> None:
            if should_stop():
                raise CancelledError

        begun = [Evaluation(index, frozen_array(point), self.space.values(point)) for index, point in points]
        jobs = [[(trial, physical) for trial in self.trials]
                for physical in (self.space.physical(one.values, self._length) for one in begun)]
        if len(begun) == 1:  # a failure ends it
            return [self._evaluated(begun[0], simulate_all(self.simulator, jobs[0], between))]
        rollouts = simulate_all(self.simulator, [job for one in jobs for job in one], between)
        return [self._evaluated(one, list(islice(rollouts, len(self.trials)))) for one in begun]

    def _evaluated(self, evaluation: Evaluation, found: Iterable[Rollout | SimulationError]) -> Evaluation:
        """Return an evaluation with what its rollouts tell."""
        rollouts: list[Rollout] = []
        for rollout in found:
            if isinstance(rollout, SimulationError):
                return replace(evaluation, failure=str(rollout),
                               skipped=len(self.trials) - len(rollouts) - 1)
            rollouts.append(rollout)
        evaluation = replace(
            evaluation, scores=tuple(float(score(rollout.chains))
                                     for score, rollout in zip(self._scores, rollouts, strict=True)),
            unsettled=tuple(trial.name for trial, rollout in zip(self.trials, rollouts, strict=True)
                            if not all(rollout.settled)))
        residual = np.concatenate([score.residuals(rollout.chains)
                                   for score, rollout in zip(self._scores, rollouts, strict=True)])
        kept = residual if self._rows is None else residual[self._rows]
        return replace(evaluation, errors=PointErrors.of(residual), residuals=frozen_array(kept))
