# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Summary: consistency and validity over many calibrations of the same object."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from statistics import fmean
from typing import Iterator, Mapping, Sequence

import numpy as np

from dlo_calibration.experiment.study import Outcome, Task
from dlo_calibration.model.score import VERY_SIMILAR


@dataclass(frozen=True)
class Spread:
    """
    Mean and standard deviation of a number over runs.

    :param std: sample standard deviation; None with fewer than two runs.
    """

    mean: float
    std: float | None
    count: int

    @classmethod
    def of(cls, numbers: Sequence[float]) -> Spread | None:
        """Return the spread of numbers; None if there are none."""
        if not numbers:
            return None
        away = np.subtract(numbers, numbers[0])  # exactly 0 if all are equal, unlike those from the mean
        return cls(fmean(numbers), float(np.std(away, ddof=1)) if len(numbers) > 1 else None, len(numbers))


@dataclass(frozen=True)
class Findings:
    """
    The results of all runs of one search on one object.

    :param parameters: consistency: the value of each parameter, 0..100, calibrated on all trials.
    :param informed: number of runs in which the trials showed each parameter; in the others, it kept its
        default.
    :param fitted: mean point error of the trials calibrated on [m].
    :param score: validity: a run's average difference score over the trials that judge it [cm].
    :param very_similar: number of runs whose score is below `VERY_SIMILAR`.
    :param error: a run's mean point error over the trials that judge it [m].
    :param share: the same error [% of the length].
    :param actions: difference score of each trial by itself, by its name [cm].
    :param worst: highest difference score of one trial in one run [cm].
    :param seconds: duration of a calibration on all trials [s].
    :param failures: number of calibrations that failed, and of trials that could not be simulated.
    """

    subject: str
    search: str
    runs: int
    parameters: Mapping[str, Spread]
    informed: Mapping[str, int]
    fitted: Spread | None
    score: Spread | None
    very_similar: int
    error: Spread | None
    share: Spread | None
    actions: Mapping[str, Spread]
    worst: float | None
    evaluations: Spread | None
    seconds: Spread | None
    failures: int


def complete_runs(done: Sequence[tuple[Task, Outcome]]) -> list[list[tuple[Task, Outcome]]]:
    """Group the calibrations of one subject and search by run; leave out incomplete runs."""
    by_seed: dict[int, list[tuple[Task, Outcome]]] = {}
    for task, outcome in done:
        by_seed.setdefault(task.seed, []).append((task, outcome))
    return [run for _, run in sorted(by_seed.items()) if len(run) == 1 + len(run[0][0].subject.held_back)]


def run_score(run: Sequence[tuple[Task, Outcome]]) -> float | None:
    """Return a run's average difference score over the trials that judge it [cm]; None if there is none."""
    return _mean([judgement.score for _, outcome in run for judgement in outcome.judgements])


def _mean(numbers: Sequence[float | None]) -> float | None:
    valid = [number for number in numbers if number is not None]
    return fmean(valid) if valid else None


def summary(done: Sequence[tuple[Task, Outcome]]) -> Findings:
    """Summarise the calibrations, at least one, of one subject with one search."""
    runs = complete_runs(done)
    subject, search = done[0][0].subject, done[0][0].search
    whole = [outcome for run in runs for task, outcome in run
             if task.left_out is None and not outcome.failure]
    judged = [[judgement for _, outcome in run for judgement in outcome.judgements] for run in runs]
    scores = [score for run in runs if (score := run_score(run)) is not None]
    by_action: dict[str, list[float]] = {}
    for judgement in chain.from_iterable(judged):
        by_action.setdefault(judgement.trial, []).extend([] if judgement.score is None else [judgement.score])

    def over_runs(values: Iterator[float | None]) -> Spread | None:
        return Spread.of([value for value in values if value is not None])

    def parameter(name: str) -> Spread | None:
        return Spread.of([outcome.values[name] for outcome in whole if name in outcome.values])

    free = subject.observed.options.space.free
    return Findings(
        subject=subject.name, search=search, runs=len(runs),
        parameters={name: spread for name in free if (spread := parameter(name)) is not None},
        informed={name: sum(name in outcome.excited for outcome in whole) for name in free},
        fitted=over_runs(outcome.error for outcome in whole),
        score=Spread.of(scores), very_similar=sum(score < VERY_SIMILAR for score in scores),
        error=over_runs(_mean([judgement.error for judgement in run]) for run in judged),
        share=over_runs(_mean([judgement.share for judgement in run]) for run in judged),
        actions={name: spread for name, values in by_action.items() if (spread := Spread.of(values))},
        worst=max((score for values in by_action.values() for score in values), default=None),
        evaluations=Spread.of([outcome.evaluations for outcome in whole]),
        seconds=Spread.of([outcome.seconds for outcome in whole]),
        failures=sum(bool(outcome.failure) for run in runs for _, outcome in run)
        + sum(judgement.score is None for run in judged for judgement in run))
