# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Put mistakes into sessions of known DLOs, calibrate, and tabulate what the user is told.

    python benchmark/mistakes.py [--seeds 5] [--workers 2]

Each DLO of the samples is observed in two ways. A stream is 30 chains a second of four actions, without
annotated grips. Photographs are chains at rest of four actions, from the folder reference of DLO_DATA, with
annotated grips. A finer simulation with the true properties makes the stream, and what replaces a photograph.
The table is printed, and written to benchmark/results/mistakes.md.

    python benchmark/mistakes.py --sessions DIR

writes the stream of the first DLO instead, with each mistake and none, as sessions for `dlo-calibration fit`.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
import multiprocessing
from pathlib import Path
import re
import sys
from typing import Callable, Iterator, Sequence

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from discretisation import DATA, exact_trials  # noqa: E402
from reality import KNOWN_DLOS, KnownDlo  # noqa: E402

from dlo_calibration import Action, Chain, Goal, Hand, InputError, Options, Trial  # noqa: E402
from dlo_calibration.calibration.calibrate import calibrate  # noqa: E402
from dlo_calibration.files.record import encode  # noqa: E402
from dlo_calibration.files.recording import SessionWriter  # noqa: E402
from dlo_calibration.messages.codec import (  # noqa: E402
    ActionMessage,
    bag_types,
    built,
    ChainMessage,
    GOAL,
    INITIAL,
    INPUT_TYPES,
    Message,
    NANOSECONDS,
)
from dlo_calibration.messages.collector import TrialCollector  # noqa: E402
from dlo_calibration.messages.encoder import trial_messages  # noqa: E402
from dlo_calibration.model.parameters import BY_NAME  # noqa: E402
from dlo_calibration.simulation.compiled import CompiledSimulator  # noqa: E402

NODES, SEEN = 81, 4  # of the simulated DLO; the tracker sees every fourth one
RATE = 30.0  # chains per second of the stream
NOISE = 0.7e-3  # m, standard deviation of a coordinate of the stream; photographs: 1 mm
SWING = 2.5  # s after an action, in which the DLO comes to rest
FITTED = ('place_end', 'drag_quarter', 'hold_middle', 'two_hands')
ACTIONS = (  # place of the grip along the DLO, 0..1; way of the hand [m]: up, then aside, then down
    (0.0, (0.10, 0.20)), (0.5, (0.15, -0.18)), (1.0, (-0.25, 0.12)), (0.25, (0.05, 0.22)))
TRUTH = ('flexibility', 'elasticity', 'friction', 'self_collision')
MOVED = {'damping': 50.0}  # true values of what a stream shows besides, on the 0..100 scale

#: mistake -> three sizes
SIZES = {
    'late': (0.04, 0.08, 0.16),  # s by which the stamps of the tracker are late
    'shifted': (0.007, 0.012, 0.018),  # m by which hands are off in a level direction
    'missed': (0, 1, 3),  # trial in which the hand closes on nothing
    'slipped': (0.25, 0.5, 0.75),  # share of the way after which the hand loses the DLO in a trial
    'reversed': ('goals', 'initial', 'trial'),  # which chains of a trial run from the other end
    'table': (0.01, 0.02, 0.04),  # m by which the height of the table is wrong
    'noise': (0.004, 0.007, 0.012),  # m, standard deviation of a coordinate
}
#: mistake -> what names it in the sentences for the user
NAMES = {
    'late': r'stamps seem .*(late|early)', 'shifted': r'off in [xyz]',
    'missed': r'missed|did not move', 'slipped': r'slipped|let go', 'reversed': r'other end',
    'table': r'table_height', 'noise': r'noise of'}
#: What counts as moved.
COUNTED = """\
A parameter that is called identifiable counts as moved if its interval does not hold the truth, or if its
value is off by more than a tenth; and if the same session without the mistake, with the same noise, does not
show that: what noise alone does is no mistake's doing. Where an interval is wider than a tenth and holds the
truth, the user is told so; the second line counts the other runs."""

PAIRS = (('late', 'shifted'), ('late', 'missed'), ('shifted', 'slipped'), ('missed', 'noise'),
         ('late', 'table'), ('reversed', 'missed'))


