# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Measure the rungs: what fewer nodes and longer steps cost and save in searches.

    python benchmark/ladder.py [SESSION ...]

Searches are those of the sessions, by default of the five samples.  Each is made with the default nodes and
steps, and on each rung.  The result of a rung then climbs: least squares goes on with the default ones from
there, with the Jacobian that it has; the tenth of the points of another search with the lowest scores is
evaluated again.  The random search tries the same points on all rungs, so that their scores are compared,
too.  All is simulated in one process.  The table is printed, and that of the samples written to
benchmark/results/ladder.md.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
import time
from typing import Callable, NamedTuple, Sequence

from figures import table
import numpy as np

from dlo_calibration import Options
from dlo_calibration.calibration.calibrate import fitted
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.fit import Fit, fit
from dlo_calibration.calibration.prior import Prior
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.files.session import read_session, samples, session_trials
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.trial import Trial
from dlo_calibration.search import Hints, LeastSquares, SEARCHES
from dlo_calibration.search.sampling import RandomSearch

RESULTS = Path(__file__).resolve().parent / 'results'
RUNGS = ((31, 0.004), (21, 0.006), (15, 0.009))  # nodes, time step [s]
BUDGET = 150  # evaluations
NARROW = 0.5  # of the range; parameters with wider intervals are left out


class Measured(NamedTuple):
    """A search: seconds, evaluations, and its best point, (d,)."""

    seconds: float
    evaluations: int
    point: Floats


def timed(call: Callable[[], Fit]) -> tuple[Measured, Fit]:
    """Return the measures and the fit of a search in this process."""
    begun = time.process_time()
    outcome = call()
    return Measured(time.process_time() - begun, len(outcome.evaluations), outcome.best.point), outcome


class Comparison:
    """The searches of one session, on all rungs."""

    def __init__(self, trials: Sequence[Trial], options: Options) -> None:
        self._trials, self._options = tuple(trials), options
        self._default = self._on(options)
        prior, result = Prior.of(self._default.trials, self._default.options), fitted(self._default)
        self._hints, self._space = prior.hints, prior.space
        widths = self._space.point({name: result.parameters[name].upper - result.parameters[name].lower
                                    for name in self._space.free})
        self._intervals = np.where(widths < NARROW, widths, np.inf)

    def _on(self, options: Options) -> Setting:
        return Setting(self._trials, options, make_simulator(options))

    def _away(self, point: Floats, other: Floats) -> float:
        return float((np.abs(point - other) / self._intervals).max())

    def rows(self, name: str) -> list[list[float]]:
        """
        Return a row of numbers for another seed, and one for each rung; see `main`.

        :param name: of the search.
        """
        usual, fine = timed(lambda: self._search(name, self._default, 1))
        other, _ = timed(lambda: self._search(name, self._default, 2))
        away = self._away(other.point, usual.point)
        rows = [[usual.evaluations, usual.seconds, away, 0.0, 0, usual.seconds, away]]
        for nodes, step in RUNGS:
            setting = self._on(replace(self._options, nodes=nodes, time_step=step))
            measured, coarse = timed(lambda setting=setting: self._search(name, setting, 1))
            climbed, _ = timed(lambda coarse=coarse: self._climb(coarse))
            difference = score_difference(fine, coarse) if name == RandomSearch.name else 0.0
            rows.append([measured.evaluations, measured.seconds, self._away(measured.point, usual.point),
                         difference, climbed.evaluations, measured.seconds + climbed.seconds,
                         self._away(climbed.point, usual.point)])
        return rows

    def _search(self, name: str, setting: Setting, seed: int) -> Fit:
        search = SEARCHES[name](self._space.dimension, seed, self._hints)
        return fit(setting, self._space, search, BUDGET)

    def _climb(self, coarse: Fit) -> Fit:
        """Return the fit with the default nodes and steps that starts at the result of a coarse one."""
        if coarse.search == LeastSquares.name:
            hints = Hints.at(coarse.best.point, None if coarse.model is None else coarse.model.jacobian,
                             upper=self._space.upper)
            search = LeastSquares(self._space.dimension, 1, hints)
            return fit(self._default, self._space, search, BUDGET)
        ranked = sorted(coarse.evaluations, key=attrgetter('score'))[:len(coarse.evaluations) // 10]
        points = np.array([evaluation.point for evaluation in ranked])
        again = tuple(self._default.evaluate(self._space)(points, 0))
        return replace(coarse, best=min(again, key=attrgetter('score')), evaluations=again)


def score_difference(usual: Fit, other: Fit) -> float:
    """Return the median difference [cm] of the scores of two searches that tried the same points."""
    return float(np.median([abs(first.score - second.score)
                            for first, second in zip(usual.evaluations, other.evaluations, strict=True)]))


def name_of(rung: tuple[int, float] | None) -> str:
    """Return the words for a rung."""
    return 'default' if rung is None else f'{rung[0]} nodes, {1e3 * rung[1]:g} ms'


def searches(sessions: Sequence[Path]) -> str:
    """Return the table of the searches."""
    compared = []
    for path in sessions:
        session = read_session(path, None)
        compared.append(Comparison(session_trials(session, session.options)[0], session.options))
    rows = []
    for name in SEARCHES:
        each = np.array([comparison.rows(name) for comparison in compared])  # (sessions, rungs, numbers)
        for k, rung in enumerate((None, *RUNGS)):
            evaluations, seconds, away, difference, again, both, after = each[:, k].T
            rows.append([name, name_of(rung), f'{evaluations.mean():.0f}', f'{seconds.sum():.1f}',
                         f'{away.mean():.2f} ({away.max():.2f})',
                         f'{difference.mean():.1f} ({difference.max():.1f})' if difference.any() else '',
                         f'{again.mean():.0f}' if rung else '', f'{both.sum():.1f}' if rung else '',
                         f'{after.mean():.2f} ({after.max():.2f})' if rung else ''])
    return table(('search', 'rung', 'evaluations', 's', 'error', 'scores differ by, cm',
                  'evaluations after climbing', 's in all',
                  'error after climbing'), rows)


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('sessions', nargs='*', metavar='SESSION', type=Path)
    chosen = parser.parse_args()
    if chosen.sessions:
        print(searches(chosen.sessions))
        return
    text = f"""# ladder

`python benchmark/ladder.py`

Searches on the five samples. Error: the largest distance of a found value from that with the default nodes
and steps, in units of its 90 % interval; parameters with intervals above half of the range are left out. Mean
over the samples (largest). In the row `default` it is that of another seed. Scores of the same random points
differ by the median of all; mean over the samples (largest). Seconds are those of one process, for all
samples.

{searches([samples() / f'object{k}' for k in range(1, 6)])}
"""
    print(text)
    (RESULTS / 'ladder.md').write_text(text)


if __name__ == '__main__':
    main()
