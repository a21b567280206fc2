# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Write the XML documents of this folder.

    python msg_samples/make_xml.py [FOLDER]

The trials of named_actions.xml and the result in dlo.xml come from the session object1; the
goal chains of the other documents are simulated with the parameters TRUTH.  Coordinates are
rounded to 0.1 mm.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import sys
from typing import Sequence

import numpy as np

from dlo_calibration import calibrate
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.options import FileOptions, Options
from dlo_calibration.files.request import GoalRequest, Request, TrialRequest, write_request
from dlo_calibration.files.result import write_result
from dlo_calibration.files.session import read_session, session_trials
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.named_actions import (
    Drag,
    GraspAndPlace,
    LiftAndHold,
    NamedAction,
    PushDown,
    Release,
    TwoHands,
)

HERE = Path(__file__).resolve().parent
TRUTH = {'flexibility': 76.4615, 'elasticity': 50.0, 'friction': 70.0, 'self_collision': 25.0}  # 0..100
FIT = {'mass': 0.03, 'evaluations': 150, 'seed': 1}  # options of all documents; mass in kg


def rounded(points: np.ndarray) -> Chain:
    """Return a chain without annotations, rounded to 0.1 mm."""
    return Chain(np.round(points, 4))


def named_actions(initials: Sequence[Chain]) -> list[NamedAction]:
    """Return named actions for what the hands did in the four trials of object1."""
    return [GraspAndPlace(point=0, direction=(0, 1, 0), distance=0.09, height=0.05, speed=0.095),
            Drag(fraction=0.25, direction=(0, -1, 0), distance=0.08, speed=0.0533),
            LiftAndHold(fraction=0.5, height=0.1),
            TwoHands(points=(0, -1), motion='together', distance=0.078, moving='second', speed=0.052)]


def measured() -> Request:
    """Return the trials of object1 with named actions."""
    trials, _ = session_trials(read_session(HERE / 'object1'), Options())
    initials = [rounded(trial.initial.points) for trial in trials]
    return Request(tuple(
        TrialRequest(action.name, initial, (action,), tuple(
            GoalRequest(rounded(goal.chain.points), goal.time) for goal in trial.goals))
        for trial, initial, action in zip(trials, initials, named_actions(initials), strict=True)),
        FileOptions(FIT), 'object1')


def simulated(draft: TrialRequest) -> TrialRequest:
    """Return a trial with simulated goal chains; each is simulated with the chains before it."""
    options = Options.of({**FIT, 'engine': 'bullet'})
    simulator = make_simulator(options)
    for k in range(len(draft.goals)):
        physical = options.space.physical(TRUTH, draft.initial.length)
        chains = simulator.simulate(draft.trial(), physical).chains
        goals = list(draft.goals)
        goals[k] = replace(goals[k], chain=rounded(chains[k]))
        draft = replace(draft, goals=tuple(goals))
    simulator.close()
    return draft


def straight(count: int, turn: float = 0.0) -> Chain:
    """Return a DLO of 0.6 m that lies on the table."""
    along = np.linspace(0, 0.6, count)
    return rounded(np.column_stack([along * np.cos(turn), along * np.sin(turn), 0 * along + 0.004]))


def push_and_release() -> Request:
    """Return two trials: a hand holds while another pushes, then both open; two hands move apart."""
    initial = straight(13)
    held = TrialRequest(
        'push down, then release', initial,
        (LiftAndHold(fraction=0.5, height=0.12, hand='right_hand'),
         PushDown(fraction=0.25, distance=0.02, speed=0.05, start=4.0),
         Release(hands=('right_hand', 'left_hand'), start=7.0)),
        tuple(GoalRequest(initial, time) for time in (3.0, 6.0, 9.0)))
    initial = straight(13, 0.5)
    apart = TrialRequest(
        'apart in the air', initial,
        (TwoHands(fractions=(0.0, 0.75), motion='together', distance=0.2, height=0.2),
         TwoHands(fractions=(0.0, 0.75), motion='apart', distance=0.15, start=5.0)),
        (GoalRequest(initial, 4.0), GoalRequest(initial, 8.0)))
    options = FileOptions({**FIT, 'calibrate': ['flexibility', 'friction']})
    return Request((simulated(held), simulated(apart)), options, 'a simulated cable')


def hand_paths() -> Request:
    """Return a trial with an explicit hand path: a clamp turns, and goal chains come while it moves."""
    initial = straight(13)
    half = np.sqrt(0.5)
    clamp = Hand('gripper', (0, 1), np.array([0.0, 1.0, 2.0]),
                 np.array([[0, 0, 0.004], [0, 0, 0.15], [0.1, 0.1, 0.15]]),
                 np.array([[0, 0, 0, 1], [0, 0, 0, 1], [0, 0, half, half]]))
    times = (0.5, 1.0, 1.5, 2.0)
    goals = [GoalRequest(initial, time, stable=False) for time in times]
    return Request((simulated(TrialRequest(
        'clamp', initial, (Action((clamp,)),),
        (*goals, GoalRequest(initial, 4.0, held_by=('gripper',))))),), FileOptions(FIT))


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the documents."""
    given = sys.argv[1:] if arguments is None else arguments
    folder = Path(given[0]) if given else HERE / 'xml'
    folder.mkdir(exist_ok=True)
    write_request(folder / 'named_actions.xml', measured())
    write_request(folder / 'push_and_release.xml', push_and_release())
    write_request(folder / 'hand_paths.xml', hand_paths())
    trials, _ = session_trials(read_session(HERE / 'object1'), Options())
    rounded_trials = [replace(trial, initial=rounded(trial.initial.points)) for trial in trials]
    options = Options.of({**FIT, 'workers': 2})
    result = calibrate(rounded_trials, options,
                       make_simulator=make_simulator)
    write_result(folder / 'dlo.xml', result, options.flat())
    return 0


if __name__ == '__main__':
    sys.exit(main())
