# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The setting of a calibration, which all its stages share."""

from __future__ import annotations

from concurrent.futures import Executor
import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Callable

from dlo_calibration.calibration.choice import Choice, choose, chooses_parts, hand_error, hand_warnings
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.batch import BatchEvaluator
from dlo_calibration.evaluation.evaluation import Evaluation, Evaluator
from dlo_calibration.evaluation.log import Memory
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.evaluation.residuals import compared_rows
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.grips import GripEvidence
from dlo_calibration.observation.material import with_shared_places
from dlo_calibration.simulation.protocol import Simulator


@dataclass(frozen=True)
class Setting:
    """
    The trials, options, engine and callbacks that all stages of a calibration share.

    :param trials: at least one; what came after a hand has lost the DLO is left out, and those with the same
        points get the same rest arc lengths.
    :param options: open ones are decided from the trials, see `choice`.
    :param simulator: the engine.
    :param executor: its workers simulate; None: one thread.
    :param should_stop: polled; once it returns True, every stage ends with what it has so far.
    :param on_evaluation: called with each finished evaluation of the search, in the order asked.
    :param memory: rollouts and evaluations from before an interruption; every stage asks it first.
    """

    trials: tuple[Trial, ...]
    options: Options
    simulator: Simulator
    executor: Executor | None = None
    should_stop: Callable[[], bool] = lambda: False
    on_evaluation: Callable[[Evaluation], None] = lambda _: None
    memory: Memory = field(default_factory=Memory)
    evidence: GripEvidence = field(init=False)
    choice: Choice = field(init=False)

    def __post_init__(self) -> None:
        evidence = GripEvidence.of(self.trials)
        trials = evidence.require_usable(self.trials)
        object.__setattr__(self, 'evidence', evidence)
        object.__setattr__(self, 'choice', choose(trials, self.options, evidence))
        object.__setattr__(self, 'options', self.choice.options)
        object.__setattr__(self, 'trials', with_shared_places(trials))

    def weighing_forces(self, scale: tuple[float, float, float]) -> Setting:
        """Return the same setting, in whose trials forces count by another scale, see `Trial` [m/N]."""
        if scale == self.trials[0].force_scale:
            return self
        other = copy.copy(self)
        object.__setattr__(other, 'trials', tuple(replace(trial, force_scale=scale) for trial in self.trials))
        other.__dict__.pop('_evaluator', None)
        return other

    @property
    def hand_error(self) -> str:
        """An error of the hands that is not corrected, with a remedy; '' if there is none."""
        return hand_error(self.evidence, self.options)

    @property
    def hand_warnings(self) -> tuple[str, ...]:
        """Warnings about the hands: those that have lost the DLO, and errors of their stamps and places."""
        return (*map(str, self.evidence.losses),
                *hand_warnings(self.evidence, self.options, self.choice.corrected))

    @property
    def chooses_parts(self) -> bool:
        """Whether cross-validation over the trials chooses the number of parts."""
        return chooses_parts(self.trials, self.options)

    @cached_property
    def pool(self) -> Pool:
        """Simulates for all stages, until they are stopped."""
        return Pool(self.simulator, self.executor, self.should_stop, self.memory)

    def evaluate(self, space: ParameterSpace, trials: tuple[Trial, ...] | None = None,
                 finer: Pool | None = None) -> BatchEvaluator:
        """
        Return an evaluator of points of a space, by default with the setting's trials and engine.

        Its residuals are those of the compared goals.

        :param finer: simulates in place of the setting's pool.
        """
        pool = finer or self.pool
        evaluator = self._evaluator.of(space) if trials is None and finer is None else \
            Evaluator(trials or self.trials, space, pool.simulator, every_goal=False)
        return BatchEvaluator(evaluator, pool, self.memory.of(evaluator, finer is not None))

    @cached_property
    def _evaluator(self) -> Evaluator:
        return Evaluator(self.trials, self.options.space, self.simulator, every_goal=False)

    def judged(self, space: ParameterSpace, evaluation: Evaluation) -> Evaluation:
        """
        Return an evaluation with its residuals at every goal; if it has none, simulate it again.

        :raises SimulationError: if it cannot be simulated again.
        """
        return evaluation if compared_rows(self.trials) is None else self.simulated(space, evaluation)

    def simulated(self, space: ParameterSpace, evaluation: Evaluation) -> Evaluation:
        """
        Return the evaluation of the same point on every goal of the setting's trials.

        :raises SimulationError: if it cannot be simulated.
        """
        evaluator = Evaluator(self.trials, space, self.simulator)
        pool = Pool(self.simulator, self.executor, memory=self.memory)  # also after a stop
        point = evaluation.point
        repeated = evaluator.evaluated(evaluation.index, point, pool.simulate(evaluator.jobs(point)))
        if repeated.residuals is None:
            raise SimulationError(repeated.failure)
        return repeated
