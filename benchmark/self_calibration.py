# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
How many trials a robot needs that asks its own questions, compared with two that do not.

    python benchmark/self_calibration.py [--objects N] [--seeds N] [--all-wanted] [--sessions FILE]
    python benchmark/self_calibration.py --first 17 --picture doc/self_calibration.png

Each object is a rope with random properties from the middle of the scale, played with physics of its own
(examples/played_rope.py: twice the nodes, half the time step, noise of 1.5 mm, grips off by up to 5 mm, 5 %
of the points hidden).  The robot has one hand that lifts 10 cm, and ends when its own intervals are as narrow
as wanted.  It does what `advise` says, or random permitted actions, or those of the guide in turn.  The full
calibration at that moment tells whether its intervals hold the truth.  The tables are printed, and written to
benchmark/results/self_calibration.md.  With --sessions, each session goes to a file, one JSON object a line,
and those that are there already are not conducted again.  With --picture, one session is drawn instead: what
the robot did, and how the intervals shrank.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass, field
import json
from pathlib import Path
import sys
import time
from typing import Sequence

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent / 'examples')]

from figures import machine, table  # noqa: E402
from played_rope import observed_trial, PlayedRope  # noqa: E402

from dlo_calibration import calibrate, Chain, Options, Trial  # noqa: E402
from dlo_calibration.calibration.choice import choose  # noqa: E402
from dlo_calibration.calibration.engines import make_simulator  # noqa: E402
from dlo_calibration.inference.target import read_targets, wanted_deviations  # noqa: E402
from dlo_calibration.model.action import Action  # noqa: E402
from dlo_calibration.model.parameters import BY_NAME, SCALE  # noqa: E402
from dlo_calibration.observation.table import lowest_level  # noqa: E402
from dlo_calibration.planning.inquiry import Inquiries, Inquiry  # noqa: E402
from dlo_calibration.planning.options import AdviceOptions  # noqa: E402
from dlo_calibration.planning.surroundings import Surroundings  # noqa: E402
from dlo_calibration.report.drawing import hand_colours, View  # noqa: E402
from dlo_calibration.report.figure import (  # noqa: E402
    add_legend,
    BAND,
    blank_figure,
    OBSERVED,
    settings,
    SIMULATED,
    write_figure,
)
from dlo_calibration.workspace.live_information import appraise, Appraised  # noqa: E402
from dlo_calibration.workspace.next_action import LEAST_TRIALS, next_action, NextAction  # noqa: E402

MIDDLE = (25.0, 75.0)  # of the scale
ROPES = (48.1, 82.7)  # of that of flexibility: what is stiffer is no rope, and hardly bends on a table
WANTED = 'flexibility 1.4, friction 3'
ALL_WANTED = 'flexibility 1.4, friction 3, elasticity 5, self_collision 5'
MOST = 12  # trials
ASKS, RANDOM, GUIDE = 'advise', 'random', 'guide'


@dataclass
class Session:
    """What one robot did with one object."""

    robot: str
    seed: int
    draw: int
    truth: dict[str, float]
    trials: int = 0
    reached: bool = False
    seconds: list[float] = field(default_factory=list)  # until the next advice
    ratios: list[float] = field(default_factory=list)  # expected / found standard deviations
    live: list[bool] = field(default_factory=list)  # whether the live intervals hold the truth at the end
    held: list[bool] = field(default_factory=list)  # whether those of the full calibration do
    course: list[list[tuple[float, float]]] = field(default_factory=list)  # intervals after each trial
    told: int | None = None  # trials after which it said that it cannot show all that is wanted
    said: str = ''


def rope_of(seed: int, draw: int) -> PlayedRope:
    """Return an object with random properties; `draw` changes what the camera sees."""
    generator = np.random.default_rng(seed)
    values = {name: float(generator.uniform(*(ROPES if name == 'flexibility' else MIDDLE)))
              for name in Options().space.free}
    return PlayedRope(values, np.random.default_rng([seed, draw]), length=float(generator.uniform(0.5, 0.9)),
                      turn=float(generator.uniform(-1.5, 1.5)))


def guided(inquiries: Sequence[Inquiry], count: int, points: int) -> Inquiry:
    """Return the next action of the guide: lift the middle, drag a quarter, place an end, in turn."""
    middle, quarter = points // 2, points // 4
    grip, kind, lifted = ((middle, 'grasp_and_place', True), (quarter, 'drag', False),
                          (0, 'grasp_and_place', False))[count % 3]
    fitting = [inquiry for inquiry in inquiries if abs(inquiry.move.grips[0] - grip) <= 1
               and inquiry.move.name == kind and (np.abs(inquiry.move.shifts).max() == 0) == lifted]
    return (fitting or inquiries)[-1]