@dataclass(frozen=True)
class Case:
    """A session with mistakes: its DLO, whether it is a stream, (mistake, size) pairs, and a seed."""

    dlo: KnownDlo
    stream: bool
    mistakes: tuple[tuple[str, object], ...]
    seed: int

    def size(self, mistake: str):
        """Return the size of a mistake; None if it was not made."""
        return dict(self.mistakes).get(mistake)


@dataclass(frozen=True)
class Outcome:
    """What a calibration of a case told its user."""

    case: Case
    usable: bool
    words: tuple[str, ...]  # first line and warnings
    values: dict[str, tuple[float, float, float, float, str]]  # truth, value, lower, upper, verdict
    error: float  # m

    @property
    def named(self) -> set[str]:
        """The mistakes that the words name."""
        return {name for name, pattern in NAMES.items() if re.search(pattern, ' '.join(self.words))}

    def moved(self, right: Outcome | None = None) -> list[str]:
        """
        Return which parameters called identifiable have left their intervals, or are off by a tenth.

        :param right: the same session without the mistakes: what noise alone does there is not counted.
        """
        return [name for name, estimate in self.values.items() if estimate[-1] == 'identifiable' and (
            not self.holds(name) and not (right is not None and right._is_wrong_interval(name))
            or self._is_off(name, estimate[0]) and not (
                right is not None and name in right.values and right.values[name][-1] == 'identifiable'
                and not self._is_off(name, right.values[name][1])))]

    def holds(self, name: str) -> bool:
        """Whether the interval of a parameter holds the truth."""
        truth, _, lower, upper, _ = self.values[name]
        return lower <= truth <= upper

    def _is_wrong_interval(self, name: str) -> bool:
        return name in self.values and self.values[name][-1] == 'identifiable' and not self.holds(name)

    def _is_off(self, name: str, other: float) -> bool:
        """Whether the physical value differs from another one, on the 0..100 scale, by more than a tenth."""
        physical = BY_NAME[name].physical
        return abs(physical(self.values[name][1]) / physical(other) - 1) > 0.1

    @property
    def inside(self) -> list[bool]:
        """Whether each interval of a parameter called identifiable holds the truth."""
        return [self.holds(name) for name, estimate in self.values.items() if estimate[-1] == 'identifiable']


