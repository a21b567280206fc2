# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Prior estimates: values and bounds of the parameters from observed chains alone, without simulation."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Sequence

import numpy as np

from dlo_calibration.model.chain import Chain, Floats, frozen_array, MINIMUM_SPACING
from dlo_calibration.model.parameters import BY_NAME, GRAVITY, ParameterSpace, SCALE
from dlo_calibration.model.trial import shown_goals, Trial
from dlo_calibration.observation.hanging import Balance, balance, hanging_parts
from dlo_calibration.observation.noise import noise, smooth
from dlo_calibration.observation.table import RESTING_BAND, resting_level

SIGMAS = 3.0  # standard deviations of the noise by which bounds are widened
STIFFNESS_MARGIN = 2.0  # factor, either way, for natural curvature, twist and other effects left out
FRICTION_MARGIN = 3.0  # factor: smoothing changes the curvature of a resting DLO
SAMPLES = 160  # steps along a resampled curve


@dataclass(frozen=True)
class PriorEstimate:
    """
    Estimate of one parameter on the 0..100 scale, from observed chains alone.

    :param value: nan where the chains do not determine one.
    :param lower: lower bound of the true value, as far as the model holds; 0 where nothing is known.
    :param upper: upper bound of the true value, likewise; 100 where nothing is known.
    """

    value: float = math.nan
    lower: float = 0.0
    upper: float = SCALE


UNKNOWN = PriorEstimate()


@dataclass(frozen=True)
class _Resting:
    """
    The ratios that all chains at rest determine together.

    :param load: w / EI [1/m^3] of the hanging parts: estimate, lower and upper bound.
    :param stretch: w / EA [1/m] of the hanging parts: estimate, lower and upper bound.
    :param parts: number of hanging parts.
    :param hold: least mu w / EI that keeps the DLO bent on the table [1/m^3]; 0: no chain lies bent.
    """

    load: tuple[float, float, float]
    stretch: tuple[float, float, float]
    parts: int
    hold: float


def prior_estimates(trials: Sequence[Trial], space: ParameterSpace,
                    table_height: float | None) -> dict[str, PriorEstimate]:
    """
    Estimate the free parameters from the observed chains alone.

    Flexibility and elasticity follow from the balance of moments of hanging parts
    (see `hanging`); their bounds leave three standard deviations of the noise and a
    factor of two either way. Friction keeps a DLO bent on the table against its
    stiffness: a third of the friction that the curve needs is a lower bound. The
    smallest observed distance between parts that are not neighbours is an upper bound
    of twice the self-collision radius. Chains at rest do not show the other parameters.

    :param table_height: [m]; None where there is no table.
    """
    sigma = noise(trials)
    # 2 mm where chains have too few points to estimate it; at least 0.2 mm, as the model is no better.
    sigma = 2e-3 if math.isnan(sigma) else max(2e-4, sigma)
    length = float(np.median([trial.initial.length for trial in trials]))
    resting = _resting(trials, table_height, sigma)
    known = {'friction': _friction(resting), 'self_collision': _self_collision(trials, table_height, sigma)}
    if 'mass' not in space.free:  # chains at rest show stiffness only in proportion to weight
        weight = space.physical({}, length)['mass'] / length * GRAVITY
        known |= {'flexibility': _flexibility(resting, weight), 'elasticity': _elasticity(resting, weight)}
    return {name: known.get(name, UNKNOWN) for name in space.free}


def start_point(trials: Sequence[Trial], space: ParameterSpace, table_height: float | None) -> Floats:
    """Return the `prior_estimates` as a (d,) point of the unit cube, nan where there is none."""
    found = prior_estimates(trials, space, table_height)
    return frozen_array([one.value / SCALE for one in found.values()])


def _on_scale(name: str, value: float, lowest: float, highest: float) -> PriorEstimate:
    """Return the estimate of a physical value (> 0, or nan) and its bounds, clipped to the scale."""
    def scaled(physical: float) -> float:
        return min(SCALE, max(0.0, BY_NAME[name].value(physical)))

    lower, upper = sorted((scaled(lowest), scaled(highest)))
    at = value if math.isnan(value) else min(upper, max(lower, scaled(value)))
    return PriorEstimate(at, lower, upper)