def chosen(robot: str, appraised: Appraised, options: Options, limits: AdviceOptions, start: Chain,
           generator: np.random.Generator) -> tuple[Action, tuple[float, float] | None]:
    """Return the action of a robot that does not ask."""
    inquiries = Inquiries(start, lowest_level(start), limits, Surroundings())
    coarse = inquiries.coarse()
    inquiry = guided(coarse, len(appraised.trials), len(start)) if robot == GUIDE else \
        coarse[int(generator.integers(len(coarse)))]
    return inquiry.action, inquiry.pause


def conducted(robot: str, seed: int, draw: int, limits: AdviceOptions) -> tuple[Session, list[Trial]]:
    """Let a robot calibrate an object; return also what it observed."""
    rope, generator = rope_of(seed, draw), np.random.default_rng([seed, draw, 7])
    session, trials = Session(robot, seed, draw, rope.values), list[Trial]()
    appraisals: dict = {}  # type: ignore[type-arg]
    names = [name for name in Options().space.free if name in limits.wanted]
    expected = None
    while True:
        begun = time.process_time()
        options = choose(trials, Options(workers=2)).options
        space = options.space
        appraised = appraise(make_simulator, trials, options, None, appraisals)
        std = appraised.appraisal.uncertainty.std
        wanted = wanted_deviations(limits.wanted, space)
        known = appraised.appraisal.uncertainty
        session.course.append([(SCALE * low / end, SCALE * high / end) for low, high, end in zip(
            known.lower.tolist(), known.upper.tolist(), space.upper.tolist(), strict=True)])
        columns = [space.free.index(name) for name in names]
        if expected is not None:
            session.ratios += [float(expected[k] / std[k]) for k in columns]
        session.reached = bool((std <= wanted).all()) and len(trials) >= LEAST_TRIALS
        start = Chain(rope.look())
        start = start.interpolated(start.arc_lengths())
        advice: NextAction | None = None
        if robot == ASKS:
            advice = next_action(appraised, options, limits, start, make_simulator)
            expected = advice.expected
            session.seconds.append(time.process_time() - begun)
            if advice.hopeless and session.told is None:
                session.told = len(trials)
        if session.reached or len(trials) == MOST or advice is not None and advice.action is None:
            break
        if advice is not None and advice.action is not None:
            action, pause = advice.action, advice.pause
        else:
            action, pause = chosen(robot, appraised, options, limits, start, generator)
        trials.append(observed_trial(f'trial {len(trials) + 1}', rope, action, pause))
    session.trials, session.said = len(trials), '' if advice is None else advice.words
    truth = space.point(rope.values)
    appraisal = appraised.appraisal
    session.live = [bool(appraisal.uncertainty.lower[k] <= truth[k] <= appraisal.uncertainty.upper[k])
                    for k in columns]
    result = calibrate(trials, Options(workers=2, engine='compiled'))
    session.held = [result.parameters[name].lower <= rope.values[name] <= result.parameters[name].upper
                    for name in names]
    return session, trials


def read_sessions(path: Path | None) -> dict[tuple[str, int, int], Session]:
    """Return the sessions of a file, by robot, seed and draw."""
    lines = path.read_text(encoding='utf-8').splitlines() if path is not None and path.exists() else []
    sessions = [Session(**json.loads(line)) for line in lines]
    return {(each.robot, each.seed, each.draw): each for each in sessions}


