# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The setting of a calibration, which all its stages share."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import cached_property
from typing import Callable

from dlo_calibration.calibration.automatic import choose, chooses_parts
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.batch import BatchEvaluator
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.evaluator import Evaluator
from dlo_calibration.evaluation.memory import Memory
from dlo_calibration.evaluation.pool import Pool
from dlo_calibration.evaluation.residuals import compared_rows
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.rest_lengths import with_shared_places
from dlo_calibration.simulation.protocol import Simulator


@dataclass(frozen=True)
class Setting:
    """
    The trials, options, engine and callbacks that all stages of a calibration share.

    :param trials: to calibrate on, at least one; those with the same points get the same rest arc lengths.
    :param options: those that are open are decided from the trials.
    :param simulator: the engine.
    :param executor: its workers simulate; None: one thread.
    :param should_stop: asked often; once True, every stage ends with what it has so far.
    :param on_evaluation: called with each finished evaluation of the search, in the order asked.
    :param memory: what was simulated before an interruption; every stage asks it first.
    """

    trials: tuple[Trial, ...]
    options: Options
    simulator: Simulator
    executor: Executor | None = None
    should_stop: Callable[[], bool] = lambda: False
    on_evaluation: Callable[[Evaluation], None] = lambda _: None
    memory: Memory = field(default_factory=Memory)

    def __post_init__(self) -> None:
        object.__setattr__(self, 'trials', with_shared_places(self.trials))
        object.__setattr__(self, 'options', choose(self.trials, self.options).options)

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
        if trials is None and finer is None:
            return self._usual.of(space, self.memory)
        pool = finer or self.pool
        evaluator = Evaluator(trials or self.trials, space, pool.simulator, every_goal=False)
        return BatchEvaluator(evaluator, pool, self.memory.of(evaluator, finer is not None))

    @cached_property
    def _usual(self) -> BatchEvaluator:
        return BatchEvaluator(Evaluator(self.trials, self.options.space, self.simulator, every_goal=False),
                              self.pool)

    def judged(self, space: ParameterSpace, one: Evaluation) -> Evaluation:
        """
        Return an evaluation with its residuals at every goal: it is simulated again if they were not kept.

        :raises SimulationError: if it cannot be simulated again.
        """
        if compared_rows(self.trials) is None:
            return one
        evaluator = Evaluator(self.trials, space, self.simulator)
        pool = Pool(self.simulator, self.executor, memory=self.memory)  # also after a stop
        found = evaluator.evaluated(one.index, one.point, pool.simulate(evaluator.jobs(one.point)))
        if found.residuals is None:
            raise SimulationError(found.failure)
        return found