def _resting(trials: Sequence[Trial], table_height: float | None, sigma: float) -> _Resting:
    """Combine the balances of all hanging parts, and the friction that all lying chains need."""
    balances: list[Balance] = []
    hold = 0.0
    for trial in trials:
        initial = _smoothed(trial.initial, sigma)
        places = initial.arc_lengths()
        level = None if table_height is None else resting_level(trial, table_height)
        if level is None and table_height is not None:
            level = table_height
        margin = max(0.003, SIGMAS * sigma)  # m; a lower point may touch the table
        lying = [trial.initial] if trial.velocity is None else []
        for goal in trial.goals:
            if not goal.stable:
                continue
            hands = trial.holding(goal)
            clamps = [grip for hand in hands if len(hand.grips) > 1 for grip in hand.grips]
            pins = [hand.grips[0] for hand in hands if len(hand.grips) == 1]
            # Points that were not seen tell nothing, but a hand holds the DLO also there.
            kept = np.flatnonzero(goal.chain.seen | np.isin(np.arange(len(goal.chain)), [*clamps, *pins]))
            points, along = goal.chain.points[kept], places[kept]
            clamps, pins = (np.searchsorted(kept, held).tolist() for held in (clamps, pins))
            touching = _near_itself(points, along, sigma)
            for part in hanging_parts(points, level, margin, clamps, pins, touching):
                found = balance(points, along, part, sigma)
                if found is not None:
                    balances.append(found)
            if not hands:
                lying.append(goal.chain)
        for chain in lying:
            if level is not None and (chain.points[:, 2] < level + RESTING_BAND + SIGMAS * sigma).all() \
                    and not _near_itself(chain.points, places, sigma):
                hold = max(hold, _friction_that_holds_bends(_smoothed(chain, sigma), 5 * sigma))
    return _Resting(_weighted_mean([(b.load, b.std) for b in balances]),
                    _weighted_mean([(b.stretch, b.stretch_std) for b in balances]), len(balances), hold)


def _smoothed(chain: Chain, sigma: float) -> Chain:
    """Return a chain without its noise, rather too smooth: less bending leaves the bounds true."""
    smoothed = smooth(chain.points, 1.3 * sigma)
    steps = np.linalg.norm(np.diff(smoothed, axis=0), axis=1)
    return Chain(smoothed) if (steps > MINIMUM_SPACING).all() else chain


