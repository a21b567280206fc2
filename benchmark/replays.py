# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Replays: compares another simulator with our engine and with the measurement, and with the elastica."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Callable, Iterator, Sequence

from accuracy import convert, fit
from figures import table
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_bvp

from dlo_calibration import read_result, read_session, Trial
from dlo_calibration.model.parameters import GRAVITY
from dlo_calibration.simulation.compiled import CompiledSimulator

Floats = NDArray[np.float64]
OBJECTS = tuple(f'object{k}' for k in range(1, 6))
SETTLING = 4.0  # s after the last motion of a hand
LENGTH, MASS = 0.6, 0.03  # m, kg, of the cantilevers


@dataclass(frozen=True)
class Grip:
    """A point of the chain that a hand holds, and its (k,) times [s] and (k, 3) positions [m]."""

    point: int
    times: Floats
    positions: Floats


#: Simulates a calibrated DLO from the start of a trial; returns its points, (n, 3) [m], at a time [s].
Replay = Callable[[Any, Trial, list[Grip], float], Floats]


def grips(trial: Trial, until: float) -> list[Grip]:
    """Return the grips of a trial; those that hold at the last goal hold until the end [s]."""
    held = []
    for hand in trial.hands:
        times, positions = np.array(hand.times), np.array(hand.positions)
        if trial.holds(hand, trial.goals[-1]):
            times, positions = np.append(times, until + 1), np.vstack([positions, positions[-1:]])
        start = positions[0] - trial.initial.points[list(hand.grips)].mean(axis=0) * (len(hand.grips) > 1)
        for grip in hand.grips:
            offset = trial.initial.points[grip] + start - positions[0] if len(hand.grips) > 1 else 0.0
            held.append(Grip(grip, times, positions + offset))
    return held


def compared(folder: Path, replay: Replay, most: int, names: Sequence[str] = OBJECTS) -> str:
    """
    Return a table of objects, fitted on four trials each, in at most `most` other trials each.

    :param folder: for results; existing ones are used.
    """
    rows = []
    for name in names:
        if not (folder / name / 'result.xml').exists():
            fit(convert('reference', name, folder / f'{name}_session'), folder / name)
        result = read_result(folder / name / 'result.xml')
        if not (folder / f'{name}_other').exists():
            convert('reference', name, folder / f'{name}_other', '--actions', 'other')
        values = {key: estimate.value for key, estimate in result.parameters.items()}
        simulator = CompiledSimulator()
        away: list[list[float]] = [[], [], []]
        for trial in read_session(folder / f'{name}_other').trials[:most]:
            end = max(trial.goals[-1].time, max(hand.end for hand in trial.hands) + SETTLING)
            ours = simulator.simulate(trial, result.space.physical(values, trial.initial.length)).chains[-1]
            theirs = replay(result, trial, grips(trial, end), end)
            measured = trial.goals[-1].chain.points
            pairs = (theirs, ours), (theirs, measured), (ours, measured)
            for distances, (points, other) in zip(away, pairs, strict=True):
                distances.append(distance(points, other))
            print(name, trial.name, *(f'{distances[-1]:.2f}' for distances in away), flush=True)
        rows.append([name[-1], *(f'{np.mean(distances):.2f}' for distances in away), f'{max(away[0]):.2f}',
                     f'{np.mean(away[1]) / np.mean(away[2]):.2f}'])
    return table(['object', 'from our engine, mm', 'from the measurement, mm',
                  'our engine from the measurement, mm', 'worst trial from our engine, mm',
                  'times our error'], rows)


def cantilevers(tip: Callable[[float, int], Floats], cases: Iterator[tuple[float, int]], clamp: float) -> str:
    """
    Return a table of cantilevers at rest.

    :param tip: returns the tip, [m], of a DLO with EI [N m^2] and a number of segments, the first clamped.
    :param clamp: share of the first segment that does not bend.
    """
    rows = []
    for stiffness, segments in cases:
        away = np.linalg.norm(tip(stiffness, segments) - elastica(stiffness, clamp * LENGTH / segments))
        rows.append([f'{stiffness:g}', segments, f'{1e3 * away:.2f}', f'{100 * away / LENGTH:.3f}'])
        print(*rows[-1], flush=True)
    return table(['EI, N m²', 'segments', 'tip from the elastica, mm', '% of the length'], rows)


def distance(points: Floats, other: Floats) -> float:
    """Return the mean distance of points, (n, 3) [m] each, in mm."""
    return 1e3 * float(np.linalg.norm(points - other, axis=1).mean())


def elastica(stiffness: float, clamp: float, mass: float = MASS) -> Floats:
    """Return the tip of a horizontal cantilever under its weight, (3,) [m]; its clamp ends at x = `clamp`."""
    free, load = LENGTH - clamp, mass / LENGTH * GRAVITY
    s = np.linspace(0, free, 400)
    shape = np.stack([0 * s, 0 * s, clamp + s, 0 * s])

    def slope(share: float, at: Floats, y: Floats) -> Floats:
        moment = share * load * (free - at) * np.cos(y[0])
        return np.stack([y[1], moment / stiffness, np.cos(y[0]), np.sin(y[0])])

    def ends(first: Floats, last: Floats) -> Floats:
        return np.array([first[0], last[1], first[2] - clamp, first[3]])

    for share in np.geomspace(min(1.0, stiffness / load / free**3), 1, 14):  # a limp one needs a good start
        solved = solve_bvp(partial(slope, share), ends, s, shape, tol=1e-6, max_nodes=50000)
        if not solved.success:
            raise RuntimeError(solved.message)
        s, shape = solved.x, solved.y
    return np.array([shape[2, -1], 0.0, shape[3, -1]])
