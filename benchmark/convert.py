# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Convert measured data to sessions that `fit` and `validate` read.

    python benchmark/convert.py reference object1 OUTPUT [--actions fitted|other|all|NAME,NAME]
    python benchmark/convert.py mocap     dlo2    OUTPUT [--recordings 0,1,2] [--every 1]
    python benchmark/convert.py hanging   white   OUTPUT [--repeats 0,1,2,3,4]

OUTPUT is the rosbag2 folder (or .mcap file) to make; a name that is taken gets a
number, so nothing is overwritten.  The data is read from the folder that
``--data`` or the environment variable DLO_DATA names, else from ``shared/data``
beside the repository.  Mass and table of the data are recorded as options of the
session.

reference
    One trial per action, with the noisy chains.  Each point that a hand grips is
    annotated in the initial chain, and in the goal chain if the hand still holds it.

mocap
    One trial per recording.  It starts at frame 1, with the velocity between frames
    0 and 2: there are two initial chains, one frame apart.  The second is frame 1,
    and their difference is half of that between frames 0 and 2.  A hand has two
    markers and grips both.  It is where its outer marker is, and turns by the smallest
    rotation from the first direction between its markers to the present one.  Every
    frame from 2 on is a goal that both hands hold, compared at its instant; the last
    goal has the time of the last waypoint.

hanging
    One trial per repeat, without a table.  The wire has 51 measured points in
    the vertical plane y = 0, and one more point beyond each end, inside the
    clamp: each clamp grips two points, which fixes the direction of the wire.
    Both clamps are horizontal.  The wire leaves the first clamp along +x, turns
    down, goes back along -x at the bottom, turns up, and enters the last clamp along
    +x.  At the start it is at rest, straight along +x at the height of the first
    clamp.  No clamp turns, and the first does not move.  The last clamp moves
    straight towards the first, up to the measured distance, while the wire sags.
    Then it moves half around the first, in a horizontal circle, to its measured
    position, so that the legs of the loop pass beside each other.  (A motion in the
    plane would have to turn a clamp by 360 degrees, and a limp wire would fall over it.)
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
import sys
from typing import Any, Iterator, Mapping, Sequence, Union

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import DloCalibrationError, InputError
from dlo_calibration.files.record import encode
from dlo_calibration.files.recording import SessionWriter
from dlo_calibration.messages.codec import (
    ACTION,
    action_trajectory,
    ActionMessage,
    bag_types,
    chain_cloud,
    ChainMessage,
    GOAL,
    INITIAL,
    INPUT_TYPES,
)
from dlo_calibration.model.chain import Chain

Floats = NDArray[np.float64]
Message = Union[ChainMessage, ActionMessage]
Trials = Iterator[Sequence[Message]]

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data'
NAMESPACE = '/calibrator'
FRAME = 'world'
EPOCH = 1_700_000_000 * 10**9  # ns; trial k begins TRIAL_PERIOD * k after it
TRIAL_PERIOD = 60 * 10**9
FITTED = ('place_end', 'drag_quarter', 'hold_middle', 'two_hands')
HANDS = ('left_hand', 'right_hand')
APPROACH_TIME, SWING_TIME, SWING_STEPS = 4.0, 3.0, 36  # s, s; waypoints 5 degrees apart
HANGING_WAIT = 5.0  # s, from the end of the motion to the goal
NO_TURN = (0.0, 0.0, 0.0, 1.0)


def nanoseconds(seconds: float) -> int:
    """Return a time in ns."""
    return round(float(seconds) * 1e9)


def held(count: int, grips: Mapping[int, int]) -> NDArray[np.uint8]:
    """Return the annotation of `count` points; `grips` has the number of the hand for each gripped one."""
    hands = np.zeros(count, np.uint8)
    for point, hand in grips.items():
        hands[point] = hand
    return hands


