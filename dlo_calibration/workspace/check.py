# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Check: whether a new session still shows the DLO of a result, and which parameters have changed if not."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, Callable, Mapping, Sequence

import numpy as np

from dlo_calibration.calibration.choice import budget
from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.fit import fit
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult, plain, with_nulls
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.calibration.stages import examined
from dlo_calibration.evaluation.pool import Threads
from dlo_calibration.files.result import Description
from dlo_calibration.inference.comparison import compare, Comparison
from dlo_calibration.inference.uncertainty import IDENTIFIABLE_WIDTH
from dlo_calibration.model.parameters import BY_NAME, extents, interval, measured, number, SCALE
from dlo_calibration.model.trial import Trial
from dlo_calibration.search import Hints, LeastSquares
from dlo_calibration.workspace.validation import FURTHER, others_own, SAME, validated

AGREES, HAS_CHANGED, CANNOT_TELL = 'agrees', 'changed', 'cannot tell'
ANOTHER_LENGTH = 0.05  # share by which the length of the same DLO never differs, however it is measured


@dataclass(frozen=True)
class Check:
    """
    Whether a session shows the DLO of a result.

    :param validation: the session, simulated with the parameters of the result.
    :param comparison: of the parameters that fit the session with those of the result; None: there is none.
    :param verdict: agrees, changed, or cannot tell.
    :param words: why, in one or more sentences.
    :param names: of the parameters that were compared, in order.
    """

    validation: CalibrationResult
    comparison: Comparison | None
    verdict: str
    words: tuple[str, ...]
    names: tuple[str, ...] = ()


def checked(file: Description, trials: Sequence[Trial], options: Options,
            make_simulator: SimulatorFactory = make_chosen_simulator,
            should_stop: Callable[[], bool] = lambda: False) -> Check:
    """
    Compare the parameters that fit new trials with those of a result.

    The search begins at the result, among other points: what the new trials do not show stays as it is.
    What each session of the calibration has for itself, as the friction of its table, may be another one.

    :raises InputError: if the hands have lost the DLO in all trials.
    :raises SimulationError: if a trial cannot be simulated with the parameters of the result.
    """
    validation = validated(file, trials, options, make_simulator)
    if file.unusable or validation.implausible:
        why = file.unusable or validation.implausible[0]
        return Check(validation, None, CANNOT_TELL, (
            f'Nothing can be compared: {"the result is not usable, because " * bool(file.unusable)}{why}.',))
    longer = validation.length / file.length - 1
    if abs(longer) > ANOTHER_LENGTH:
        return Check(validation, None, HAS_CHANGED, (
            'This is another DLO, or only a part of it is seen: it is '
            f'{measured(validation.length, "m")} long, that of the result {measured(file.length, "m")}.',))
    point, space = validation.best.point, validation.space
    # What these trials do not show keeps the value of the result.
    space = replace(space, fixed={**space.fixed, **space.values(point)})
    with closing(make_simulator(options)) as simulator, closing(Threads(options.workers)) as threads:
        setting = Setting(tuple(trials), options, simulator, threads, should_stop)
        search = LeastSquares(space.dimension, options.seed, Hints(
            point, np.ones(len(point), np.bool_), upper=space.upper))
        # The error of nodes and time step is much the same in both, and that of the result counts.
        there = examined(setting, fit(setting, space, search, budget(space.dimension)), discretised=False)
    if there.examination is None or not there.examination.regular:
        return Check(validation, None, CANNOT_TELL, (
            f'Nothing can be compared: the search has not reached a minimum ({there.stop_reason}).',))
    assert there.best.errors is not None and there.examination.uncertainty.covariance is not None
    own = others_own(file.space, trials)
    names = tuple(name for name in space.free if name not in own)
    if not names:
        return Check(validation, None, CANNOT_TELL, (
            f'Nothing can be compared: each session has its own {" and ".join(own)}.',))
    kept = [space.free.index(name) for name in names]
    comparison = compare((there.best.point - point)[kept], covariance(file, names),
                         there.examination.uncertainty.covariance[np.ix_(kept, kept)])
    return Check(validation, comparison, *_judged(
        file, validation, names, comparison, there.best.errors.mean), names)


