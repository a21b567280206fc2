# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Check new sessions of the reference objects: unchanged, and with EI or friction 20 % off.

    python benchmark/check.py [--draws 20] [--noise 0.0003] [--objects 1 2 5] [--workers 2] [--other]

Each draw calibrates on four actions with new noise, and checks the result on the same four actions with other
noise: as they are, with EI 20 % larger or smaller, and with friction 20 % larger or smaller.  Unchanged
chains are the exact ones; before and after a change, they are those of a finer simulation.  Checks in which
both sessions together do not determine the changed parameter to 5 % are not counted.  The table is printed,
and written to benchmark/results/check.md; with `--other`, one of checks of the unchanged objects on the five
other actions, to check_other.md.  Reads the folder reference of DLO_DATA.
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
from typing import Mapping, Sequence

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from discretisation import exact_trials  # noqa: E402
from intervals import FITTED, TRUTH  # noqa: E402

from dlo_calibration import Chain, Options, Trial  # noqa: E402
from dlo_calibration.calibration.calibrate import fitted  # noqa: E402
from dlo_calibration.calibration.setting import Setting  # noqa: E402
from dlo_calibration.files.result import Description  # noqa: E402
from dlo_calibration.model.parameters import BY_NAME, ParameterSpace  # noqa: E402
from dlo_calibration.simulation.compiled import CompiledSimulator  # noqa: E402
from dlo_calibration.workspace.check import AGREES, Check, checked, HAS_CHANGED  # noqa: E402

OFF = 0.2  # share of a change
SHARP = 0.05 * 2**0.5  # of the change: half its 90 % interval, where both sessions determine it to 5 %
CASES = ('unchanged', 'flexibility', 'friction')
OTHER = 'other actions'


@dataclass(frozen=True)
class Outcome:
    """
    One check.

    :param sharp: whether both sessions determine the changed parameter; EI and friction if nothing changed.
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


def simulated(trials: list[Trial], physical: Mapping[str, float]) -> list[Trial]:
    """Return the trials as a finer simulation shows them."""
    simulator = CompiledSimulator(nodes=61, time_step=0.002)
    return [replace(trial, goals=tuple(replace(goal, chain=Chain(points)) for goal, points in zip(
        trial.goals, simulator.simulate(trial, physical).chains, strict=True))) for trial in trials]


def draw(name: str, noise: float, cases: Sequence[str], seed: int) -> dict[str, Outcome]:
    """Calibrate on one draw of the noise, and check the result in all cases."""
    properties, everything = exact_trials(name)
    exact = [trial for trial in everything if trial.name in FITTED]
    other = [trial for trial in everything if trial.name not in FITTED]
    length = float(np.mean([trial.initial.length for trial in exact]))
    physical = {**ParameterSpace(mass=properties['mass']).physical({}, length),
                **{name: properties[key] for name, key in TRUTH.items()}}
    generator = np.random.default_rng(seed)
    options = Options(mass=properties['mass'], seed=seed, workers=1)
    factor = 1 + OFF if seed % 2 else 1 - OFF
    outcomes = {}
    for case in cases:
        before, after = exact, other if case == OTHER else exact
        if case in CASES[1:]:
            before = simulated(exact, physical)
            after = simulated(exact, {**physical, case: factor * physical[case]})
        setting = Setting(tuple(noisy(before, noise, generator)), options, CompiledSimulator())
        file = Description.of(fitted(setting))
        begun = time.perf_counter()
        check = checked(file, noisy(after, noise, generator), options)
        named = () if check.comparison is None else tuple(
            name for name, there in zip(check.validation.space.free, check.comparison.changed, strict=True)
            if there)
        asked = (case,) if case in CASES[1:] else CASES[1:]
        outcomes[case] = Outcome(check.comparison is not None and all(
            width(check, name) <= SHARP for name in asked), check.verdict, named, time.perf_counter() - begun)
    return outcomes


def width(check: Check, name: str) -> float:
    """Return half the 90 % interval of the change of a parameter, as a share of its physical value."""
    assert check.comparison is not None
    k, parameter = check.validation.space.free.index(name), BY_NAME[name]
    half = float(check.comparison.upper[k] - check.comparison.lower[k]) / 2
    ends = sorted((parameter.at_zero, parameter.at_hundred))
    return (ends[1] / ends[0])**(half / parameter.extent) - 1


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--draws', type=int, default=20, help='for each object')
    parser.add_argument('--noise', type=float, default=3e-4, help='standard deviation of a coordinate [m]')
    parser.add_argument('--objects', type=int, nargs='+', default=[1, 2, 3, 4, 5])
    parser.add_argument('--workers', type=int, default=2)
    parser.add_argument('--other', action='store_true')
    options = parser.parse_args()
    cases, title = ((OTHER,), 'check_other') if options.other else (CASES, 'check')
    rows = ['| object | case | checks | of these determined to 5 % | agrees | changed | cannot tell '
            '| changed, and the right one named | and no other | seconds, median |', '|' + '---|' * 10]
    total: dict[str, list[Outcome]] = {case: [] for case in cases}

    def row(name: str, case: str, outcomes: list[Outcome]) -> str:
        counted = [each for each in outcomes if each.sharp or case not in CASES[1:]]
        right = sum(case in each.named for each in counted)
        only = sum(each.named == (case,) for each in counted)
        agree = sum(each.verdict == AGREES for each in counted)
        change = sum(each.verdict == HAS_CHANGED for each in counted)
        return (f'| {name} | {case} | {len(outcomes)} | {sum(each.sharp for each in outcomes)} | {agree} '
                f'| {change} | {len(counted) - agree - change} | {right} | {only} '
                f'| {np.median([each.seconds for each in outcomes]):.1f} |')

    with ProcessPoolExecutor(options.workers, multiprocessing.get_context('spawn')) as executor:
        for k in options.objects:
            draws = list(executor.map(partial(
                draw, f'object{k}', options.noise, cases), range(options.draws)))
            for case in cases:
                outcomes = [each[case] for each in draws]
                total[case] += outcomes
                rows.append(row(str(k), case, outcomes))
            print(*rows[-len(cases):], sep='\n', flush=True)
    rows += [row('all', case, total[case]) for case in cases]
    text = (f'# {title}\n\n`python benchmark/check.py --draws {options.draws} --noise {options.noise} '
            f'--objects {" ".join(map(str, options.objects))}{" --other" * options.other}`: four actions of '
            'each object'
            f'{", checked on the five others" * options.other}, with '
            f'new noise of {1e3 * options.noise:g} mm per coordinate in each session. In the rows of a '
            'change, only checks whose sessions determine the changed parameter to 5 % each are counted as '
            'agrees, changed or cannot tell.\n\n' + '\n'.join(rows) + '\n')
    (HERE / 'results' / f'{title}.md').write_text(text, encoding='utf-8')
    print(*rows[-len(cases):], sep='\n')


if __name__ == '__main__':
    main()
