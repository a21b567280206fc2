# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Compare calibrations of the reference objects with their true parameters, over many draws of the noise.

    python benchmark/intervals.py [--draws 100] [--search NAME] [--workers 2]

Each draw adds new noise of 1 mm per coordinate to the exact chains, calibrates
the paper's four parameters on four actions, and tries the result on the five
other actions.  The table is printed, and written to benchmark/results/intervals.md;
with another search than the default one, to intervals_NAME.md.  Reads the folder
reference of DLO_DATA.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
import multiprocessing
from pathlib import Path
import sys
import time

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from discretisation import exact_trials  # noqa: E402

from dlo_calibration import Chain, Trial  # noqa: E402
from dlo_calibration.calibration.calibrate import fitted  # noqa: E402
from dlo_calibration.calibration.options import Options  # noqa: E402
from dlo_calibration.calibration.setting import Setting  # noqa: E402
from dlo_calibration.evaluation.evaluation import Evaluator  # noqa: E402
from dlo_calibration.model.parameters import (  # noqa: E402
    BY_NAME,
    PAPER_PARAMETERS,  # noqa: E402
)
from dlo_calibration.search import LeastSquares  # noqa: E402
from dlo_calibration.simulation.compiled import CompiledSimulator  # noqa: E402

NOISE = 1e-3  # m, standard deviation of a coordinate
FITTED = ('place_end', 'drag_quarter', 'hold_middle', 'two_hands')
TRUTH = {'flexibility': 'EI', 'elasticity': 'EA', 'friction': 'mu', 'self_collision': 'radius'}


@dataclass(frozen=True)
class Draw:
    """One calibration, on one draw of the noise."""

    values: np.ndarray
    std: np.ndarray
    inside: np.ndarray
    verdicts: tuple[str, ...]
    evaluations: int
    error: float
    unseen: float
    cross_validated: float
    seconds: float


def noisy(trial: Trial, generator: np.random.Generator) -> Trial:
    """Return a trial as it would be observed."""
    def chain(exact: Chain) -> Chain:
        return Chain(exact.points + generator.normal(0, NOISE, exact.points.shape))

    return replace(trial, initial=chain(trial.initial),
                   goals=tuple(replace(goal, chain=chain(goal.chain)) for goal in trial.goals))


def draw(name: str, search: str, seed: int) -> Draw:
    """Calibrate on one draw of the noise."""
    properties, exact = exact_trials(name)
    generator = np.random.default_rng(seed)
    trials = [noisy(trial, generator) for trial in exact]
    calibrated = [trial for trial in trials if trial.name in FITTED]
    other = [trial for trial in trials if trial.name not in FITTED]
    options = Options(mass=properties['mass'], search=search, seed=seed)
    begun = time.perf_counter()
    result = fitted(Setting(tuple(calibrated), options, CompiledSimulator()))
    seconds = time.perf_counter() - begun
    truth = np.array([BY_NAME[name].value(properties[TRUTH[name]]) for name in PAPER_PARAMETERS])
    estimates = [result.parameters[name] for name in PAPER_PARAMETERS]
    unseen = Evaluator(other, result.space, CompiledSimulator()).evaluate(0, result.best.point).errors
    assert unseen is not None and result.examination is not None
    return Draw(
        np.array([each.value for each in estimates]), np.array([each.std for each in estimates]),
        np.array([each.lower <= at <= each.upper for each, at in zip(estimates, truth, strict=True)]),
        tuple(each.verdict for each in estimates), len(result.evaluations), result.errors.mean, unseen.mean,
        result.examination.cross_validated, seconds)


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--draws', type=int, default=100)
    parser.add_argument('--search', default=LeastSquares.name)
    parser.add_argument('--workers', type=int, default=2)
    options = parser.parse_args()
    title, chosen = 'intervals', ''
    if options.search != LeastSquares.name:
        title, chosen = f'intervals_{options.search}', f' --search {options.search}'
    rows = ['| object | parameter | truth | mean found | std over draws | median stated std '
            '| 90 % intervals that contain the truth | identifiable |', '|' + '---|' * 8]
    fits = ['| object | evaluations, median | fitted error, mm | unseen actions, mm '
            '| cross-validated, mm | seconds, median |', '|' + '---|' * 6]
    inside = []
    with ProcessPoolExecutor(options.workers, multiprocessing.get_context('spawn')) as executor:
        for k in range(1, 6):
            name = f'object{k}'
            draws = list(executor.map(partial(draw, name, options.search), range(options.draws)))
            properties, _ = exact_trials(name)
            for j, parameter in enumerate(PAPER_PARAMETERS):
                values = np.array([each.values[j] for each in draws])
                identifiable = np.array([each.verdicts[j] == 'identifiable' for each in draws])
                covered = np.array([each.inside[j] for each in draws])
                truth = BY_NAME[parameter].value(properties[TRUTH[parameter]])
                rows.append(
                    f'| {k} | {parameter} | {truth:.1f} | {values.mean():.1f} | {values.std():.2f} '
                    f'| {np.median([each.std[j] for each in draws]):.2f} | {100 * covered.mean():.0f} % '
                    f'| {100 * identifiable.mean():.0f} % |')
                if parameter != 'self_collision':
                    inside.append(covered.mean())
            fits.append(
                f'| {k} | {np.median([each.evaluations for each in draws]):.0f} '
                f'| {1e3 * np.mean([each.error for each in draws]):.2f} '
                f'| {1e3 * np.mean([each.unseen for each in draws]):.2f} '
                f'| {1e3 * np.mean([each.cross_validated for each in draws]):.2f} '
                f'| {np.median([each.seconds for each in draws]):.1f} |')
            print(*rows[-4:], fits[-1], sep='\n', flush=True)
    text = (
        f'# {title}\n\n`python benchmark/intervals.py --draws {options.draws}{chosen}`: {options.draws} '
        'draws of the noise for each object. The mean distance that noise alone makes is 1.6 mm.\n\n'
        + '\n'.join(rows) + '\n\nOver all but self_collision, '
        f'{100 * np.mean(inside):.0f} % of the 90 % intervals contain the truth.\n\n'
        + '\n'.join(fits) + '\n')
    (HERE / 'results' / f'{title}.md').write_text(text, encoding='utf-8')
    print(text.split('\n\n')[-2])


if __name__ == '__main__':
    main()