def covariance(file: Description, names: Sequence[str]) -> Any:
    """Return the (d, d) covariance of parameters of a result, in units of a search."""
    std = np.array([file.parameters[name].std for name in names]) / SCALE * extents(names)
    given = file.correlations
    correlations = np.eye(len(names)) if given is None else np.array(
        [[given[name][other] for other in names] for name in names])
    return np.where(np.isfinite(correlations), correlations, np.eye(len(names))) * np.outer(std, std)


def _judged(file: Description, validation: CalibrationResult, names: Sequence[str], comparison: Comparison,
            error: float) -> tuple[str, tuple[str, ...]]:
    """
    Return the verdict, and sentences on it.

    :param names: of the parameters that were compared.
    :param error: mean point error of the parameters that fit the session best [m].
    """
    length = validation.length
    if error > max(FURTHER * file.errors.mean, SAME * length):
        return HAS_CHANGED, (
            'No parameter explains this session: at best, the simulated points are '
            f'{measured(error, "m")} from the measured ones, {measured(file.errors.mean, "m")} '
            'in the calibration. It is another DLO or frame, or a hand slipped.',)
    changes = _changes(file, validation, names, comparison)
    sure = 'less than 0.01 %' if comparison.agreement < 1e-4 else f'{number(100 * comparison.agreement)} %'
    chance = f'The same DLO would differ by as much in {sure} of such sessions.'
    if comparison.changed.any():
        return HAS_CHANGED, (*(words for words, changed in zip(changes, comparison.changed, strict=True)
                               if changed), chance)
    wide = [name for name, width in zip(names, comparison.upper - comparison.lower, strict=True)
            if file.parameters[name].identifiable and width > IDENTIFIABLE_WIDTH]
    if wide or not np.isfinite(comparison.agreement):
        return CANNOT_TELL, (
            f'This session does not show {" and ".join(wide or names)} well enough to compare. Observe the '
            'actions of the calibration again.',)
    known = [words for name, words in zip(names, changes, strict=True) if file.parameters[name].identifiable]
    return AGREES, (chance, *known)


def _changes(file: Description, validation: CalibrationResult, names: Sequence[str],
             comparison: Comparison) -> list[str]:
    """Return a sentence on the change of each parameter."""
    words = []
    for name, change, lower, upper, changed in zip(
            names, comparison.change, comparison.lower, comparison.upper, comparison.changed, strict=True):
        before, scale = file.parameters[name], SCALE / BY_NAME[name].extent
        now, *ends = (validation.space.reported(name, float(np.clip(before.value + scale * by, 0, SCALE)))[0]
                      for by in (change, lower, upper))
        low, high = sorted(ends)
        unit, quantity = before.physical_unit, BY_NAME[name].quantity
        words.append(
            f'{name} {"has changed" if changed else "is the same as far as this session tells"}: {quantity} '
            f'{measured(now, unit, high)}, with 90 % probability {interval(low, high, unit)}, instead of '
            f'{measured(before.physical_value, unit, high)}.')
    return words


def plain_check(check: Check) -> Mapping[str, Any]:
    """
    Return a check as plain values, under the keys that `check --json` prints.

    `lower` and `upper` of a parameter are those of its change, where it was compared.
    """
    comparison, values = check.comparison, plain(check.validation)
    for k, name in enumerate(check.names):
        assert comparison is not None
        change, lower, upper = (SCALE / BY_NAME[name].extent * float(each[k]) for each in (
            comparison.change, comparison.lower, comparison.upper))
        values['parameters'][name].update(
            change=change, lower=lower, upper=upper, changed=bool(comparison.changed[k]))
    result: Mapping[str, Any] = with_nulls({
        **values, 'headline': ' '.join(check.words), 'verdict': check.verdict,
        'probability_of_agreement': comparison and comparison.agreement})
    return result