def draw_session(session: Session, trials: Sequence[Trial], names: Sequence[str], path: Path) -> None:
    """Draw what a robot did, a panel a trial, and below how the 90 % intervals shrank."""
    limits, free = read_targets(WANTED), Options().space.free
    colours = hand_colours(trials)
    with settings():
        figure = blank_figure(4.0 * max(2, len(trials)), 7.2)
        above, below = figure.subfigures(2, 1, height_ratios=(1.25, 1))
        figure.suptitle('A robot asks its own questions', fontweight='bold')
        panels = list(np.atleast_1d(above.subplots(1, len(trials))))
        for k, (axes, trial) in enumerate(zip(panels, trials, strict=True)):
            view = View(axes, trial, above=True)
            view.draw_start('before the action')
            view.draw_hands(colours)
            for goal in trial.goals:
                where = view.flat(goal.chain.points)
                axes.plot(*where, '-' if goal.stable else ':', color=SIMULATED, linewidth=2.0,
                          label='at rest' if goal.stable else 'while the hand waits')
            axes.set_title(f'trial {k + 1}', fontsize=11)
        add_legend(above, panels)
        for axes, name in zip(np.atleast_1d(below.subplots(1, len(names))), names, strict=True):
            k = free.index(name)
            low, high = np.array([each[k] for each in session.course]).T
            count = np.arange(len(low))
            axes.fill_between(count, low, high, color=BAND)
            axes.errorbar(count, (low + high) / 2, (high - low) / 2, fmt='none', color=SIMULATED, capsize=4,
                          label='90 % interval')
            axes.axhline(session.truth[name], color=OBSERVED, linestyle='--', linewidth=1, label='truth')
            wanted = SCALE * limits[name] / BY_NAME[name].extent
            axes.annotate(f'± {(high - low)[-1] / 2:.1f}; wanted: ± {wanted:.3g}',
                          (count[-1], high[-1]), (0, 12), textcoords='offset points', ha='right')
            axes.set(xlabel='trials', ylabel=f'{name}, 0 to 100', xticks=count, ylim=(0, 100))
        add_legend(below, below.axes)
        write_figure(figure, path)


def main() -> None:
    """Make the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0].strip())
    parser.add_argument('--objects', type=int, default=20)
    parser.add_argument('--seeds', type=int, default=5)
    parser.add_argument('--first', type=int, default=1, help='seed of the first object')
    parser.add_argument('--all-wanted', action='store_true', help='want elasticity and self_collision, too')
    parser.add_argument('--robots', nargs='+', default=[ASKS, RANDOM, GUIDE])
    parser.add_argument('--sessions', type=Path, help='file of sessions so far, to which others are added')
    parser.add_argument('--picture', type=Path, help='PNG of the first session, instead of a table')
    chosen = parser.parse_args()
    limits = AdviceOptions(wanted=ALL_WANTED if chosen.all_wanted else WANTED, height=0.1)
    if chosen.picture:
        session, trials = conducted(ASKS, chosen.first, 0, limits)
        draw_session(session, trials, [name for name in Options().space.free if name in limits.wanted],
                     chosen.picture)
        return
    before, sessions = read_sessions(chosen.sessions), []
    for draw in range(chosen.seeds):
        for seed in range(chosen.first, chosen.first + chosen.objects):
            for robot in chosen.robots:
                known = before.get((robot, seed, draw))
                session = conducted(robot, seed, draw, limits)[0] if known is None else known
                sessions.append(session)
                line = json.dumps(asdict(session))
                print(line, flush=True)
                if chosen.sessions and known is None:
                    with chosen.sessions.open('a', encoding='utf-8') as file:
                        file.write(f'{line}\n')
    columns = ('robot', 'sessions', 'trials, median', 'trials, mean', 'ended by its intervals',
               'truth in the intervals', 'truth in the live ones', 'told that it cannot, after',
               'expected / found std, median', 'most processor seconds to an advice')
    rows = []
    for robot in chosen.robots:
        own = [session for session in sessions if session.robot == robot]
        ratios = [ratio for session in own for ratio in session.ratios]
        seconds = [each for session in own for each in session.seconds]
        told = [session.told for session in own if session.told is not None]
        rows.append((
            robot, len(own), f'{np.median([session.trials for session in own]):g}',
            f'{np.mean([session.trials for session in own]):.1f}', percent([each.reached for each in own]),
            percent([held for session in own for held in session.held]),
            percent([held for session in own for held in session.live]),
            f'{np.median(told):g} ({len(told)} of {len(own)})' if told else '-',
            f'{np.median(ratios):.2f}' if ratios else '-', f'{max(seconds):.1f}' if seconds else '-'))
    text = table(columns, rows)
    command = (f'python benchmark/self_calibration.py --objects {chosen.objects} --seeds {chosen.seeds}'
               + f' --first {chosen.first}' * (chosen.first > 1) + ' --all-wanted' * chosen.all_wanted
               + f' --robots {" ".join(chosen.robots)}' * (chosen.robots != parser.get_default('robots')))
    how = f'Wanted: {limits.wanted}; at most {MOST} trials. {machine()}'
    (HERE / 'results' / f'self_calibration{"_all" * chosen.all_wanted}.md').write_text(
        f'# self_calibration\n\n`{command}`\n\n{how}\n\n{text}\n', encoding='utf-8')
    print(text)


def percent(told: Sequence[bool]) -> str:
    """Return the share that is True."""
    return f'{100 * np.mean(told):.0f} %'


if __name__ == '__main__':
    main()