@cache
def _simulator() -> CompiledSimulator:
    return CompiledSimulator(nodes=(NODES + 1) // 2).refined()


def _hand_path(points: np.ndarray, place: float, aside: tuple[float, float]) -> Hand:
    grip, (x, y) = round(place * (len(points) - 1)), aside
    times = np.array([0.0, 0.5, 1.7, 2.2])
    way = points[grip] + np.array([(0, 0, 0), (0, 0, 0.06), (x, y, 0.06), (x, y, 0.0)])
    return Hand('hand', (grip,), times, way)


def _cut(hand: Hand, share: float) -> Hand:
    """Return the path of a hand up to a share of its time."""
    end = hand.start + share * (hand.end - hand.start)
    times = np.append(hand.times[hand.times < end], end)
    return replace(hand, times=times, positions=hand.positions_at(times),
                   orientations=np.tile([0.0, 0, 0, 1], (len(times), 1)))


@cache
def _takes(dlo: KnownDlo, missed: int | None, slipped: float | None, which: int):
    """Return what happens in each action: start (n, 3), path of the hand, instants, chains (t, n, 3)."""
    along = np.linspace(-0.5, 0.5, NODES)
    scale = dlo.length / Chain(np.stack([along, 0.06 * np.sin(5 * along), 0 * along], axis=1)).length
    points = scale * np.stack([along, 0.06 * np.sin(5 * along), 0 * along], axis=1) + (0, 0, dlo.radius)
    start, takes, done, begin = Chain(points), [], [], 0.0
    for k, (place, aside) in enumerate(ACTIONS):
        hand = _hand_path(points, place, aside)
        instants = np.arange(1, round((hand.end + SWING) * RATE)) / RATE
        real = _cut(hand, slipped) if slipped is not None and k == which else hand
        if k != missed:
            done.append(replace(real, name=f'hand {k}', times=begin + real.times))
        if done:  # from the beginning, as the DLO is stretched where friction holds it
            goals = tuple(Goal(start, begin + float(t), stable=False,
                               held_by=(f'hand {k}',) if t < real.end else ()) for t in instants)
            trial = Trial('take', start, tuple(Action((hand,)) for hand in done), goals)
            chains = np.asarray(_simulator().simulate(trial, dlo.physical).chains)
        else:
            chains = np.repeat(points[None], len(instants), axis=0)
        takes.append((points, hand, instants, chains))
        points, begin = chains[-1], begin + float(instants[-1])
    return takes


def stream(case: Case) -> list[Message]:
    """Return the messages of a tracker and of a robot."""
    generator = np.random.default_rng([case.seed, KNOWN_DLOS.index(case.dlo)])
    which = int(generator.integers(len(ACTIONS)))
    angle = generator.uniform(-np.pi, np.pi)
    late, shift = case.size('late') or 0.0, case.size('shifted') or 0.0
    sigma = case.size('noise') or NOISE
    ends = case.size('reversed')
    away = shift * np.array([np.cos(angle), np.sin(angle), 0.0])
    messages: list[Message] = []

    def chain(kind: str, time: float, points: np.ndarray, turned: bool) -> ChainMessage:
        seen = points[::SEEN] + generator.normal(0, sigma, points[::SEEN].shape)
        return ChainMessage(kind, round((time + late) * NANOSECONDS), 'world',
                            Chain(seen[::-1] if turned else seen))

    zero = 1_700_000_000.0
    for k, (points, hand, instants, chains) in enumerate(
            _takes(case.dlo, case.size('missed'), case.size('slipped'), which)):
        mine = ends is not None and k == which
        messages.append(chain(INITIAL, zero - 0.5, points, mine and ends != 'goals'))
        messages.append(ActionMessage(round(zero * NANOSECONDS), 'world', ('hand',), hand.times,
                                      hand.positions[:, None] + away, hand.orientations[:, None]))
        messages += [chain(GOAL, zero + t, seen, mine and ends != 'initial')
                     for t, seen in zip(instants, chains, strict=True)]
        zero += instants[-1] + 5.0
    return sorted(messages, key=lambda message: message.key)


def photographs(case: Case) -> list[Message]:
    """Return the messages of annotated photographs."""
    generator = np.random.default_rng([case.seed, KNOWN_DLOS.index(case.dlo), 1])
    sigma, ends = case.size('noise') or 1e-3, case.size('reversed')
    which = int(generator.integers(len(FITTED)))
    _, exact = exact_trials(case.dlo.name)
    trials = []
    for k, trial in enumerate([next(t for t in exact if t.name == name) for name in FITTED]):
        goals = trial.goals
        if k == case.size('missed'):
            goals = tuple(replace(goal, chain=trial.initial, held_by=()) for goal in goals)
        elif case.size('slipped') is not None and k == which:
            hands = tuple(_cut(hand, case.size('slipped')) for hand in trial.hands)
            real = replace(trial, actions=(Action(hands),), goals=tuple(
                replace(goal, held_by=()) for goal in goals))
            chains = _simulator().simulate(real, case.dlo.physical).chains
            goals = tuple(replace(goal, chain=Chain(points), held_by=())
                          for goal, points in zip(real.goals, chains, strict=True))

        def seen(exactly: Chain, turned: bool) -> Chain:
            points = exactly.points + generator.normal(0, sigma, exactly.points.shape)
            return Chain(points[::-1] if turned else points)

        trials.append(replace(
            trial, name=f'trial {k + 1}', initial=seen(trial.initial, False),
            goals=tuple(replace(goal, chain=seen(goal.chain, False)) for goal in goals)))
    messages = trial_messages(trials, 'world')
    if ends is not None:
        number = -1
        for k, message in enumerate(messages):
            number += message.kind == INITIAL
            if number == which and (message.kind == INITIAL and ends != 'goals'
                                    or message.kind == GOAL and ends != 'initial'):
                other = message.chain
                messages[k] = replace(message, chain=replace(
                    other, points=other.points[::-1],
                    hands=None if other.hands is None else other.hands[::-1]))
    return messages


def run(case: Case) -> Outcome:
    """Calibrate the session of a case; return what the user is told."""
    options = Options(mass=case.dlo.mass, engine='compiled', workers=1)
    if case.size('table'):
        sign = 1 if case.seed % 2 else -1
        options = replace(options, table_height=sign * case.size('table'))
    collector = TrialCollector(options)
    words: list[str] = []
    for message in stream(case) if case.stream else photographs(case):
        try:
            collector.add(message)
        except InputError as error:
            words.append(str(error))
    words += collector.take_warnings()
    words += map(str, collector.take_refusals())
    try:
        result = calibrate(collector.trials, options)
    except InputError as error:
        return Outcome(case, False, (*words, str(error)), {}, np.nan)
    truth = {**case.dlo.values, **MOVED}
    values = {name: (truth[name], own.value, own.lower, own.upper, own.verdict)
              for name, own in result.parameters.items() if name in truth}
    return Outcome(case, not result.unusable, (result.unusable, *result.warnings, *words), values,
                   result.errors.mean)


def cases(seeds: int, only: Sequence[str] = ()) -> Iterator[Case]:
    """Yield every case."""
    for dlo in KNOWN_DLOS:
        for is_stream in (True, False):
            if not is_stream and not DATA.is_dir():
                continue
            names = [name for name in SIZES if is_stream or name not in ('late', 'shifted')]
            chosen = [((name, size),) for name in names for size in SIZES[name]
                      if is_stream or size != 'trial']  # a photographed trial from the other end is right
            chosen += [tuple((name, SIZES[name][1]) for name in pair) for pair in PAIRS
                       if set(pair) <= set(names)]
            for seed in range(seeds):
                for mistakes in chosen:
                    if not only or {name for name, _ in mistakes} <= set(only):
                        yield Case(dlo, is_stream, mistakes, seed)
            if not only or 'none' in only:
                for seed in range(3 * seeds):
                    yield Case(dlo, is_stream, (), seed)


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the table of the outcomes."""
    groups, right = defaultdict(list), without_mistake(outcomes)
    for outcome in outcomes:
        names = ' and '.join(name for name, _ in outcome.case.mistakes) or 'none'
        groups[names, 'stream' if outcome.case.stream else 'photographs'].append(outcome)
    rows = ['| mistake | observed | runs | usable | named rightly | something else named '
            '| usable without a word, but moved | intervals of usable runs that hold the truth |',
            '|' + '---|' * 8]
    for (names, observed), group in groups.items():
        made = set(names.split(' and ')) - {'none'}
        usable = [o for o in group if o.usable]
        held = [inside for o in usable for inside in o.inside]
        rows.append(
            f'| {names} | {observed} | {len(group)} | {len(usable)} '
            f'| {sum(made <= o.named for o in group) if made else "-"} '
            f'| {sum(bool(o.named - made) for o in group)} '
            f'| {sum(bool(o.moved(right(o))) and not o.named & made for o in usable)} '
            f'| {sum(held)} of {len(held)} |')
    return '\n'.join(rows)


def without_mistake(outcomes: Sequence[Outcome]) -> Callable[[Outcome], Outcome | None]:
    """Return what finds the outcome of the same session without its mistakes; None for one without any."""
    right = {(o.case.dlo.name, o.case.stream, o.case.seed): o for o in outcomes if not o.case.mistakes}
    return lambda o: right.get((o.case.dlo.name, o.case.stream, o.case.seed)) if o.case.mistakes else None


def summary(outcomes: Sequence[Outcome]) -> str:
    """Return the figures that count, and the runs that no word was said about."""
    before = without_mistake(outcomes)
    wrong = [o for o in outcomes if o.case.mistakes]
    right = [o for o in outcomes if not o.case.mistakes]
    silent = [o for o in wrong if o.usable and o.moved(before(o)) and not o.named]
    outside = [o for o in silent if not all(o.holds(name) for name in o.moved(before(o)))]
    by_noise = [o for o in right if o.usable and o.moved()]
    single = [o for o in wrong if len(o.case.mistakes) == 1]
    named = [o for o in single if {name for name, _ in o.case.mistakes} <= o.named]
    warned = [o for o in right if o.named or not o.usable]
    held = [inside for o in outcomes if o.usable for inside in o.inside]
    share = [f'| {words} | {part} of {count} | {100 * part / max(count, 1):.1f} % |'
             for words, part, count in (
        ('runs with a mistake, usable without a word, but a parameter moved', len(silent), len(wrong)),
        ('of these, those whose interval does not hold the truth either', len(outside), len(silent)),
        ('the mistake named rightly, of runs with one mistake', len(named), len(single)),
        ('runs without a mistake that are warned of', len(warned), len(right)),
        ('runs without a mistake, usable, but noise moved a parameter as much', len(by_noise), len(right)),
        ('90 % intervals of identifiable parameters in usable runs that hold the truth', sum(held),
         len(held)))]
    told = [f'- {o.case.dlo.name}, {"stream" if o.case.stream else "photographs"}, '
            f'{" and ".join(f"{name} {size}" for name, size in o.case.mistakes)}, seed {o.case.seed}: '
            + '; '.join(f'{name} {value:.1f} [{lower:.1f}, {upper:.1f}], truth {truth:.1f}' for name in
                        o.moved(before(o)) for truth, value, lower, upper, _ in [o.values[name]])
            for o in silent]
    return '\n'.join(['| figure | runs | share |', '|---|---|---|', *share,
                      *['', 'Moved without a word, on the scale from 0 to 100:', '', *told] * bool(told)])


def write_sessions(folder: Path) -> None:
    """Write a session of the stream of the first DLO for each mistake and size, and one without a mistake."""
    types, dlo = bag_types(), KNOWN_DLOS[0]
    sizes = [(name, size) for name in SIZES if name != 'table' for size in SIZES[name]]  # that is an option
    for mistakes in ((), *((mistake,) for mistake in sizes)):
        path = folder / ('_'.join(map(str, mistakes[0])) if mistakes else 'none')
        with SessionWriter(path, {'mass': dlo.mass}) as writer:
            for message in stream(Case(dlo, True, mistakes, 0)):
                kind = INPUT_TYPES[message.kind]
                octets = encode(built(types, message), kind)
                writer.write(f'/calibrator/{message.kind}', kind, octets, message.stamp)
            print(writer.path)


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--seeds', type=int, default=5)
    parser.add_argument('--workers', type=int, default=2)
    parser.add_argument('--only', nargs='*', default=[], help='mistakes; none: without any')
    parser.add_argument('--list', action='store_true', help='print each run')
    parser.add_argument('--sessions', metavar='DIR', type=Path, help='write sessions there, and end')
    options = parser.parse_args()
    if options.sessions is not None:
        write_sessions(options.sessions)
        return
    with ProcessPoolExecutor(options.workers, multiprocessing.get_context('spawn')) as executor:
        outcomes = []
        for outcome in executor.map(run, cases(options.seeds, options.only), chunksize=4):
            outcomes.append(outcome)
            if options.list:
                case = outcome.case
                print(case.dlo.name, 'stream' if case.stream else 'photos', case.mistakes, case.seed,
                      'usable' if outcome.usable else 'UNUSABLE', f'{1e3 * outcome.error:.1f} mm',
                      sorted(outcome.named), 'MOVED' if outcome.moved() else '',
                      {name: f'{t:.1f}: {v:.1f} [{lo:.1f}, {up:.1f}] {verdict[:6]}'
                       for name, (t, v, lo, up, verdict) in outcome.values.items()},
                      [word[:150] for word in outcome.words if word], flush=True)
    text = (f'# mistakes\n\n`python benchmark/mistakes.py --seeds {options.seeds}`: {len(outcomes)} runs.\n\n'
            f'{summary(outcomes)}\n\n{COUNTED}\n\n{table(outcomes)}\n')
    if not options.only:
        (HERE / 'results' / 'mistakes.md').write_text(text, encoding='utf-8')
    print(text)


if __name__ == '__main__':
    main()
