# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""simulate(): predict a calibrated DLO in a sequence of actions, with 90 % intervals."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Callable, Mapping, Sequence, Union

import numpy as np

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import with_nulls
from dlo_calibration.errors import InputError, SimulationError
from dlo_calibration.evaluation.pool import Pool, Threads
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain, Floats, frozen_array
from dlo_calibration.model.named_actions import NamedAction, SimultaneousActions
from dlo_calibration.observation.noise import NO_NOISE, noise_of
from dlo_calibration.planning.action_loads import ActionLoads, loads_of_actions
from dlo_calibration.planning.dlo import CalibratedDlo, intervals, Posterior
from dlo_calibration.planning.plan import plain_action
from dlo_calibration.planning.rehearsal import ActionStep, in_turn, PAUSE, Rehearsal, RehearsalJob, rehearse

DRAWS = 20  # from the posterior, which is enough for the ends of a 90 % interval
Doing = Union[NamedAction, Action, ActionStep, SimultaneousActions]


@dataclass(frozen=True)
class PredictedStep:
    """
    An action, and the DLO at rest after it.

    :param name: of the action: that of a named action, else `hand_paths`; see `SimultaneousActions`.
    :param step: the paths of the hands, in the time of the whole sequence.
    :param chain: (n, 3) [m] with the best parameters.
    :param lower: (n, 3) [m] lower ends of the 90 % intervals of each coordinate; `upper` (n, 3) upper ends.
    :param settled: False if the DLO did not come to rest within the time limit.
    :param loads: the largest ones in the action; None if the engine does not know them.
    """

    name: str
    step: ActionStep
    chain: Floats
    lower: Floats
    upper: Floats
    settled: bool
    loads: ActionLoads | None = None


@dataclass(frozen=True)
class Prediction:
    """
    The prediction of a DLO in a sequence of actions.

    :param draws: number of simulated draws from the posterior, besides the best parameters.
    :param physical: the best parameters by name (SI units).
    :param warnings: sentences for the user, such as that a draw could not be simulated.
    """

    start: Chain
    steps: tuple[PredictedStep, ...]
    draws: int
    physical: Mapping[str, float]
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, 'physical', MappingProxyType(dict(self.physical)))


def simulate(dlo: CalibratedDlo, chain: Chain,
             actions: Sequence[Doing], *, options: Options | None = None,
             draws: int = DRAWS, seed: int = 1, make_simulator: SimulatorFactory = make_chosen_simulator,
             should_stop: Callable[[], bool] = lambda: False) -> Prediction:
    """
    Predict the chains at rest after each action.

    A named action begins at the chain that is predicted with the best parameters; the hands take the same
    paths for every draw.  Each action begins when the DLO is at rest after the one before.  Each draw also
    has another start, because the noise of the given one affects the prediction.

    :param dlo: a `CalibrationResult`, or the `Description` that `read_result` returns.
    :param chain: the DLO before the first action.
    :param actions: at least one; an `Action` opens its hands at the end, an `ActionStep` says which stay
        closed, and `SimultaneousActions` combines actions that overlap in time.
    :param options: of the simulation; None: the defaults.
    :param draws: from the posterior, for the intervals; 0: the intervals contain the model error only.
    :raises InputError: if an action is impossible with the chain before it.
    :raises SimulationError: if the simulation with the best parameters diverges.
    :raises CancelledError: once `should_stop` is True.
    """
    if not actions:
        raise InputError('simulate', 'no action', 'at least one', 'say what the hands do')
    options = options or Options()
    posterior = Posterior.of(dlo).lying(chain, options)
    with closing(make_simulator(options)) as simulator, closing(Threads(options.workers)) as threads:
        pool = Pool(simulator, threads, should_stop)
        steps, best = _steps(pool, chain, actions, posterior.best)
        drawn = rehearse(pool, [RehearsalJob(start, steps, physical, loads=True) for start, physical in zip(
            _starts(chain, draws, seed), posterior.draws(draws, seed), strict=True)])
        finer = _finer(pool, RehearsalJob(chain, steps, posterior.best, loads=True))
    failures = [rehearsal.failure for rehearsal in drawn if rehearsal.failure]
    warnings = () if not failures else (
        f'{len(failures)} of {draws} draws from the posterior could not be simulated: {failures[0]}',)
    lower, upper = intervals(best.chains, [draw.chains for draw in drawn if not draw.failure],
                             dlo.errors.rms / np.sqrt(3), None if finer is None else finer.chains)
    loads = loads_of_actions(best, drawn, finer)
    return Prediction(
        chain, tuple(PredictedStep(action.name, step, frozen_array(best.chains[k]), frozen_array(lower[k]),
                                   frozen_array(upper[k]), best.settled[k], loads[k])
                     for k, (action, step) in enumerate(zip(actions, steps, strict=True))),
        draws, posterior.best, warnings)