def _weighted_mean(found: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """Return the weighted mean of (value, standard deviation) pairs, and its bounds; nan if there is none."""
    usable = [(value, std) for value, std in found if np.isfinite(value) and np.isfinite(std) and std > 0]
    if not usable:
        return math.nan, -math.inf, math.inf
    values, stds = np.array(usable).T
    weights = stds**-2 / np.sum(stds**-2)
    mean = float(weights @ values)
    scatter = float(np.sqrt(weights @ (values - mean)**2))  # repeats share systematic errors
    std = max(float(np.sum(stds**-2)**-0.5), scatter)
    return mean, max(mean, 0.0) - SIGMAS * std, max(mean, 0.0) + SIGMAS * std


def _friction_that_holds_bends(chain: Chain, visible: float) -> float:
    """
    Return the least mu w / EI that keeps a lying DLO bent [1/m^3].

    By virtual work: when the stretch from a point to one end straightens a little,
    in proportion to its bend, the bending energy falls by EI times the integral of
    the squared curvature, and friction dissipates at most mu w times the integral
    of the paths of its points.  Stretches of half the DLO or more are tried.

    :param visible: a bend is noise if straightening it would move its points by less on average [m].
    """
    places = np.linspace(0, chain.length, SAMPLES + 1)
    step = places[1]
    curve = chain.resample(places)[:, :2]
    most = 0.0
    for side in (curve, curve[::-1]):
        tangent = np.gradient(side, step, axis=0)
        angle = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        normal = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
        curvature = np.gradient(angle, step)
        for first in range(0, SAMPLES // 2 + 1, 8):
            turn = angle[first:] - angle[first]
            path = np.linalg.norm(np.cumsum(turn[:, None] * normal[first:], axis=0) * step, axis=1)
            work = float(path.sum())
            if work > visible * len(path):
                most = max(most, float(np.sum(curvature[first:]**2)) / work)
    return most


def _pair_distances(chain: Chain) -> tuple[Floats, Floats]:
    """Return the distances of all pairs of points of a curve, along it and in space, (p,) [m] each."""
    places = np.linspace(0, chain.length, SAMPLES + 1)
    points = chain.resample(places)
    first, second = np.triu_indices(len(points), 1)
    return places[second] - places[first], np.linalg.norm(points[second] - points[first], axis=1)


def _near_itself(points: Floats, places: Floats, sigma: float) -> list[int]:
    """Return the indices of points that may touch another part of the DLO."""
    largest = BY_NAME['self_collision'].at_hundred
    along = np.abs(places[:, None] - places[None, :])
    space = np.linalg.norm(points[:, None] - points[None, :], axis=2)
    spacing = float(np.diff(places).max())
    near = (along > np.pi * largest + spacing) & (space < 2 * largest + SIGMAS * sigma)
    return [int(i) for i in np.flatnonzero(near.any(axis=1))]


def _flexibility(resting: _Resting, weight: float) -> PriorEstimate:
    """Return the estimate for a weight per length [N/m]."""
    load, low, high = resting.load
    parameter = BY_NAME['flexibility']
    lowest, highest = parameter.at_hundred, parameter.at_zero
    if resting.parts:
        lowest = weight / (high * STIFFNESS_MARGIN)
        highest = weight / low * STIFFNESS_MARGIN if low > 0 else highest
    if resting.hold > 0:
        held = BY_NAME['friction'].at_hundred * weight / resting.hold * FRICTION_MARGIN
        highest = held if lowest < held < highest else highest
    return _on_scale('flexibility', weight / load if load > 0 else math.nan, lowest, highest)


def _elasticity(resting: _Resting, weight: float) -> PriorEstimate:
    """Return the estimate for a weight per length [N/m]."""
    stretch, low, high = resting.stretch
    if not math.isfinite(high):
        return UNKNOWN
    highest = weight / low * STIFFNESS_MARGIN if low > 0 else BY_NAME['elasticity'].at_zero
    return _on_scale('elasticity', weight / stretch if low > 0 else math.nan,
                     weight / (high * STIFFNESS_MARGIN), highest)


def _friction(resting: _Resting) -> PriorEstimate:
    load, _, highest_load = resting.load
    if resting.hold == 0 or not load > 0:
        return UNKNOWN
    most = BY_NAME['friction'].at_hundred
    halfway = math.sqrt(min(most, resting.hold / load) * most)  # of the bounds, on the scale
    lowest = resting.hold / (highest_load * STIFFNESS_MARGIN * FRICTION_MARGIN)
    return _on_scale('friction', halfway, lowest, most)


def _self_collision(trials: Sequence[Trial], table_height: float | None, sigma: float) -> PriorEstimate:
    parameter = BY_NAME['self_collision']
    radii = np.geomspace(parameter.at_zero, parameter.at_hundred, 60)  # 5 % apart
    allowed = np.ones(len(radii), bool)
    for trial in trials:
        seen = shown_goals(len(trial.goals))  # a few of hundreds: fewer make the bound wider, not wrong
        for chain in (trial.initial, *(trial.goals[k].chain for k in seen)):
            along, space = _pair_distances(chain)
            spacing = float(np.linalg.norm(np.diff(chain.points, axis=0), axis=1).max())
            room = space * 1.2 + SIGMAS * sigma  # a chain cuts corners
            for k in np.flatnonzero(allowed):  # nearer parts cannot touch, see `self_contact`
                apart = along > np.pi * radii[k] + spacing
                allowed[k] = not bool((room[apart] < 2 * radii[k]).any())
    # A larger radius may be allowed though a smaller one is not; the largest allowed one is the bound.
    largest = float(radii[np.flatnonzero(allowed).max(initial=0)])
    levels = [] if table_height is None else [
        level - table_height for trial in trials for level in [resting_level(trial, table_height)]
        if level is not None and parameter.at_zero <= level - table_height <= parameter.at_hundred]
    return _on_scale('self_collision', float(np.median(levels)) if levels else math.nan, parameter.at_zero,
                     largest)
