# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Grips: what the chains show of the hands, without simulation.

A gripped point moves with its hand.  Where it does not, the hand has missed the DLO or lost it.  Where it
follows later or earlier than the stamps say, the clocks of hands and chains differ.  Where hands close beside
the gripped points, always in the same direction, they are off in the frame of the chains.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import BY_NAME, measured, number
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.noise import noise
from dlo_calibration.observation.plausibility import reversed_trials

FOLLOWS, SIGMAS = 0.02, 6.0  # m, and times the noise: a gripped point further from its place is not held
WAY = 0.05  # m; the shortest way of a hand that shows whether the DLO follows
REACH, PLACES = 0.06, 41  # m, to both sides of the nearest place; places there that a hand may really grip
MOST_VIEWS = 80  # goals of one grip that are compared, evenly spread
LATEST, STEP = 0.4, 0.02  # s; the largest delay that is looked for, and the steps to it
EXACT = 0.001  # s, standard deviation; waypoints and views are not stamped more exactly
LOST = 3  # views in a row in which the DLO is not in the hand; fewer may be errors of a tracker
SCATTER = 0.002  # m, standard deviation; so far beside the middle line of a DLO a hand closes
STILL = 0.008  # m; a DLO of which no point moves further has not been moved
CERTAIN = 5.0  # standard deviations; a delay or shift that is smaller is not reported
ROUNDING = 1e-9  # s
SMALLEST_DELAY, SMALLEST_SHIFT = 0.01, 0.004  # s, m; smaller ones harm no result


@dataclass(frozen=True)
class Estimate:
    """
    An error of the hands, estimated from the chains.

    :param value: [s] or (3,) [m]; `std` is its standard deviation, likewise.
    """

    value: Floats
    std: Floats

    @property
    def certain(self) -> NDArray[np.bool_]:
        """Whether the error differs from 0, and is large enough to matter; (3,) for that of places."""
        least = SMALLEST_SHIFT if self.value.ndim else SMALLEST_DELAY
        return np.asarray(np.abs(self.value) > np.maximum(least, CERTAIN * self.std))


@dataclass(frozen=True)
class Loss:
    """
    A hand that has missed the DLO, or lost it.

    :param trial: its name; `hand` is the hand's name.
    :param time: [s] of the trial from which on the hand does not hold the DLO.
    :param missed: whether it has never held it.
    :param distance: [m] from the hand to where it should have gripped, at most.
    """

    trial: str
    hand: str
    time: float
    missed: bool
    distance: float

    @property
    def words(self) -> str:
        """What has happened."""
        behind = measured(self.distance, 'm')
        if self.missed:
            return f'{self.hand} has missed the DLO, which does not follow it and is up to {behind} behind'
        return (f'the DLO slipped from {self.hand}, or that let go, at {number(self.time)} s: it is up to '
                f'{behind} behind')

    def __str__(self) -> str:
        unused = 'it' if self.missed else 'what came later'
        return str(InputError(self.trial, self.words, 'a DLO that follows its hand',
                              f'repeat the trial: {unused} is not used'))


