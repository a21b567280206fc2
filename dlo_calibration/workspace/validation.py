# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Validation: trials simulated with the parameters of a result, without fitting."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
import math
import time
from typing import Sequence

import numpy as np

from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult, simulated_chains
from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.evaluation.pool import Pool, Threads
from dlo_calibration.files.result import Description
from dlo_calibration.inference.outlier import SOMETHING_ELSE, SURELY
from dlo_calibration.model.parameters import (
    BY_NAME,
    measured,
    number,
    OWN_SHAPE,
    owner,
    ParameterSpace,
    REST_SHAPE,
)
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.grips import GripEvidence
from dlo_calibration.observation.material import with_shared_places
from dlo_calibration.observation.plausibility import implausible_trials
from dlo_calibration.simulation.protocol import Rollout

# Unseen actions of the reference objects have up to 1.7 times the error of the calibration (intervals.md in
# benchmark/results); a DLO of which points move by less than 0.5 % of the length behaves the same.
FURTHER, SAME = 5.0, 0.005
DRAWS = 8  # of the parameters, with which a trial of large error is simulated


def validated(file: Description, trials: Sequence[Trial], options: Options,
              make_simulator: SimulatorFactory = make_chosen_simulator) -> CalibrationResult:
    """
    Simulate trials with the parameters of a result, without fitting.

    :returns: a result whose only evaluation has these parameters; values and intervals are those of `file`.
    :raises InputError: if the hands have lost the DLO in all trials.
    :raises SimulationError: if a trial cannot be simulated.
    """
    evidence = GripEvidence.of(trials)
    trials = with_shared_places(evidence.require_usable(trials))
    space, hands = _with_errors(evidence, file)
    own = others_own(space, trials)
    space = replace(space, free=tuple(
        name for name in space.free if not owner(name)[1] or owner(name)[0] not in own))
    point = space.point(file.values)
    with closing(make_simulator(options)) as simulator, closing(Threads(options.workers)) as threads:
        begun = time.monotonic()
        evaluator = Evaluator(trials, space, simulator)
        evaluation = evaluator.evaluated(0, point, Pool(simulator, threads).simulate(evaluator.jobs(point)))
        seconds = time.monotonic() - begun
    if evaluation.failure:
        raise SimulationError(evaluation.failure)
    implausible = implausible_trials(trials, options.table_top, bool(options.scene))
    first = (f'{name}: each session of the calibration has one of its own; that of the first is used'
             for name in dict.fromkeys(OWN_SHAPE if name in REST_SHAPE else name for name in own))
    warnings = (*implausible, *hands, *first, *(f'never came to rest: {name}; the last state was compared'
                                        for name in evaluation.unsettled))
    result = CalibrationResult(
        space=space, estimates={name: file.parameters[name] for name in space.free}, best=evaluation,
        trials=trials, chains=simulated_chains(trials, evaluation), evaluations=(evaluation,),
        seconds=seconds, search=file.search, engine=simulator.name,
        stop_reason='validation: nothing was fitted', seed=file.seed, warnings=warnings,
        implausible=implausible, unusable_fit=file.unusable)
    mean, of_fit = result.errors.mean, file.errors.mean
    if not result.unusable and mean > max(FURTHER * of_fit, SAME * result.length):
        result = replace(result, unusable_fit=(
            f'the mean error is {number(mean / of_fit)} times that of the calibration, '
            f'{measured(of_fit, "m")}; check whether this is the same DLO, in the same frame'))
    return result


def others_own(space: ParameterSpace, trials: Sequence[Trial]) -> tuple[str, ...]:
    """Return the parameters of which other sessions than those of the trials have values of their own."""
    sessions = {trial.session for trial in trials}
    return tuple(dict.fromkeys(name for name, session in map(owner, space.free)
                               if session and session not in sessions))


def _with_errors(evidence: GripEvidence, file: Description) -> tuple[ParameterSpace, tuple[str, ...]]:
    """
    Return the space of a result, with the errors that the hands have in other trials, and a warning for each.

    Late clocks and shifted hands are no property of the DLO: another session may have others.
    """
    space, physical = file.space, file.physical()
    errors = evidence.other_than(physical)
    free = tuple(name for name in space.free if name not in errors)
    if not free or not errors:
        return space, ()
    fixed = {**space.fixed, **{name: BY_NAME[name].value(value) for name, value in errors.items()}}
    return replace(space, free=free, fixed=fixed), tuple(
        f'{name}: {measured(value, BY_NAME[name].unit)} in this session, '
        f'{measured(physical.get(name, 0.0), BY_NAME[name].unit)} in the result; that of the session is used'
        for name, value in errors.items())


def with_large_errors(result: CalibrationResult, file: Description, options: Options,
                      make_simulator: SimulatorFactory = make_chosen_simulator) -> CalibrationResult:
    """
    Return a validation with a warning that names the trials whose errors are larger than usual.

    The usual error is the median over the trials. A trial is sensitive if the usual error explains its own,
    together with how far the uncertainty of the parameters moves its points, on average.

    :param result: what `validated` returns for `file` and `options`.
    """
    errors = np.array([each.mean() for each in result.trial_errors])
    usual = float(np.median(errors))
    large = np.flatnonzero(errors > SURELY * usual).tolist()
    if len(errors) < 3 or not large:
        return result
    sensitive: list[str] = []
    odd: list[str] = []
    for k, spread in zip(large, _spreads(result, file, options, large, make_simulator), strict=True):
        explained = errors[k] < SURELY * math.hypot(usual, spread)
        (sensitive if explained else odd).append(
            f'{result.trials[k].name} ({measured(errors[k], "m")}, {measured(spread, "m")})')
    words = [f'{what}: {", ".join(names)}' for what, names in (
        ('these are sensitive', sensitive), (f'in these, {SOMETHING_ELSE}', odd)) if names]
    return replace(result, warnings=(*result.warnings, (
        f'half of the trials miss by at most {measured(usual, "m")}; those that miss by more than '
        f'{number(SURELY)} times that, with what the uncertainty of the parameters alone moves their points; '
        f'{"; ".join(words)}')))


def _spreads(result: CalibrationResult, file: Description, options: Options, chosen: Sequence[int],
             make_simulator: SimulatorFactory) -> list[float]:
    """Return how far the uncertainty of the parameters moves the points of some trials, on average [m]."""
    from dlo_calibration.planning.dlo import Posterior  # loads slowly, and is rarely needed

    drawn = Posterior.of(file).drawn_values(DRAWS, 1)
    with closing(make_simulator(options)) as simulator, closing(Threads(options.workers)) as threads:
        evaluator = Evaluator(result.trials, result.space, simulator)
        every = [evaluator.jobs(result.space.point(dict(zip(file.space.free, values, strict=True))))
                 for values in drawn]
        rollouts = Pool(simulator, threads).simulate([jobs[k] for k in chosen for jobs in every])
    spreads = []
    for n, k in enumerate(chosen):
        chains = [rollout.chains for rollout in rollouts[n * DRAWS:(n + 1) * DRAWS]
                  if isinstance(rollout, Rollout)]
        spreads.append(float(np.mean([np.linalg.norm(each - result.chains[k], axis=2).mean()
                                      for each in chains])) if chains else math.nan)
    return spreads