def reference_trials(trials: Sequence[Mapping[str, Any]]) -> Trials:
    """Yield the messages of the trials of a reference object."""
    for k, trial in enumerate(trials):
        start = EPOCH + k * TRIAL_PERIOD
        initial, goal, hands = np.array(trial['initial']), np.array(trial['goal']), trial['hands']
        times = np.unique([knot['t'] for hand in hands for knot in hand['knots']])
        positions = np.stack([
            np.stack([np.interp(times, [knot['t'] for knot in hand['knots']], axis)
                      for axis in np.array([knot['position'] for knot in hand['knots']]).T], axis=1)
            for hand in hands], axis=1)
        grips = held(len(initial), {hand['grip_index']: number for number, hand in enumerate(hands, start=1)})
        yield (
            ChainMessage(INITIAL, start, FRAME, Chain(initial, grips)),
            ActionMessage(start, FRAME, HANDS[:len(hands)], times, positions,
                          np.broadcast_to(NO_TURN, (len(times), len(hands), 4))),
            ChainMessage(GOAL, start + nanoseconds(trial['goal_time']), FRAME,
                         Chain(goal, grips * 0 if trial['release'] else grips)))


def smallest_turns(directions: Floats) -> Floats:
    """Return the quaternions of the smallest rotations from the first of (k, 3) directions to each."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    quaternions = np.column_stack([np.cross(unit[0], unit), 1 + unit @ unit[0]])
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return quaternions


def mocap_trials(points: Floats, rate: float, every: int) -> Trials:
    """
    Yield the messages of recordings of a cable.

    :param points: (r, f, n, 3) [m] markers of r recordings of f frames.
    :param rate: of the frames [Hz].
    :param every: 1 if every frame is a goal, 2 if every second one is, and so on.
    """
    for k, frames in enumerate(points):
        start = EPOCH + k * TRIAL_PERIOD
        count = frames.shape[1]
        grips = held(count, {0: 1, 1: 1, count - 2: 2, count - 1: 2})
        instants = [start + nanoseconds((frame - 1) / rate) for frame in range(len(frames))]
        before = frames[1] - (frames[2] - frames[0]) / 2
        yield (
            ChainMessage(INITIAL, instants[0], FRAME, Chain(before, grips)),
            ChainMessage(INITIAL, start, FRAME, Chain(frames[1], grips)),
            ActionMessage(start, FRAME, HANDS, np.arange(len(frames) - 1) / rate, frames[1:, [0, -1]],
                          np.stack([smallest_turns(frames[1:, 1] - frames[1:, 0]),
                                    smallest_turns(frames[1:, -2] - frames[1:, -1])], axis=1)),
            *(ChainMessage(GOAL, instants[frame], FRAME, Chain(frames[frame], grips))
              for frame in range(2, len(frames), every)))


def hanging_trials(repeats: Floats, length: float) -> Trials:
    """
    Yield the messages of the repeats of a hanging wire.

    :param repeats: (r, n, 3) [m] measured points, clamp to clamp.
    :param length: of the wire between the clamps [m].
    """
    for k, measured in enumerate(repeats):
        start = EPOCH + k * TRIAL_PERIOD
        spacing = length / (len(measured) - 1)
        inside = np.array([spacing, 0.0, 0.0])
        straight = measured[0] + np.arange(-1, len(measured) + 1)[:, None] * inside
        goal = np.concatenate([[measured[0] - inside], measured, [measured[-1] + inside]])
        grips = held(len(goal), {0: 1, 1: 1, len(goal) - 2: 2, len(goal) - 1: 2})

        around = np.linspace(0, np.pi, SWING_STEPS + 1)[:, None]
        offset = measured[-1] - measured[0]
        swing = abs(offset[0]) * np.hstack([np.cos(around), np.sin(around), 0 * around])
        swing[:, 2:] += around / np.pi * offset[2]
        last = measured[0] + np.concatenate([[[length, 0.0, 0.0]], swing])
        times = np.append(0.0, APPROACH_TIME + SWING_TIME * np.linspace(0, 1, len(swing)))
        yield (
            ChainMessage(INITIAL, start, FRAME, Chain(straight, grips)),
            ActionMessage(start, FRAME, HANDS, times,
                          np.stack([np.broadcast_to(measured[0], last.shape), last], axis=1),
                          np.broadcast_to(NO_TURN, (len(times), 2, 4))),
            ChainMessage(GOAL, start + nanoseconds(times[-1] + HANGING_WAIT), FRAME, Chain(goal, grips)))


def write_session(output: Path, trials: Trials, options: Mapping[str, Any]) -> tuple[Path, int]:
    """Write trials to a new session; return its path, and the number of trials."""
    types, count = bag_types(), 0
    with SessionWriter(output, options) as writer:
        for messages in trials:
            count += 1
            for message in messages:
                built = action_trajectory(types, message) if isinstance(message, ActionMessage) else \
                    chain_cloud(types, message.chain, message.stamp, message.frame_id)
                kind = ACTION if isinstance(message, ActionMessage) else message.kind
                writer.write(f'{NAMESPACE}/{kind}', INPUT_TYPES[kind], encode(built, INPUT_TYPES[kind]),
                             message.stamp, flush=message is messages[-1])
    return writer.path, count


def _chosen(indices: str, count: int, name: str) -> list[int]:
    """Return indices given as ``0,3,7`` or ``all``."""
    try:
        chosen = list(range(count)) if indices == 'all' else [int(index) for index in indices.split(',')]
    except ValueError:
        chosen = []
    if not chosen or not all(0 <= index < count for index in chosen):
        raise InputError(f'--{name}', repr(indices), f'indices from 0 to {count - 1}, or all', 'correct them')
    return chosen


def _reference(file: Path, arguments: argparse.Namespace) -> tuple[Trials, dict[str, Any]]:
    source = json.loads(file.read_text(encoding='utf-8'))
    by_name = {trial['action']: trial for trial in source['trials']}
    names = {'fitted': FITTED, 'all': tuple(by_name),
             'other': tuple(name for name in by_name if name not in FITTED),
             }.get(arguments.actions, tuple(arguments.actions.split(',')))
    for name in names:
        if name not in by_name:
            raise InputError('--actions', repr(name), f'fitted, other, all, or some of {", ".join(by_name)}',
                             'correct it')
    return (reference_trials([by_name[name] for name in names]),
            {'mass': float(source['properties']['mass']), 'table': True})


def _mocap(file: Path, arguments: argparse.Namespace) -> tuple[Trials, dict[str, Any]]:
    with np.load(file) as source:
        points, rate = source['points'].astype(float), float(source['rate_hz'])
    chosen = _chosen(arguments.recordings, len(points), 'recordings')
    if arguments.every < 1:
        raise InputError('--every', str(arguments.every), '1 or more', 'correct it')
    return mocap_trials(points[chosen], rate, arguments.every), {'table': False}


def _hanging(file: Path, arguments: argparse.Namespace) -> tuple[Trials, dict[str, Any]]:
    with np.load(file) as source:
        points, length = source['points'].astype(float), float(source['length_m'])
        weight = float(source['mass_per_m'])
    whole = length * (points.shape[1] + 1) / (points.shape[1] - 1)  # with the two points in the clamps
    chosen = _chosen(arguments.repeats, len(points), 'repeats')
    return hanging_trials(points[chosen], length), {'mass': weight * whole, 'table': False}


SOURCES = {
    'reference': ('{}.json', _reference),
    'mocap': ('{}_train.npz', _mocap),
    'hanging': ('{}.npz', _hanging),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Convert as the command line asks; return 0, or 2 if that is not possible."""
    parser = argparse.ArgumentParser(description='Convert measured data to sessions.')
    parser.add_argument('--data', type=Path, default=Path(os.environ.get('DLO_DATA', DATA)),
                        help='folder of the data (default: DLO_DATA, or shared/data beside the repository)')
    kinds = parser.add_subparsers(dest='kind', required=True)
    for kind, option, default, says in (
            ('reference', '--actions', 'fitted', 'fitted, other, all, or names with commas'),
            ('mocap', '--recordings', '0', 'indices with commas, or all'),
            ('hanging', '--repeats', 'all', 'indices with commas, or all')):
        verb = kinds.add_parser(kind)
        verb.add_argument('source', help='name of the object, cable or wire')
        verb.add_argument('output', type=Path, help='folder to make')
        verb.add_argument(option, default=default, help=f'{says} (default: {default})')
        if kind == 'mocap':
            verb.add_argument('--every', type=int, default=1, help='N: every Nth frame is a goal')
    given = parser.parse_args(arguments)
    name, read = SOURCES[given.kind]
    file = given.data / given.kind / name.format(given.source)
    try:
        if not file.exists():
            raise InputError('data', f'no {file}', 'the measured data',
                             'name its folder with --data or DLO_DATA, or correct the source')
        path, count = write_session(given.output, *read(file, given))
    except (DloCalibrationError, OSError) as error:
        print(f'convert.py: {error}', file=sys.stderr)
        return 2
    print(f'{path}: {count} trial(s)')
    return 0


if __name__ == '__main__':
    sys.exit(main())