def _starts(chain: Chain, draws: int, seed: int) -> list[Chain]:
    """Return a start for each draw: the measured chain with added noise of the same level."""
    level = noise_of([chain.points[None]])
    if not level > NO_NOISE:  # nan, too
        return [chain] * draws
    generator = np.random.default_rng([seed, 1])  # `Posterior.draws` uses the seed itself
    return [replace(chain, points=chain.points + level * generator.standard_normal(chain.points.shape))
            for _ in range(draws)]


def _finer(pool: Pool, job: RehearsalJob) -> Rehearsal | None:
    """Return the rehearsal of a job by a finer simulation; None if there is none."""
    refined = pool.refined()
    if refined is None:
        return None
    with closing(refined.simulator):
        rehearsal, = rehearse(refined, [job])
    return None if rehearsal.failure else rehearsal


def _steps(pool: Pool, chain: Chain, actions: Sequence[Doing],
           physical: dict[str, float]) -> tuple[tuple[ActionStep, ...], Rehearsal]:
    """Return the actions as steps in turn, and their rehearsal with the best parameters."""
    steps: list[ActionStep] = []
    for action in actions:
        if isinstance(action, NamedAction):
            after = {hand for step in steps[-1:] for hand in step.held_by} - set(action.hand_names)
            action = SimultaneousActions(
                (action,), (*sorted(after), *(action.hand_names if action.hold else ())))
        if isinstance(action, SimultaneousActions):
            before = chain
            if steps and any(isinstance(part, NamedAction) for part in action.actions):
                before = Chain(_rehearsed(pool, chain, steps, physical).chains[-1])
            steps.append(_combined(action, before, [step.action for step in in_turn(steps)]))
        else:
            steps.append(action if isinstance(action, ActionStep) else ActionStep(action))
    return in_turn(steps), _rehearsed(pool, chain, steps, physical)


def _combined(together: SimultaneousActions, before: Chain, earlier: Sequence[Action]) -> ActionStep:
    """
    Return one step for actions that overlap in time.

    :param before: the DLO then.
    :param earlier: the actions before, in turn.
    """
    first = min(action.start for action in together.actions)
    begin = earlier[-1].end + PAUSE if earlier else 0.0
    hands: list[Hand] = []
    for action in together.actions:
        start = begin + action.start - first
        paths = replace(action, start=start).action(before, earlier) if isinstance(action, NamedAction) else \
            ActionStep(action).starting(start).action
        hands += paths.hands
    return ActionStep(Action(tuple(hands)), together.held_by)


def _rehearsed(pool: Pool, chain: Chain, steps: Sequence[ActionStep], physical: dict[str, float]
               ) -> Rehearsal:
    rehearsal, = rehearse(pool, [RehearsalJob(chain, tuple(steps), physical, loads=True)])
    if rehearsal.failure:
        raise SimulationError(rehearsal.failure)
    return rehearsal


def plain_prediction(prediction: Prediction) -> dict[str, Any]:
    """
    Return a prediction as plain values, under the keys that `simulate --json` prints.

    Lengths are in m, times in s, tensions in N.
    """
    return dict(with_nulls({
        'actions': [{**plain_action(prediction.start, step.name, step.step.action, step.chain, step.lower,
                                    step.upper, step.loads),
                     'held_by': step.step.held_by, 'settled': step.settled} for step in prediction.steps],
        'draws': prediction.draws, 'remarks': prediction.warnings}))
