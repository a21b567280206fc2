# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Prior estimates: values and bounds of the parameters from observed chains alone, without simulation.

The shape of the parts that hang in the air at rest gives the stiffness of a DLO, see `balance`.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Iterator, Sequence

import numpy as np

from dlo_calibration.model.chain import bezier_curve, Chain, Floats, frozen_array, MINIMUM_SPACING
from dlo_calibration.model.parameters import BY_NAME, GRAVITY, owner, ParameterSpace, SCALE
from dlo_calibration.model.trial import shown_goals, Trial
from dlo_calibration.observation.noise import noise, smooth
from dlo_calibration.observation.table import resting_band, resting_level

RANK = {'free': 0, 'pin': 1, 'unknown': 2}  # number of unknown vectors at an end
#: LEVI_CIVITA[i, j, k] is component k of axis i x axis j.
LEVI_CIVITA = np.cross(np.eye(3)[:, None], np.eye(3)[None, :])


@dataclass(frozen=True)
class Part:
    """
    A part of a chain on which only its weight acts, and loads at its ends and at pinned points.

    :param first: index of its first point in the chain.
    :param last: index of its last point, included.
    :param ends: load at each end: ``free`` none, ``pin`` a force, ``unknown`` a force and a moment.
    :param pins: indices of points between the ends on which an unknown force acts.
    """

    first: int
    last: int
    ends: tuple[str, str]
    pins: tuple[int, ...] = ()


@dataclass(frozen=True)
class Balance:
    """
    The ratios of weight and stiffness that fit the shape of a part.

    :param load: weight per length over bending stiffness, w / EI [1/m^3]; noise can make it negative.
    :param std: standard deviation of `load` [1/m^3].
    :param stretch: weight per length over stretching stiffness, w / EA [1/m]; noise can make it negative.
    :param stretch_std: standard deviation of `stretch` [1/m]; infinite where the part has no tension.
    :param error: root mean square of the residual of a coordinate [m].
    """

    load: float
    std: float
    stretch: float
    stretch_std: float
    error: float


def hanging_parts(points: Floats, level: float | None, margin: float, forces: Sequence[int],
                  pinned: Sequence[int], touching: Sequence[int] = ()) -> Iterator[Part]:
    """
    Yield the hanging parts of a chain at rest.

    :param points: (n, 3) [m].
    :param level: height of the centre line where the DLO lies on the table [m]; None: there is no table.
    :param margin: height above the level below which a point may touch the table [m].
    :param forces: points of clamps, which apply a force and a moment; they end a part.
    :param pinned: points that are held, but free to turn.
    :param touching: points that may touch another part of the DLO; parts with such points are left out.
    """
    last = len(points) - 1
    hangs = np.ones(len(points), bool) if level is None else points[:, 2] > level + margin
    stops = sorted({*(int(i) for i in np.flatnonzero(~hangs)), *forces})
    for before, after in zip([-1, *stops], [*stops, last + 1], strict=True):
        # A clamp at an end belongs to the part; a point on the table does not.
        first = before if before in forces else before + 1
        end = after if after in forces else after - 1
        if end - first < 2 or set(range(first, end + 1)) & set(touching):
            continue
        if not hangs[first:end + 1].all():
            continue
        ends = tuple('pin' if at in pinned and at not in forces else
                     'free' if at == tip and at not in forces else 'unknown'
                     for at, tip in ((first, 0), (end, last)))
        if ends == ('free', 'free') and not any(first < pin < end for pin in pinned):
            continue  # nothing holds it, so it is not at rest
        yield Part(first, end, (ends[0], ends[1]), tuple(pin for pin in sorted(pinned) if first < pin < end))


