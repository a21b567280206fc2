# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Material: where tracked points are along the DLO, and how it is twisted between clamps, from observed chains.

Arc lengths come from many chains instead of one; directions in a clamp are fixed to the hand that holds it.
"""

from __future__ import annotations

from dataclasses import replace
import math
from typing import Sequence

import numpy as np

from dlo_calibration.model.action import Hand, rotation_matrix
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.noise import NO_NOISE, noise, smooth

VIEWS = 25  # goals of each trial that are measured, evenly spread; fewer do not outweigh one straight chain
AGREES = 3.0  # standard deviations within a trial; segments of other points differ by more


def with_shared_places(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """
    Return the trials; those with a stream of timed goals have the rest arc lengths of their points.

    With few markers, bends between them are not seen, and the arc lengths of one chain are wrong. The mean
    over a stream, and over all trials with the same points, is better, and the same for all these trials.
    Trials have the same points if no segment differs in length by more than it varies within a trial, which
    shows what noise and bends explain. Only timed goals count, so photographs with points that were
    clicked anew share nothing, even if their lengths agree. A segment inside a clamp has its measured length,
    as hands grip anew. Trials without such a stream, or with rest arc lengths, stay as they are.
    """
    measured = {k: _segments(trial) for k, trial in enumerate(trials)
                if trial.places is None and sum(not goal.stable for goal in trial.goals) >= VIEWS}
    shared = list(trials)
    for count in {len(segments[0]) for segments in measured.values()}:
        same = {k: segments for k, segments in measured.items() if len(segments[0]) == count}
        means = np.array([segments.mean(axis=0) for segments in same.values()])
        spread = np.sqrt(np.mean([segments.var(axis=0) for segments in same.values()], axis=0))
        free = np.array([~np.isin(np.arange(count), trials[k].clamped) for k in same])
        agree = (~free | (np.abs(means - np.median(means, axis=0)) <= AGREES * spread)).all(axis=1)
        for row, k in enumerate(same):
            own = np.linalg.norm(np.diff(trials[k].initial.points, axis=0), axis=1)
            lengths = means[agree].mean(axis=0) if agree[row] else means[row]
            shared[k] = replace(trials[k], places=np.concatenate(
                [[0.0], np.cumsum(np.where(free[row], lengths, own))]))
    return tuple(shared)


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


def clamps(trial: Trial) -> list[Hand]:
    """Return the hands that hold two or more points of the DLO from the start of a trial."""
    return [hand for hand in trial.hands if len(hand.grips) > 1 and hand.times[0] <= 0]


def clamp_twist(trials: Sequence[Trial]) -> float:
    """
    Return the angle [rad] of the clamp in the second half to that in the first, of a DLO without twist.

    The direction of the first clamp, see `clamp_directions`, is carried along each initial chain
    without twist (Bishop, There is more than one way to frame a curve, 1975). The angle turns the direction
    of the second clamp into it, in the mean over the trials that begin with two clamps; nan without any.
    """
    angles = []
    for trial in trials:
        points, hands = trial.initial.points, clamps(trial)
        directions = clamp_directions(points, [(hand.grips, hand) for hand in hands])
        segments = np.flatnonzero(np.isfinite(directions[:, 0]))
        if len(hands) < 2 or len(segments) < 2:
            continue
        along = np.diff(points, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        first, last = int(segments[0]), int(segments[-1])
        carried = directions[first]
        for before, after in zip(along[first:last], along[first + 1:last + 1], strict=True):
            carried = carried - carried @ after / (1 + before @ after) * (before + after)
        there = directions[last]
        angles.append(math.atan2(np.cross(there, carried) @ along[last], there @ carried))
    return math.atan2(np.sin(angles).sum(), np.cos(angles).sum()) if angles else math.nan


def clamp_directions(points: Floats, holding: Sequence[tuple[Sequence[int], Hand]]) -> Floats:
    """
    Return unit vectors across the segments in clamps, (N - 1, 3), fixed to the hands; nan elsewhere.

    A DLO that stays in its clamps from trial to trial lies in the hand's frame always the same, so that
    any direction across it would do.  Where the orientations of hands are relative to the start of
    each trial, it does not.  So the direction is the x axis of the hand, turned by the smallest rotation from
    its -z axis to the DLO that leaves the clamp, or from its +z axis if that is nearer than 30 degrees.

    :param points: (N, 3) [m] nodes at the start.
    :param holding: the hands and the nodes that each of them holds.
    """
    directions = np.full((len(points) - 1, 3), np.nan)
    for nodes, hand in holding:
        turn = rotation_matrix(hand.orientations[0])
        held = sorted(nodes)
        for segment in (a for a, b in zip(held[:-1], held[1:], strict=True) if b == a + 1):
            along = points[segment + 1] - points[segment]
            leaves = along if held[-1] < len(points) - 1 else -along
            there = turn.T @ (leaves / np.linalg.norm(leaves))
            axis = np.array([0.0, 0.0, 1.0 if there[2] > np.cos(np.pi / 6) else -1.0])
            across = np.array([1.0, 0.0, 0.0]) - there[0] / (1 + axis @ there) * (axis + there)
            directions[segment] = turn @ across
    return directions
