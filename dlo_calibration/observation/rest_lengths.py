# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Rest lengths: the arc lengths of points that a tracker followed, from many chains instead of one."""

from __future__ import annotations

from dataclasses import replace
from typing import Sequence

import numpy as np

from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.noise import NO_NOISE, noise, smooth

VIEWS = 25  # goals of each trial that are measured, evenly spread; fewer do not outweigh one straight chain
AGREES = 3.0  # standard deviations within a trial; segments of other points differ by more


def with_shared_places(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """
    Return the trials, those with a stream of timed goals with the rest arc lengths of their points.

    Between a few markers, bends that are not seen make the arc lengths of one chain wrong. The mean over a
    stream, and over all trials with the same points, is better, and does not differ from trial to trial.
    Trials have the same points if each segment is as long in both, up to how its length varies in a trial:
    that shows what noise and bends explain. Only timed goals count, so photographs with points that were
    clicked anew share nothing, even if their lengths agree. A segment inside a clamp has its measured length,
    as hands grip anew. Trials without such a stream, or with rest arc lengths, stay as they are.
    """
    measured = {k: _segments(trial) for k, trial in enumerate(trials)
                if trial.places is None and sum(not goal.stable for goal in trial.goals) >= VIEWS}
    found = list(trials)
    for count in {len(segments[0]) for segments in measured.values()}:
        same = {k: segments for k, segments in measured.items() if len(segments[0]) == count}
        means = np.array([segments.mean(axis=0) for segments in same.values()])
        spread = np.sqrt(np.mean([segments.var(axis=0) for segments in same.values()], axis=0))
        free = np.array([~np.isin(np.arange(count), trials[k].clamped) for k in same])
        agree = (~free | (np.abs(means - np.median(means, axis=0)) <= AGREES * spread)).all(axis=1)
        for row, k in enumerate(same):
            own = np.linalg.norm(np.diff(trials[k].initial.points, axis=0), axis=1)
            lengths = means[agree].mean(axis=0) if agree[row] else means[row]
            found[k] = replace(trials[k], places=np.concatenate(
                [[0.0], np.cumsum(np.where(free[row], lengths, own))]))
    return tuple(found)


def _segments(trial: Trial) -> Floats:
    """
    Return the lengths of the segments, (v, n - 1) [m], in v timed goals, without the effect of noise.

    Where an end of a segment was not seen, it has the mean of the goals that show it, if there are any.
    """
    seen = [goal.chain for goal in trial.goals if not goal.stable]
    sigma = noise([trial])
    chains = [seen[k] for k in np.linspace(0, len(seen) - 1, VIEWS).astype(int)]
    shown = np.array([chain.seen[1:] & chain.seen[:-1] for chain in chains])
    if sigma > NO_NOISE:
        chains = [Chain(smooth(chain.points, sigma)) for chain in chains]
    lengths = np.array([np.diff(chain.arc_lengths()) for chain in chains])
    shown[:, ~shown.any(axis=0)] = True
    return np.where(shown, lengths, (lengths * shown).sum(axis=0) / shown.sum(axis=0))