@dataclass(frozen=True)
class GripEvidence:
    """
    What the chains of trials show of the hands.

    :param delay: by how much the stamps of the hands are late [s]; None: it is not seen.
    :param shift: (3,) by how much hands are off in the frame of the chains [m]; None: it is not seen.
    :param losses: of the DLO by a hand.
    """

    delay: Estimate | None
    shift: Estimate | None
    losses: tuple[Loss, ...]

    @classmethod
    def of(cls, trials: Sequence[Trial]) -> GripEvidence:
        """Return the evidence of trials; those with points from the other end show nothing of the hands."""
        trials = [trial for trial, turned in zip(trials, reversed_trials(trials), strict=True) if not turned]
        tolerance = max(FOLLOWS, SIGMAS * float(np.nan_to_num(noise(trials)))) if trials else FOLLOWS
        grips = [_Grip.of(trial, hand, tolerance) for trial in trials for hand in trial.hands]
        delay = _delay(grips)
        losses = [grip.loss(0.0 if delay is None else float(delay.value)) for grip in grips]
        held = [grip for grip, loss in zip(grips, losses, strict=True) if loss is None]
        delay = _delay(held) if len(held) < len(grips) else delay
        matters = any(grip.hand.nearest or (grip.hand.orientations != grip.hand.orientations[0]).any()
                      for grip in held)
        shift = _shift(held, 0.0 if delay is None else float(delay.value)) if matters else None
        return cls(delay, shift, tuple(loss for loss in losses if loss is not None))

    @property
    def estimates(self) -> dict[str, float]:
        """The errors of the hands that are seen, under the names of parameters, in their units."""
        delay = {} if self.delay is None else {'hand_delay': float(self.delay.value)}
        shift = () if self.shift is None else self.shift.value.tolist()
        return delay | {f'hand_shift_{axis}': value for axis, value in zip('xyz', shift, strict=False)}

    @property
    def deviations(self) -> dict[str, float]:
        """The standard deviations of the estimates, under the same names, in their units."""
        delay = {} if self.delay is None else {'hand_delay': float(self.delay.std)}
        shift = () if self.shift is None else self.shift.std.tolist()
        return delay | {f'hand_shift_{axis}': std for axis, std in zip('xyz', shift, strict=False)}

    @property
    def errors(self) -> dict[str, float]:
        """Those estimates that are certain; hands that are off are so in both level directions."""
        certain = {'hand_delay'} if self.delay is not None and self.delay.certain else set()
        if self.shift is not None and self.shift.certain.any():
            certain |= {'hand_shift_x', 'hand_shift_y', *['hand_shift_z'] * bool(self.shift.certain[2])}
        limits = {name: BY_NAME[name].at_hundred for name in certain}
        return {name: min(max(value, -limits[name]), limits[name])
                for name, value in self.estimates.items() if name in certain}

    def other_than(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the errors of the hands, 0 for none, that clearly differ from `values`, in their units."""
        least = {name: SMALLEST_DELAY if name == 'hand_delay' else SMALLEST_SHIFT for name in self.estimates}
        return {name: self.errors.get(name, 0.0) for name, estimate in self.estimates.items()
                if abs(estimate - values.get(name, 0.0)) > max(least[name], CERTAIN * self.deviations[name])}

    def words(self, errors: Collection[str]) -> str:
        """Return the named errors in words; '' if the hands have none of them."""
        parts = []
        if 'hand_delay' in errors and self.delay is not None:
            late = float(self.delay.value)
            side = 'late' if late > 0 else 'early'
            parts.append(f"the hands' stamps seem {number(1e3 * abs(late))} ms {side}")
        if self.shift is not None:
            off = [f'{measured(abs(value), "m")} off in {"-" * (value < 0)}{axis}'
                   for axis, value in zip('xyz', self.shift.value.tolist(), strict=True)
                   if f'hand_shift_{axis}' in errors]
            parts += [f'the hands seem {" and ".join(off)}'] * bool(off)
        return '; '.join(parts)

    def usable(self, trials: Sequence[Trial]) -> tuple[Trial, ...]:
        """Return trials without what came after a hand has lost the DLO; () if nothing is left."""
        until: dict[str, float] = {}
        for loss in self.losses:
            until[loss.trial] = min(loss.time, until.get(loss.trial, math.inf))
        used = []
        for trial in trials:
            goals = tuple(goal for goal in trial.goals if goal.time <= until.get(trial.name, math.inf))
            if len(goals) == len(trial.goals):
                used.append(trial)
            elif goals and goals[-1].time >= trial.hands[0].start:  # else they show a DLO that nobody moved
                used.append(replace(trial, goals=goals))
        return tuple(used)

    def require_usable(self, trials: Sequence[Trial]) -> tuple[Trial, ...]:
        """
        Return what `usable` does.

        :raises InputError: if nothing is left.
        """
        used = self.usable(trials)
        if not used:
            loss = self.losses[0]
            raise InputError('calibration', f'no trial to use: in {loss.trial}, {loss.words}',
                             'a trial in which the DLO follows the hands', 'repeat the trials')
        return used


@dataclass(frozen=True)
class _Grip:
    """
    A hand in a trial, and what was seen of the DLO meanwhile.

    :param times: (g,) [s] of the views, of which the first shows the DLO before the hand closes.
    :param places: (g, p, 3) [m] where each place that it may grip was; NaN: not seen.
    :param tolerance: [m]; a place that is further from where it was in the hand is not held.
    :param beside: (p,) how far each place is from where the hand seems to grip, along the DLO [m].
    """

    trial: Trial
    hand: Hand
    times: Floats
    places: Floats
    tolerance: float
    beside: Floats

    @classmethod
    def of(cls, trial: Trial, hand: Hand, tolerance: float) -> _Grip:
        before = [goal.chain for goal in trial.goals if goal.time < hand.start]
        views = [goal for goal in trial.goals if hand.start <= goal.time and not goal.stable
                 and goal.time <= hand.end + LATEST]
        if len(views) > MOST_VIEWS:
            views = [views[k] for k in np.linspace(0, len(views) - 1, MOST_VIEWS).round().astype(int)]
        held = [goal for goal in trial.goals if goal.stable and hand in trial.holding(goal)]
        first = before[-1].interpolated(trial.initial.arc_lengths()) if before else trial.initial
        points = np.stack([first.points, *(goal.chain.observed for goal in (*views, *held))])
        at, last = hand.grips[0] + hand.offset, points.shape[1] - 1
        shares = np.array([at])
        if hand.nearest:  # it may really grip anywhere near there
            beside = REACH / trial.initial.length * last
            shares = np.unique(np.clip(at + np.linspace(-beside, beside, PLACES), 0, last))
        low = np.minimum(shares.astype(int), points.shape[1] - 2)
        share = (shares - low)[:, None]
        times = np.array([hand.start, *(goal.time for goal in views), *(hand.end for _ in held)])
        places = points[:, low] * (1 - share) + points[:, low + 1] * share
        return cls(trial, hand, times, places, tolerance, np.abs(shares - at) * trial.initial.length / last)

    @property
    def way(self) -> float:
        """How far the hand moves from where it closes, at most [m]."""
        return float(np.linalg.norm(self.hand.positions - self.hand.positions[0], axis=1).max())

    @property
    def shown(self) -> bool:
        """Whether the views show if the DLO follows the hand."""
        return self.way > WAY and len(self.times) > LOST

    @property
    def visible(self) -> bool:
        """Whether what it grips is seen: the DLO beside it turns about the hand, which looks late or off."""
        return bool(np.isfinite(self.places[:, self.beside.argmin(), 0]).mean() >= 0.5)

    def apart(self, late: Floats) -> Floats:
        """
        Return how far each place is from where it was in the hand at first, (k, g, p) [m]; NaN: unknown.

        :param late: (k,) [s] by which the stamps of the hand may be late.
        """
        at = self.times + late[:, None]
        positions, turns = self.hand.poses(at.ravel())
        inside = self.places - positions.reshape(*at.shape, 1, 3)
        if (self.hand.orientations != self.hand.orientations[0]).any():
            inside = np.einsum('kgji,kgpj->kgpi', turns.reshape(*at.shape, 3, 3), inside)
        inside -= inside[:, :1].copy()
        distances = np.sqrt(np.square(inside).sum(axis=3))
        held = (at <= self.hand.end) & (at >= self.hand.start)
        held[:, 0] = True
        distances[~held] = np.nan
        return np.asarray(distances)

    def squares(self, late: Floats) -> tuple[Floats, Floats]:
        """Return the mean square distance of each place, (k, p) [m^2], and the number of views, (k,)."""
        distances = self.apart(late)[:, 1:]
        seen = np.isfinite(distances)
        count, views = seen.sum(axis=1), seen.any(axis=2).sum(axis=1)
        sums = np.where(seen, np.minimum(np.nan_to_num(distances), self.tolerance)**2, 0.0).sum(axis=1)
        enough = 2 * count >= np.maximum(views, 1)[:, None]
        return np.where(enough, sums / np.maximum(count, 1), np.inf), views

    def loss(self, delay: float) -> Loss | None:
        """Return how the hand has lost the DLO; None: it has not, or nothing shows it."""
        if self.way <= WAY:
            return None
        if len(self.times) == 1:
            return self._left_behind()
        late = np.array([delay])
        squares = self.squares(late)[0][0]
        place, nominal = squares.argmin(), self.beside.argmin()
        distances = self.apart(late)[0, :, place]
        seen = np.flatnonzero(np.isfinite(distances))
        # If the hand hides the grip, the DLO beside it can turn about the hand.
        turning = 0.0 if np.isfinite(squares[nominal]) else 2 * self.beside[place]
        away = distances[seen] > self.tolerance + turning
        for k in range(1, len(seen)):
            run = away[k:k + LOST]
            if run.all() and (len(run) == LOST or len(seen) <= LOST + 1):
                last = float(self.times[seen[k - 1]])
                moved = np.linalg.norm(self.hand.positions_at([last + delay])[0] - self.hand.positions[0])
                missed = bool(moved < max(2 * self.tolerance, WAY))
                return Loss(self.trial.name, self.hand.name, self.hand.start - ROUNDING if missed else last,
                            missed, float(np.nanmax(distances)))
        return None

    def _left_behind(self) -> Loss | None:
        """Return the loss by a hand that has moved, while no point of the DLO did until the next goal."""
        goal = next((goal for goal in self.trial.goals if goal.stable and goal.time >= self.hand.end), None)
        way = float(np.linalg.norm(self.hand.positions[-1] - self.hand.positions[0]))
        if goal is None or way <= WAY:
            return None
        moved = np.linalg.norm(goal.chain.observed - self.trial.initial.observed, axis=1)
        if np.nanmax(moved, initial=0.0) > max(STILL, self.tolerance - FOLLOWS):
            return None
        return Loss(self.trial.name, self.hand.name, self.hand.start - ROUNDING, True, way)


def _delay(grips: Sequence[_Grip]) -> Estimate | None:
    """Return by how much the stamps of hands are late [s]; None: it is not seen."""
    shown = [grip for grip in grips if grip.shown and grip.visible]
    if not shown:
        return None

    def costs(late: Floats) -> Floats:
        """Return the mean square distance for each delay, of the places that follow best, (k,) [m^2]."""
        total, count = np.zeros(len(late)), np.zeros(len(late))
        for grip in shown:
            squares, views = grip.squares(late)
            total += np.where(views > 0, squares.min(axis=1), 0.0) * views
            count += views
        return np.where(count < LOST, np.inf, total / np.maximum(count, 1))

    tried = np.arange(-LATEST, LATEST + STEP / 2, STEP)
    best = int(costs(tried).argmin())
    if best in (0, len(tried) - 1):
        return None
    tried = tried[best] + np.linspace(-STEP, STEP, 41)
    values = costs(tried)
    if not np.isfinite(values).all():
        return None
    at = float(tried[values.argmin()])
    curvature = np.polyfit(tried - at, values, 2)[0]  # the mean square speed
    views = sum(len(grip.times) - 1 for grip in shown) / LOST  # neighbouring ones are not independent
    std = math.sqrt(values.min() / max(curvature, 1e-9) / views)
    return Estimate(np.array(at), np.array(math.hypot(std, EXACT)))


def _shift(grips: Sequence[_Grip], delay: float) -> Estimate | None:
    """Return by how much hands are off in the frame of the chains, (3,) [m]; None: it is not seen."""
    pins = [grip for grip in grips if len(grip.hand.grips) == 1]
    if not pins:
        return None
    costs, offsets = [], []
    for grip in pins:
        offsets.append(grip.places[0] - grip.hand.positions[0])  # (p, 3)
        cost = np.zeros(len(offsets[-1]))
        if grip.shown and grip.visible:
            squares, views = grip.squares(np.array([delay]))
            cost = np.where(views[0] > 0, squares[0], 0.0) * views[0] / LOST / SCATTER**2
        costs.append(np.where(np.isfinite(offsets[-1][:, 0]), cost, np.inf))
    shift = np.zeros(3)
    for _ in range(50):
        beside = np.array([offset[np.argmin(cost + np.nansum((offset + shift)**2, axis=1) / SCATTER**2)]
                           for cost, offset in zip(costs, offsets, strict=True)])
        if not np.isfinite(beside).all():
            return None
        before, shift = shift, -beside.mean(axis=0)
        if np.allclose(shift, before, atol=1e-6):
            break
    scatter = np.sqrt((beside + shift).var(axis=0) + SCATTER**2)
    return Estimate(shift, scatter / math.sqrt(len(pins)))
