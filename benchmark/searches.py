# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Compare the searches on the sample objects: evaluations, accuracy, and how often one ends in a worse minimum.

    python benchmark/searches.py [--seeds N] [--engine NAME] [SEARCH ...]

For each object, the score to reach is the median, over the seeds, of the best score of 150
random parameter sets.  The cost of a result is the robust cost that least squares minimises;
the other searches minimise the score, so their cost only shows how close they end.  The
table is printed, and written to benchmark/results/searches.md.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.prior import Prior
from dlo_calibration.evaluation.evaluation import Evaluator
from dlo_calibration.evaluation.residuals import Huber
from dlo_calibration.files.session import read_session
from dlo_calibration.model.parameters import SCALE
from dlo_calibration.search import Observation, SEARCHES

HERE = Path(__file__).resolve().parent
BUDGET = 150
SHOWN = ('flexibility', 'elasticity', 'friction')


def search_with(evaluator: Evaluator, options: Options, name: str, seed: int
                ) -> tuple[list[Observation], Observation]:
    """Return all observations of a search, and the one that is its result."""
    search = SEARCHES[name](evaluator.space.dimension, seed, Prior.of(evaluator.trials, options).hints)
    seen: list[Observation] = []
    while len(seen) < BUDGET:
        points = search.ask(BUDGET - len(seen))
        if not len(points):
            break
        evaluations = [evaluator.evaluate(0, point) for point in points]
        search.tell([Observation(e.point, e.score, e.residuals) for e in evaluations])
        seen.extend(Observation(e.point, e.score, e.residuals) for e in evaluations)
    best = search.best
    assert best is not None
    return seen, next(observation for observation in seen if (observation.point == best).all())


def rows_of(name: str, names: list[str], seeds: int, engine: str) -> list[str]:
    """Tabulate all searches on one object."""
    session = read_session(HERE.parent / 'msg_samples' / name, None)
    options = replace(session.options, engine=engine)
    evaluator = Evaluator(session.trials, options.space, make_simulator(options))
    done = {method: [search_with(evaluator, options, method, seed) for seed in range(seeds)]
            for method in dict.fromkeys(['random', *names])}
    target = float(np.median([min(observation.score for observation in seen) for seen, _ in done['random']]))
    residuals = {method: [best.residuals for _, best in results] for method, results in done.items()}
    loss = min(Huber.of(each) for results in residuals.values() for each in results)
    lowest = min(loss.cost(each) for results in residuals.values() for each in results)
    rows = []
    for method in names:
        scores = [np.minimum.accumulate([each.score for each in seen]) for seen, _ in done[method]]
        reached = [int(np.argmax(score <= target)) + 1 if score[-1] <= target else BUDGET + 1
                   for score in scores]
        middle = float(np.median(reached))
        worst = max(loss.cost(each) for each in residuals[method]) / lowest
        points = SCALE / evaluator.space.upper * np.array([best.point for _, best in done[method]])
        shown = [list(evaluator.space.free).index(each) for each in SHOWN]
        spread = ' | '.join(f'{points[:, k].mean():.1f} ± {points[:, k].std():.2f}' for k in shown)
        rows.append(
            f'| {name[-1]} | {method} | {target:.1f} | {f"{middle:g}" if middle <= BUDGET else "not"} '
            f'| {max(reached) if max(reached) <= BUDGET else "not"} '
            f'| {np.median([len(score) for score in scores]):g} '
            f'| {np.median([score[-1] for score in scores]):.1f} | {spread} | {worst:.2f} |')
    return rows


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('searches', nargs='*', metavar='SEARCH', help=', '.join(SEARCHES))
    parser.add_argument('--seeds', type=int, default=20)
    parser.add_argument('--engine', default='compiled')
    arguments = parser.parse_args()
    names = arguments.searches or list(SEARCHES)
    head = ('object', 'search', 'score to reach', 'evaluations until then, median', 'worst',
            'evaluations in all', 'score', *SHOWN, 'worst cost / lowest')
    rows = [f'| {" | ".join(head)} |', '|' + '---|' * len(head)]
    for k in range(1, 6):
        rows += rows_of(f'object{k}', names, arguments.seeds, arguments.engine)
    text = (f'# searches\n\n`python benchmark/searches.py --seeds {arguments.seeds} '
            f'--engine {arguments.engine}`\n\n' + '\n'.join(rows) +
            '\n\nParameters: mean and standard deviation over the seeds, on the 0..100 scale.\n')
    print(text)
    (HERE / 'results' / 'searches.md').write_text(text)


if __name__ == '__main__':
    main()
