# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Check new sessions of the reference objects: unchanged, and with EI or friction 20 % off.

    python benchmark/check.py [--draws 20] [--noise 0.0005] [--objects 1 2 5] [--workers 2]

Each draw calibrates on four actions with new noise, and checks the result on the same four actions with other
noise: as they are, with EI 20 % larger or smaller, and with friction 20 % larger or smaller.  A change adds to the
exact chains what a finer simulation of them changes.  Draws whose 90 % interval of the changed parameter is wider
than 5 % to either side are not counted.  The table is printed, and written to
benchmark/results/check.md.  Reads the folder reference of DLO_DATA.
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
from typing import Mapping

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from discretisation import exact_trials  # noqa: E402

from dlo_calibration import Chain, Options, Trial  # noqa: E402
from dlo_calibration.calibration.calibrate import fitted  # noqa: E402
from dlo_calibration.calibration.setting import Setting  # noqa: E402
from dlo_calibration.files.result import Description  # noqa: E402
from dlo_calibration.model.parameters import ParameterSpace  # noqa: E402
from dlo_calibration.simulation.compiled import CompiledSimulator  # noqa: E402
from dlo_calibration.workspace.check import AGREES, checked, HAS_CHANGED  # noqa: E402
from intervals import FITTED, TRUTH  # noqa: E402

OFF = 0.2  # share of a change
SHARP = 0.05  # half a 90 % interval of a parameter that counts as determined
CASES = ('unchanged', 'flexibility', 'friction')


@dataclass(frozen=True)
class Outcome:
    """
    One check.

    :param sharp: whether the calibration determines the changed parameter; both, where nothing changed.
    :param named: names of the parameters that are said to have changed.
    """

    sharp: bool
    verdict: str
    named: tuple[str, ...]
    seconds: float


def noisy(trials: list[Trial], noise: float, generator: np.random.Generator) -> list[Trial]:
    """Return trials as they would be observed."""
    def chain(exact: Chain) -> Chain:
        return Chain(exact.points + generator.normal(0, noise, exact.points.shape))

    return [replace(trial, initial=chain(trial.initial), goals=tuple(
        replace(goal, chain=chain(goal.chain)) for goal in trial.goals)) for trial in trials]


def changed(trials: list[Trial], physical: Mapping[str, float], name: str, factor: float) -> list[Trial]:
    """Return the trials of a DLO of which one property is larger by a factor."""
    simulator = CompiledSimulator(nodes=61, time_step=0.002)
    others = []
    for trial in trials:
        before = simulator.simulate(trial, physical).chains
        after = simulator.simulate(trial, {**physical, name: factor * physical[name]}).chains
        others.append(replace(trial, goals=tuple(
            replace(goal, chain=Chain(goal.chain.points + there - here))
            for goal, here, there in zip(trial.goals, before, after, strict=True))))
    return others


def draw(name: str, noise: float, seed: int) -> dict[str, Outcome]:
    """Calibrate on one draw of the noise, and check the result in all cases."""
    properties, exact = exact_trials(name)
    exact = [trial for trial in exact if trial.name in FITTED]
    length = float(np.mean([trial.initial.length for trial in exact]))
    physical = {**ParameterSpace(mass=properties['mass']).physical({}, length),
                **{name: properties[key] for name, key in TRUTH.items()}}
    generator = np.random.default_rng(seed)
    options = Options(mass=properties['mass'], seed=seed, workers=1)
    result = fitted(Setting(tuple(noisy(exact, noise, generator)), options, CompiledSimulator()))
    file = Description.of(result)
    sharp = {name: max(
        abs(file.parameters[name].physical_upper / file.parameters[name].physical_value - 1),
        abs(file.parameters[name].physical_lower / file.parameters[name].physical_value - 1)) <= SHARP
        for name in CASES[1:]}
    factor = 1 + OFF if seed % 2 else 1 - OFF
    outcomes = {}
    for case in CASES:
        trials = noisy(exact if case == CASES[0] else changed(exact, physical, case, factor), noise, generator)
        begun = time.perf_counter()
        check = checked(file, trials, options)
        named = () if check.comparison is None else tuple(
            name for name, there in zip(check.validation.space.free, check.comparison.changed, strict=True)
            if there)
        outcomes[case] = Outcome(sharp.get(case, all(sharp.values())), check.verdict, named,
                                 time.perf_counter() - begun)
    return outcomes


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--draws', type=int, default=20, help='for each object')
    parser.add_argument('--noise', type=float, default=5e-4, help='standard deviation of a coordinate [m]')
    parser.add_argument('--objects', type=int, nargs='+', default=[1, 2, 3, 4, 5])
    parser.add_argument('--workers', type=int, default=2)
    options = parser.parse_args()
    rows = ['| object | case | checks | of these determined to 5 % | agrees | changed | cannot tell '
            '| changed, and only the right one named | seconds, median |', '|' + '---|' * 9]
    total: dict[str, list[Outcome]] = {case: [] for case in CASES}

    def row(name: str, case: str, outcomes: list[Outcome]) -> str:
        counted = [each for each in outcomes if each.sharp or case == CASES[0]]
        right = sum(each.verdict == HAS_CHANGED and each.named == (case,) for each in counted)
        agree, change = (sum(each.verdict == verdict for each in counted) for verdict in (AGREES, HAS_CHANGED))
        return (f'| {name} | {case} | {len(outcomes)} | {sum(each.sharp for each in outcomes)} | {agree} '
                f'| {change} | {len(counted) - agree - change} | {"-" if case == CASES[0] else right} '
                f'| {np.median([each.seconds for each in outcomes]):.1f} |')

    with ProcessPoolExecutor(options.workers, multiprocessing.get_context('spawn')) as executor:
        for k in options.objects:
            draws = list(executor.map(partial(draw, f'object{k}', options.noise), range(options.draws)))
            for case in CASES:
                outcomes = [each[case] for each in draws]
                total[case] += outcomes
                rows.append(row(str(k), case, outcomes))
            print(*rows[-3:], sep='\n', flush=True)
    rows += [row('all', case, total[case]) for case in CASES]
    text = (f'# check\n\n`python benchmark/check.py --draws {options.draws} --noise {options.noise} --objects '
            f'{" ".join(map(str, options.objects))}`: four actions of each object, with new noise of '
            f'{1e3 * options.noise:g} mm per coordinate in each session. In the rows of a change, only checks '
            'whose calibration determines the changed parameter to 5 % are counted as agrees, changed or '
            'cannot tell.\n\n' + '\n'.join(rows) + '\n')
    (HERE / 'results' / 'check.md').write_text(text, encoding='utf-8')
    print(*rows[-3:], sep='\n')


if __name__ == '__main__':
    main()
