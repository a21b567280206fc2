# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Compare the bending stiffness of hanging wires with that of the planar elastica, solved by another method.

    python benchmark/elastica.py

Both fit bending stiffness and length to the first repeat of each wire in the folder hanging
of DLO_DATA.  The elastica is a boundary value problem with horizontal clamps, solved by
SciPy's collocation; this package simulates, with an increasing number of nodes.  The table
is printed, and written to benchmark/results/elastica.md.
"""

from __future__ import annotations

from dataclasses import replace
import os
from pathlib import Path
import tempfile

from accuracy import convert
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from scipy.optimize import least_squares

from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.files.session import read_session
from dlo_calibration.model.parameters import BY_NAME, GRAVITY
from dlo_calibration.search import Hints, LeastSquares, Observation
from dlo_calibration.simulation.compiled import CompiledSimulator

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get('DLO_DATA', HERE.parent / '../shared/data'))
NODES = (61, 121, 201)
STIFFEST, STEPS = 3e-3, 8  # N m^2, of a wire whose shape follows from the measured angles; down from there
TOLERANCE = 1e-5
GUESS = (0.05, -0.1)  # N, the horizontal and the vertical force in the first clamp

Floats = NDArray[np.float64]


class Elastica:
    """
    An inextensible planar rod between two horizontal clamps, under its weight.

    ``EI theta'' = n_x sin(theta) - n_z cos(theta)``, ``n_z' = w`` (Antman, Nonlinear
    Problems of Elasticity, 2nd ed., 4.2).

    :param points: (n, 2) [m] measured, evenly spaced; the first is the origin.
    :param weight: [N/m].
    """

    def __init__(self, points: Floats, weight: float) -> None:
        self._points, self._weight = points, weight
        self._places = np.linspace(0, 1, len(points))
        segments = np.diff(points, axis=0)
        angles = np.unwrap(np.arctan2(segments[:, 1], segments[:, 0]))
        theta = np.interp(self._places, (self._places[1:] + self._places[:-1]) / 2, angles)
        self._turn = 2 * np.pi * round(float(theta[-1]) / (2 * np.pi))
        self._solution = self._places, np.vstack([*points.T, theta, np.gradient(theta, self._places)]), GUESS

    def residuals(self, stiffness: float, length: float) -> Floats:
        """Return solved minus measured coordinates, (2 n,) [m]; the next solution starts from this one."""
        def slope(s: Floats, y: Floats, force: Floats) -> Floats:
            vertical = force[1] + self._weight * s * length
            moment = force[0] * np.sin(y[2]) - vertical * np.cos(y[2])
            return np.asarray(length * np.vstack([np.cos(y[2]), np.sin(y[2]), y[3], moment / stiffness]))

        def ends(first: Floats, last: Floats, _: Floats) -> Floats:
            return np.array([*first[:3], *(last[:2] - self._points[-1]), last[2] - self._turn])

        places, shape, force = self._solution
        solved = solve_bvp(slope, ends, places, shape, p=force, tol=TOLERANCE, max_nodes=20000)
        if not solved.success:
            raise RuntimeError(solved.message)
        self._solution = solved.x, solved.y, solved.p
        return np.asarray((solved.sol(self._places)[:2].T - self._points).ravel())

    def fit(self, length: float) -> tuple[float, float, float]:
        """Return stiffness [N m^2], length [m], and the root mean square distance [m]."""
        stiffnesses = np.geomspace(STIFFEST, STIFFEST / 30, STEPS)
        costs = [float(np.square(self.residuals(float(stiffness), length)).sum())
                 for stiffness in stiffnesses]
        for stiffness in stiffnesses[::-1]:  # back to the best, so that the fit starts beside a solution
            self.residuals(float(stiffness), length)
            if stiffness >= stiffnesses[int(np.argmin(costs))]:
                break
        start = [np.log(stiffnesses[int(np.argmin(costs))]), length]
        best = least_squares(lambda q: self.residuals(float(np.exp(q[0])), float(q[1])), start,
                             diff_step=1e-4, x_scale=[0.1, 0.01])
        return float(np.exp(best.x[0])), float(best.x[1]), float(np.sqrt(2 * np.mean(best.fun**2)))


def simulated(session: Path, nodes: int) -> tuple[float, float, float]:
    """Return stiffness [N m^2], length divided by the measured one, and root mean square distance [m]."""
    read = read_session(session)
    options = replace(read.options, calibrate=('flexibility', 'length_scale'), parts=1)
    evaluator = Evaluator(read.trials, options.space, CompiledSimulator(table=False, nodes=nodes))
    search = LeastSquares(2, 1, Hints.at(
        np.array([BY_NAME['flexibility'].coordinate(3e-4), 0.5]), upper=options.space.upper))
    while len(points := search.ask(100)):
        search.tell([Observation(evaluation.point, evaluation.score, evaluation.residuals)
                     for evaluation in (evaluator.evaluate(0, point) for point in points)])
    assert search.best is not None
    best = evaluator.evaluate(0, search.best)
    assert best.errors is not None
    flexibility, scale = (BY_NAME[name].physical(value) for name, value in best.values.items())
    return flexibility, scale, best.errors.rms


def main() -> None:
    """Make the table."""
    rows = ['| wire | by | EI, N m^2 | length, m | root mean square, % of the length |', '|' + '---|' * 5]
    for wire in ('white', 'black'):
        with np.load(DATA / 'hanging' / f'{wire}.npz') as source:
            points = source['points'][0][:, [0, 2]].astype(float)
            length, weight = float(source['length_m']), float(source['mass_per_m']) * GRAVITY
        fits = [('elastica', *Elastica(points - points[0], weight).fit(length))]
        with tempfile.TemporaryDirectory() as folder:
            session = Path(folder) / wire
            convert('hanging', wire, session, '--repeats', '0')
            for nodes in NODES:
                stiffness, scale, error = simulated(session, nodes)
                fits.append((f'{nodes} nodes', stiffness, scale * length, error))
        rows += [f'| {wire} | {by} | {stiffness:.3g} | {long:.4f} | {100 * error / length:.2f} |'
                 for by, stiffness, long, error in fits]
    text = '# elastica\n\n`python benchmark/elastica.py`\n\n' + '\n'.join(rows) + '\n'
    print(text)
    (HERE / 'results' / 'elastica.md').write_text(text)


if __name__ == '__main__':
    main()