def balance(points: Floats, places: Floats, part: Part, noise: float) -> Balance | None:
    """
    Fit the balance of moments to a part: `EI t x t' = M`, where weight and hands cause the moment M.

    The balance (Antman, Nonlinear Problems of Elasticity, 2nd ed., 8.3) is integrated
    twice: `r = r0 + s t0 + integral integral (M / EI) x t` is linear in w / EI and in
    the forces and moments over EI, and needs no curvature of noisy points.  M is
    computed along the observed points first, then along the fitted shape.
    In a long part, a small error of the shape makes a large error of M far away.
    Such a part is cut into windows, which share w / EI and the forces; each has
    its own r0, t0 and moment.

    :param points: (n, 3) [m] of the whole chain.
    :param places: (n,) arc lengths of the points [m].
    :param noise: standard deviation of a coordinate [m].
    :returns: None where there are too few points for the unknowns.
    """
    observed = points[part.first:part.last + 1]
    along = places[part.first:part.last + 1] - places[part.first]
    pins, ends = [pin - part.first for pin in part.pins], part.ends
    if RANK[ends[1]] < RANK[ends[0]]:  # begin at the end with fewer unknowns
        observed, along, ends = observed[::-1], (along[-1] - along)[::-1], ends[::-1]
        pins = [len(observed) - 1 - pin for pin in pins][::-1]
    most = max(1, (len(observed) - 1) // 7)  # a window has seven segments or more
    best: Balance | None = None
    for windows in dict.fromkeys(min(count, most) for count in (1, 2, 4, 8)):
        fit = _fit_windows(observed, along, ends[0], pins, windows, noise)
        if fit is None:
            break
        if best is None:
            best = fit
            continue
        agrees = abs(fit.load - best.load) < 2 * math.hypot(fit.std, best.std)
        if best.error < 1.5 * noise and agrees:  # the residuals are noise
            break
        # In a window that is too long, errors of the shape make the load too small.
        best = fit if fit.std < best.std or fit.load > best.load else best
    return best


def _fit_windows(observed: Floats, along: Floats, first: str, pins: list[int], windows: int,
                 noise: float) -> Balance | None:
    """Fit the balance to a part in windows; the load at its last end counts as unknown."""
    system = _System(along, first, pins, windows)
    freedom = sum(len(own) for own, _ in system.rows) * 3 - system.count
    if freedom < 6:  # too few measured coordinates beyond the unknowns
        return None
    shape = bezier_curve(along, observed, system.fine)
    # Only below a free end is the tension known before the fit: it is the weight that hangs there.
    tension = np.array(system.fine) if system.held_at_end else np.zeros(len(shape))
    for step in range(6):  # alternately: the moments along the shape, the shape
        matrix, forces = system.columns(shape, tension)
        stretch = np.zeros((1, system.count))
        stretch[0, 1] = _integral(tension, system.fine)[-1] * noise / (0.05 * along[-1])  # prior: 5 % strain
        at = np.concatenate([own for own, _ in system.rows])
        right = np.concatenate([observed[at].ravel(), [0.0]])
        seen = np.concatenate([block[::system.each] for block in matrix])
        rows = np.concatenate([seen.reshape(-1, system.count), stretch])
        sizes = np.linalg.norm(rows, axis=0)
        sizes[sizes == 0] = 1
        solution = np.linalg.lstsq(rows / sizes, right, rcond=1e-11)[0] / sizes
        fitted = np.array(shape)
        for block, (_, own) in zip(matrix, system.rows, strict=True):
            fitted[own] = block @ solution
        change = np.abs(fitted - shape).max()
        if solution[0] > 0 and not system.held_at_end:
            tension = np.linalg.norm(forces @ solution, axis=1) / solution[0]
        shape = fitted if step == 0 else (shape + fitted) / 2
        if change < 0.02 * noise:
            break
    residual = right - rows @ solution
    error = float(np.sqrt(residual @ residual / freedom))
    inverse = np.linalg.pinv((rows / sizes).T @ (rows / sizes), rcond=1e-15) / np.outer(sizes, sizes)
    # 1.7: the shape along which moments are computed is noisy too.
    covariance = inverse * (1.7 * max(noise, error))**2
    load = float(solution[0])
    pull = float(_integral(tension, system.fine)[-1])
    # The length along a chain has an error of 0.3 %.
    stretch_std = np.inf if pull <= 0 else float(np.hypot(np.sqrt(max(covariance[1, 1], 0)),
                                                          0.003 * along[-1] / pull))
    return Balance(load, float(np.sqrt(covariance[0, 0])), float(solution[1]), stretch_std, error)


class _System:
    """
    The linear system of a part.

    Its unknowns are w / EI and w / EA; the forces at the first end and at each pin, over EI;
    and for each window r0, t0 and the moment at its beginning, over EI.

    :param along: (k,) arc lengths of the points of the part, from 0 [m].
    """

    def __init__(self, along: Floats, first: str, pins: list[int], windows: int) -> None:
        self.each = max(3, 200 // len(along))  # integration steps per segment
        self.fine = np.append(np.concatenate([np.linspace(a, b, self.each, endpoint=False) for a, b in
                                              zip(along[:-1], along[1:], strict=True)]), along[-1])
        borders = np.linspace(0, len(along) - 1, windows + 1).round().astype(int)
        #: for each window: the indices of its points, and its slice of `fine`
        self.rows = [(np.arange(a, b + 1), slice(a * self.each, b * self.each + 1))
                     for a, b in zip(borders[:-1], borders[1:], strict=True)]
        # indices in `fine` where forces act
        self._forces = [0] * (first != 'free') + [pin * self.each for pin in pins]
        self.held_at_end = not self._forces
        self._first = 2 + 3 * len(self._forces)
        self._turned = first == 'unknown'
        self.count = self._first + 9 * windows - (0 if self._turned else 3)

    def columns(self, shape: Floats, tension: Floats) -> tuple[list[Floats], Floats]:
        """
        Return the derivatives of the positions, and of the internal force, by the u unknowns.

        :param shape: (F, 3) [m] along which moments are computed.
        :param tension: (F,) tension over weight per length [m].
        :returns: (f, 3, u) positions for each window; (F, 3, u) internal force over EI.
        """
        force = np.zeros((len(self.fine), 3, self.count))
        force[:, 2, 0] = self.fine  # weight, upwards
        for k, pin in enumerate(self._forces):
            force[pin:, :, 2 + 3 * k:5 + 3 * k] = -np.eye(3)
        tangent = np.gradient(shape, self.fine, axis=0)
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
        turn = np.einsum('ijk,fj->fik', LEVI_CIVITA, tangent)  # turn @ v is tangent x v
        blocks = []
        column = self._first
        for number, (_, own) in enumerate(self.rows):
            s = self.fine[own] - self.fine[own.start]
            # Kirchhoff: M' = -t x N
            moment = -_integral(turn[own] @ force[own], s)
            if number or self._turned:
                moment[:, :, column + 6:column + 9] = np.eye(3)
            slope = _integral(-turn[own] @ moment, s)
            block = _integral(slope, s)
            block[:, :, 1] = _integral(tension[own, None] * tangent[own], s)
            block[:, :, column:column + 3] = np.eye(3)
            block[:, :, column + 3:column + 6] = s[:, None, None] * np.eye(3)
            column += 9 if number or self._turned else 6
            blocks.append(block)
        return blocks, force


def _integral(values: Floats, s: Floats) -> Floats:
    """Return (n, ...) integrals of (n, ...) values from the first of (n,) places to each, by trapezoids."""
    widths = np.diff(s).reshape(-1, *[1] * (values.ndim - 1))
    parts = np.cumsum(widths * (values[1:] + values[:-1]) / 2, axis=0)
    return np.concatenate([np.zeros_like(values[:1]), parts])  # SciPy's takes half a second to load


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

#: A ratio that all chains at rest determine together: estimate, lower and upper bound.
Ratio = tuple[float, float, float]


def prior_estimates(trials: Sequence[Trial], space: ParameterSpace,
                    table_height: float | None) -> dict[str, PriorEstimate]:
    """
    Estimate the free parameters from the observed chains alone.

    Flexibility and elasticity follow from the balance of moments of hanging parts
    (see `balance`); their bounds leave three standard deviations of the noise and a
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
    load, stretch, hold = _resting(trials, table_height, sigma)
    estimates = {'friction': _friction(load, hold),
                 'self_collision': _self_collision(trials, table_height, sigma)}
    mass = borne_mass(trials)
    if math.isfinite(mass):
        estimates['mass'] = _on_scale('mass', mass, 0.8 * mass, BY_NAME['mass'].at_hundred)
    if 'mass' not in space.free or math.isfinite(mass):  # chains show only stiffness / weight
        weight = (mass if 'mass' in space.free else space.physical({}, length)['mass']) / length * GRAVITY
        estimates['flexibility'] = _flexibility(load, hold, weight)
        estimates['elasticity'] = _elasticity(stretch, weight)
    return {name: estimates.get(owner(name)[0], UNKNOWN) for name in space.free}


def borne_mass(trials: Sequence[Trial]) -> float:
    """
    Return the largest mass whose weight the hands bore in a goal [kg], by measured forces; nan: none did.

    It is that of the DLO where the table bears nothing; differences of forces of an unknown offset bound it.
    """
    weights = []
    for trial in trials:
        for tared in (True, False):
            downward = np.zeros(len(trial.goals))
            for k, _, force in trial.forces:
                downward[k] -= force.vector[2] if force.tared == tared else 0.0
            weights.append(float(downward.max() if tared else np.ptp(downward)))
    heaviest = max(weights, default=0.0)
    return heaviest / GRAVITY if heaviest > 0 else float('nan')


def start_point(trials: Sequence[Trial], space: ParameterSpace, table_height: float | None) -> Floats:
    """Return the `prior_estimates` as a (d,) point of the box, nan where there is none."""
    estimates = prior_estimates(trials, space, table_height)
    return frozen_array(space.point({name: estimate.value for name, estimate in estimates.items()}))


def _on_scale(name: str, value: float, lowest: float, highest: float) -> PriorEstimate:
    """Return the estimate of a physical value (> 0, or nan) and its bounds, clipped to the scale."""
    def scaled(physical: float) -> float:
        return min(SCALE, max(0.0, BY_NAME[name].value(physical)))

    lower, upper = sorted((scaled(lowest), scaled(highest)))
    at = value if math.isnan(value) else min(upper, max(lower, scaled(value)))
    return PriorEstimate(at, lower, upper)


def _resting(trials: Sequence[Trial], table_height: float | None, sigma: float
             ) -> tuple[Ratio, Ratio, float]:
    """
    Combine the balances of all hanging parts, and the friction that all lying chains need.

    :returns: w / EI [1/m^3] and w / EA [1/m] of the hanging parts, and the least mu w / EI that keeps the DLO
        bent on the table [1/m^3]; 0: no chain lies bent.
    """
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
            # Unseen points give no information, but a hand may hold the DLO there.
            used = np.flatnonzero(goal.chain.seen | np.isin(np.arange(len(goal.chain)), [*clamps, *pins]))
            points, along = goal.chain.points[used], places[used]
            clamps, pins = (np.searchsorted(used, grips).tolist() for grips in (clamps, pins))
            touching = _near_itself(points, along, sigma)
            for part in hanging_parts(points, level, margin, clamps, pins, touching):
                if fit := balance(points, along, part, sigma):
                    balances.append(fit)
            if not hands:
                lying.append(goal.chain)
        for chain in lying:
            band = resting_band(chain.length) + SIGMAS * sigma
            if level is not None and (chain.points[:, 2] < level + band).all() \
                    and not _near_itself(chain.points, places, sigma):
                hold = max(hold, _friction_that_holds_bends(_smoothed(chain, sigma), 5 * sigma))
    return (_weighted_mean([(b.load, b.std) for b in balances]),
            _weighted_mean([(b.stretch, b.stretch_std) for b in balances]), hold)


def _smoothed(chain: Chain, sigma: float) -> Chain:
    """Return a chain without its noise, rather too smooth: less bending leaves the bounds true."""
    smoothed = smooth(chain.points, 1.3 * sigma)
    steps = np.linalg.norm(np.diff(smoothed, axis=0), axis=1)
    return Chain(smoothed) if (steps > MINIMUM_SPACING).all() else chain


def _weighted_mean(estimates: Sequence[tuple[float, float]]) -> Ratio:
    """Return the weighted mean of (value, standard deviation) pairs, and its bounds; nan if there is none."""
    usable = [(value, std) for value, std in estimates if np.isfinite(value) and np.isfinite(std) and std > 0]
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


def _stiffness_bounds(name: str, ratio: Ratio, weight: float) -> tuple[float, float]:
    """Return the lowest and highest stiffness for a weight per length; `ratio` is weight over stiffness."""
    _, low, high = ratio
    return (weight / (high * STIFFNESS_MARGIN) if math.isfinite(high) else BY_NAME[name].at_hundred,
            weight / low * STIFFNESS_MARGIN if low > 0 else BY_NAME[name].at_zero)


def _flexibility(load: Ratio, hold: float, weight: float) -> PriorEstimate:
    """Return the estimate for a weight per length [N/m]."""
    lowest, highest = _stiffness_bounds('flexibility', load, weight)
    if hold > 0:
        held = BY_NAME['friction'].at_hundred * weight / hold * FRICTION_MARGIN
        highest = held if lowest < held < highest else highest
    return _on_scale('flexibility', weight / load[0] if load[0] > 0 else math.nan, lowest, highest)


def _elasticity(stretch: Ratio, weight: float) -> PriorEstimate:
    """Return the estimate for a weight per length [N/m]."""
    value, low, _ = stretch
    return _on_scale('elasticity', weight / value if low > 0 else math.nan,
                     *_stiffness_bounds('elasticity', stretch, weight))


def _friction(ratio: Ratio, hold: float) -> PriorEstimate:
    load, _, highest_load = ratio
    if hold == 0 or not load > 0:
        return UNKNOWN
    most = BY_NAME['friction'].at_hundred
    halfway = math.sqrt(min(most, hold / load) * most)  # of the bounds, on the scale
    lowest = hold / (highest_load * STIFFNESS_MARGIN * FRICTION_MARGIN)
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
                far = along > np.pi * radii[k] + spacing
                allowed[k] = not bool((room[far] < 2 * radii[k]).any())
    # A larger radius may be allowed though a smaller one is not; the largest allowed one is the bound.
    largest = float(radii[np.flatnonzero(allowed).max(initial=0)])
    levels = [] if table_height is None else [
        level - table_height for trial in trials for level in [resting_level(trial, table_height)]
        if level is not None and parameter.at_zero <= level - table_height <= parameter.at_hundred]
    return _on_scale('self_collision', float(np.median(levels)) if levels else math.nan, parameter.at_zero,
                     largest)
