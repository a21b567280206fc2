# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Messages that cannot be used, each with the words that its refusal must say; and mutations of good ones."""

from __future__ import annotations

from dataclasses import dataclass
import functools
import random
from typing import Any, Callable

from hypothesis import strategies as st
import numpy as np
from toy_messages import MINUTE, SECOND, toy_trials, trial_messages

from dlo_calibration.files.record import encode
from dlo_calibration.messages.codec import (
    ACTION,
    action_trajectory,
    ActionMessage,
    bag_types,
    chain_cloud,
    FLOAT32,
    GOAL,
    INITIAL,
    INPUT_TYPES,
    MessageTypes,
    UINT8,
)
from dlo_calibration.model.chain import Chain

INT16, INT32 = 3, 5  # sensor_msgs/PointField
LATE = 130 * SECOND  # after the two good trials, which begin at 60 and 120 s
POINTS = 11  # of a chain of the toy


@dataclass(frozen=True)
class Wrong:
    """
    A message that must be refused.

    :param make: of message types; returns the message.
    :param came: what the refusal says came.
    :param expected: what it says was expected.
    :param remedy: what it says to do.
    """

    name: str
    kind: str
    make: Callable[[MessageTypes], Any]
    came: str
    expected: str
    remedy: str

    def words(self) -> tuple[str, ...]:
        """Return what must be in its refusal."""
        return self.kind, self.came, f'expected {self.expected}', self.remedy


def good_points() -> np.ndarray:
    """Return the goal of the second good trial, (POINTS, 3) [m]."""
    return toy_trials(2)[1].goals[0].chain.points.copy()


def cloud(stamp=LATE, frame='world', points=None, spoil=None, hands=None, **fields):
    """Return a maker of a chain like the last one of the good trials, but for what is given."""
    def make(types):
        chain = Chain(good_points() if points is None else points, hands)
        message = chain_cloud(types, chain, stamp, frame)
        for name, value in fields.items():
            setattr(message, name, value)
        if spoil is not None:
            spoil(types, message)
        return message
    return make


def with_point(index, value):
    """Return a maker of a chain with one point set to `value`, also one that no chain may have."""
    def spoil(types, message):
        points = good_points()
        points[index] = points[index - 1] if value is None else value
        message.data = types.octets(points.astype('<f8').tobytes())
    return cloud(spoil=spoil)


def with_field(index, **changes):
    """Return a maker of a chain one of whose fields (x y z) is declared otherwise."""
    def spoil(types, message):
        for name, value in changes.items():
            setattr(message.fields[index], name, value)
    return cloud(spoil=spoil)


def with_hand(datatype, number):
    """Return a maker of a chain whose last point is annotated."""
    def spoil(types, message):
        message.fields[3].datatype = datatype
        octets = bytearray(bytes(message.data))
        octets[-1] = number
        message.data = types.octets(bytes(octets))
    return cloud(hands=np.zeros(POINTS, np.uint8), spoil=spoil)


def cut(count):
    """Return a maker of a chain that lacks its last `count` bytes."""
    def spoil(types, message):
        message.data = types.octets(bytes(message.data)[:-count])
    return cloud(spoil=spoil)


def short(count):
    """Return a maker of a chain of `count` points only."""
    def spoil(types, message):
        message.width = count
        message.data = types.octets(bytes(message.data)[:24 * count])
        message.row_step = 24 * count
    return cloud(spoil=spoil)


def million(types):
    """Return a whole camera image in place of a chain."""
    message = cloud()(types)
    for k, field in enumerate(message.fields):
        field.datatype, field.offset = FLOAT32, 4 * k
    message.width, message.point_step, message.row_step = 10**6, 12, 12 * 10**6
    message.data = types.octets(bytes(12 * 10**6))
    return message


def action(stamp=LATE, frame='world', names=('left_hand',), times=(0.0, 1.0), away=0.0, spoil=None):
    """Return a maker of an action of hands that close at the first points of the last chain, `away` [m]."""
    def make(types):
        start = good_points()[:len(names)] + (0, 0, away)
        positions = np.stack([start + (0, 0.01 * k, 0) for k in range(len(times))])
        message = action_trajectory(types, ActionMessage(
            stamp, frame, tuple(f'hand {k}' for k in range(min(len(names), 8))), np.arange(len(times)) * 1.0,
            positions[:, :8], np.tile((0.0, 0.0, 0.0, 1.0), (len(times), min(len(names), 8), 1))))
        for point, time in zip(message.points, times, strict=True):
            point.time_from_start.sec, rest = divmod(round(time * SECOND), SECOND)
            point.time_from_start.nanosec = rest
            point.transforms = [*point.transforms, *point.transforms[:len(names) - len(point.transforms)]]
        message.joint_names = list(names)
        if spoil is not None:
            spoil(message)
        return message
    return make


def set_first(part, **values):
    """Return what sets the translation or rotation of the first waypoint."""
    def spoil(message):
        for name, value in values.items():
            setattr(getattr(message.points[0].transforms[0], part), name, value)
    return spoil


def drop_transforms(message):
    """Leave the second waypoint without a pose."""
    message.points[1].transforms = []


def drop_hands(message):
    """Leave waypoints of no hand."""
    message.joint_names = []
    for point in message.points:
        point.transforms = []


def drop_points(message):
    """Leave no waypoint."""
    message.points = []


def repeated(types):
    """Return another goal chain at the stamp of the last one."""
    return cloud(stamp=2 * MINUTE + 2 * SECOND, points=good_points() + 0.01)(types)


SEND_DLO = 'send the points along the whole DLO, first to last'
NAMES = tuple(f'hand {k}' for k in range(9))

WRONG = [
    # chains
    Wrong('no point', INITIAL, short(0), '0 point(s)', 'at least 3', SEND_DLO),
    Wrong('two points', GOAL, short(2), '2 point(s)', 'at least 3', SEND_DLO),
    Wrong('most unseen', GOAL, with_point(slice(1, 7), np.nan),
          '5 of 11 points that were seen, and NaN in point(s) 1, 2, 3, 4, 5 and 1 more',
          'at least 6 that were seen', 'observe the DLO from where less of it is hidden'),
    Wrong('end unseen', INITIAL, with_point(slice(9, 11), np.nan),
          'an initial chain whose last 2 points were not seen', 'at most one unseen point at each end',
          'observe the whole DLO before the action begins'),
    Wrong('infinity', GOAL, with_point(0, -np.inf), 'infinity in point(s) 0', 'coordinates in metres',
          'leave such frames out, or send NaN for a point that was not seen'),
    Wrong('huge', GOAL, with_point(3, 1e300), 'a coordinate of 1e+300 m in point 3', 'at most 1e+08 m',
          'send metres'),
    Wrong('coincident', GOAL, with_point(5, None), 'coincident neighbours after point(s) 4',
          'neighbours at least 1e-06 m apart', 'remove the repeated points'),
    Wrong('integers', INITIAL, with_field(0, datatype=INT32), "field 'x' int32", 'float32 or float64',
          'send it in that type'),
    Wrong('unknown type', GOAL, with_field(1, datatype=99), "field 'y' of datatype 99", 'float32 or float64',
          'send it in that type'),
    Wrong('vector field', GOAL, with_field(2, count=3), "field 'z' float64 (count 3)",
          'float32 or float64 (count 1)', 'send it in that type'),
    Wrong('no coordinate', GOAL, with_field(2, name='depth'), 'no field z (fields: x y depth)',
          'fields x y z', 'send the coordinates in metres under these names'),
    Wrong('two of a name', GOAL, with_field(2, name='x'), "two fields 'x'", 'one',
          'give every field its own name'),
    Wrong('field outside', GOAL, with_field(2, offset=20), "field 'z' at offset 20 of points of 24 bytes",
          'fields inside the point', 'correct offset or point_step'),
    Wrong('small point_step', INITIAL, cloud(point_step=8), "field 'y' at offset 8 of points of 8 bytes",
          'fields inside the point', 'correct offset or point_step'),
    Wrong('cut data', INITIAL, cut(1), '263 bytes of data', '264 for 11 points of 24 bytes',
          'send all points, or correct width, height and point_step'),
    Wrong('width too large', GOAL, cloud(width=12), '264 bytes of data', '288 for 12 points of 24 bytes',
          'send all points, or correct width, height and point_step'),
    Wrong('image', GOAL, cloud(width=4, height=3), 'height 3 and width 4', 'height 1 or width 1',
          'send the ordered points along the DLO, not an image'),
    Wrong('million', INITIAL, million, '1000000 points', 'at most 1000',
          'send 20 to 100 points along the DLO, not the whole scene'),
    Wrong('ninth hand', GOAL, with_hand(UINT8, 9), 'hand 9', '0 for none, or 1 to 8',
          'number the hands as in joint_names'),
    Wrong('hand of another type', GOAL, with_hand(INT16, 1), "field 'hand' int16", 'uint8',
          'send it in that type, or under another name'),
    Wrong('hand that was not there', GOAL, with_hand(UINT8, 3), 'points held by hand 3', 'hands 1 to 1',
          'number the hands in the order of joint_names'),
    Wrong('fewer points', GOAL, cloud(points=good_points()[:-1]), '10 points',
          '11 points as in initial_chain stamped 120 s', 'send the same material points'),
    Wrong('other length', GOAL, cloud(points=2 * good_points()), 'a length of', 'at most 50 %',
          'check that both chains run along the whole DLO'),
    # stamps and frames
    *(Wrong(f'stamp of zero, {kind}', kind, make(), 'a stamp of zero',
            'the time of the observation', 'set header.stamp')
      for kind, make in ((INITIAL, cloud), (ACTION, action), (GOAL, cloud))),
    Wrong('negative stamp', GOAL, cloud(), 'a negative stamp', 'the time of the observation',
          'set header.stamp'),
    Wrong('equal stamps', GOAL, repeated, 'a second goal_chain with this stamp', 'one',
          'stamp every message with its own time'),
    Wrong('backward stamp, goal', GOAL, cloud(stamp=SECOND), 'no initial_chain before it',
          'one stamped earlier (the first is initial_chain stamped 60 s)',
          'stamp all messages with one clock'),
    Wrong('backward stamp, action', ACTION, action(stamp=2 * SECOND), 'no initial_chain before it',
          'one stamped earlier (the first is initial_chain stamped 60 s)',
          'stamp all messages with one clock'),
    *(Wrong(f'foreign frame, {kind}', kind, make(frame='camera'), "frame_id 'camera'",
            "'world' as in the first message", 'send all chains and actions in one frame')
      for kind, make in ((INITIAL, cloud), (ACTION, action), (GOAL, cloud))),
    # actions
    Wrong('grips nothing', ACTION, action(away=0.05),
          'left_hand closing 0.0458 m from any point of goal_chain',
          'at most 0.02 m (grip_tolerance)', 'check the first waypoint'),
    Wrong('two hands, one point', ACTION,
          action(names=('a', 'b'), spoil=lambda m: setattr(m.points[0], 'transforms',
                                                           [m.points[0].transforms[0]] * 2)),
          'two hands that grip point 0', 'different points', 'number the gripped points in the field hand'),
    Wrong('nine hands', ACTION, action(names=NAMES), '9 joint_names', '1 to 8',
          'name the hands that hold the DLO, and only those'),
    Wrong('no hand', ACTION, action(spoil=drop_hands), '0 joint_names', '1 to 8',
          'name the hands that hold the DLO, and only those'),
    Wrong('hands of one name', ACTION, action(names=('a', 'a')), "joint_names ['a', 'a']",
          'a different name for each hand', 'correct joint_names'),
    Wrong('no waypoint', ACTION, action(spoil=drop_points), 'no trajectory points', 'at least one',
          'send where the hands closed, moved and opened'),
    Wrong('backward waypoints', ACTION, action(times=(2.0, 1.0)),
          'time_from_start 1 s of trajectory point 1 after 2 s', 'increasing times', 'sort the points'),
    Wrong('equal waypoints', ACTION, action(times=(1.0, 1.0)),
          'time_from_start 1 s of trajectory point 1 after 1 s', 'increasing times', 'sort the points'),
    Wrong('waypoints too near', ACTION, action(times=(1.0, 1.0000002)),
          'time_from_start 1.0000002 s of trajectory point 1 after 1 s',
          'increasing times, by 1e-06 s at least', 'sort the points'),
    Wrong('waypoint before the start', ACTION, action(times=(-1.0, 1.0)), 'time_from_start from -1 to 1 s',
          '0 to 86400 s', 'count time_from_start from header.stamp'),
    Wrong('waypoint times that are stamps', ACTION, action(times=(0.0, 1.7e9)),
          'time_from_start from 0 to 1.7e+09 s', '0 to 86400 s', 'count time_from_start from header.stamp'),
    Wrong('missing transform', ACTION, action(spoil=drop_transforms), '0 transforms in trajectory point 1',
          'one for each of the 1 joint_names', 'give every hand a transform in every point'),
    Wrong('NaN in a path', ACTION, action(spoil=set_first('translation', z=float('nan'))),
          'NaN or infinity in translation of trajectory point 0', 'finite numbers', 'leave such points out'),
    Wrong('infinity in a turn', ACTION, action(spoil=set_first('rotation', w=float('inf'))),
          'NaN or infinity in rotation of trajectory point 0', 'finite numbers', 'leave such points out'),
    Wrong('no rotation', ACTION, action(spoil=set_first('rotation', w=0.0)),
          'a quaternion of length 0 for left_hand', 'a unit quaternion x y z w', 'use 0 0 0 1'),
    Wrong('huge rotation', ACTION, action(spoil=set_first('rotation', w=1e200)),
          'a quaternion of length 1e+200 for left_hand', 'a unit quaternion x y z w', 'use 0 0 0 1'),
]


def made(case: Wrong, types: MessageTypes) -> Any:
    """Return the message of a case; what the constructors refuse to write is written here."""
    message = case.make(types)
    if case.came == 'a stamp of zero':
        message.header.stamp.sec = 0
    elif case.came == 'a negative stamp':
        message.header.stamp.sec = -3
    return message


# ---- mutations

#: Values that break what computes with them.
INTEGERS = (0, 1, 2, 3, 7, 8, 127, 255, 256, 65535, 2**31 - 1, 2**32 - 1, -1, -2**31)
NUMBERS = (0.0, -0.0, 1e-320, 1e-7, 1.0, -1.0, 3e7, 1e8, 1e9, 1e154, 1e308, float('inf'), float('-inf'),
           float('nan'))
TEXTS = ('', 'world', 'x', 'hand', 'left_hand', 'a\nb\x1b[31m', '\u00e4\U0001f600', 'n' * 5000)


def fuzzed_pairs(types: MessageTypes, frame: str) -> list:
    """Return the messages to mutate: a trial after the good ones, and their successors within."""
    pairs = trial_messages(types, toy_trials(3)[2], LATE, frame)
    annotated = cloud(LATE + SECOND, frame, hands=np.zeros(POINTS, np.uint8))
    two = action(LATE + 3 * SECOND, frame, names=('a', 'b'), times=(0.0, 0.5, 1.0))
    return [*pairs, (GOAL, annotated(types)), (INITIAL, cloud(LATE + 2 * SECOND, frame)(types)),
            (ACTION, two(types)), (GOAL, cloud(LATE + 9 * SECOND, frame)(types))]


def mutated(octets: bytes, dice: random.Random) -> bytes:
    """Mutate a serialised message or a file: overwrite, cut, lengthen, repeat, swap."""
    changed = bytearray(octets)
    for _ in range(dice.randint(1, 3)):
        if len(changed) < 9:
            break
        place = dice.randint(0, len(changed) - 8)
        how = dice.choice(('bit', 'byte', 'integer', 'number', 'cut', 'insert', 'remove', 'repeat', 'swap'))
        if how == 'bit':
            changed[place] ^= 1 << dice.randint(0, 7)
        elif how == 'byte':
            changed[place] = dice.randint(0, 255)
        elif how == 'integer':
            value = dice.choice(INTEGERS) % 2**32
            changed[place // 4 * 4:place // 4 * 4 + 4] = value.to_bytes(4, 'little')
        elif how == 'number':
            changed[place // 4 * 4:place // 4 * 4 + 8] = np.float64(dice.choice(NUMBERS)).tobytes()
        elif how == 'cut':
            del changed[place:]
        elif how == 'insert':
            changed[place:place] = bytes(dice.randint(0, 255) for _ in range(dice.randint(1, 8)))
        elif how == 'remove':
            del changed[place:place + dice.randint(1, 8)]
        else:
            piece = changed[place:place + dice.choice((8, 100, 1000))]
            other = dice.randint(0, len(changed) - 1)
            if how == 'swap':
                changed[place:place + len(piece)] = changed[other:other + len(piece)]
            changed[other:other + (len(piece) if how == 'swap' else 0)] = piece
    return bytes(changed)


def mutated_bytes(octets: bytes) -> st.SearchStrategy[bytes]:
    """Return a strategy of mutations of a serialised message."""
    return st.randoms(use_true_random=False).map(functools.partial(mutated, octets))


def _places(message: Any) -> list:
    """List (object, attribute) of everything in a message that can be set."""
    places, waiting = [], [message]
    while waiting:
        part = waiting.pop()
        for name in vars(part) if hasattr(part, '__dict__') else ():
            value = getattr(part, name)
            if name.startswith('__'):
                continue
            places.append((part, name))
            several = value if isinstance(value, list) else [value]
            waiting += [each for each in several if hasattr(each, '__msgtype__')]
    return places


@st.composite
def mutated_fields(draw, make: Callable[[], Any]) -> Any:
    """Mutate the fields of a message of the library rosbags, each in its own type."""
    message = make()
    for _ in range(draw(st.integers(1, 3))):
        places = _places(message)
        part, name = places[draw(st.integers(0, len(places) - 1))]
        value = getattr(part, name)
        if isinstance(value, bool):
            setattr(part, name, not value)
        elif isinstance(value, int):
            number = draw(st.sampled_from(INTEGERS))
            bits = 8 if name == 'datatype' else 32
            setattr(part, name, number if name == 'sec' else number % 2**bits)
        elif isinstance(value, float):
            setattr(part, name, draw(st.one_of(st.sampled_from(NUMBERS), st.floats())))
        elif isinstance(value, str):
            setattr(part, name, draw(st.sampled_from(TEXTS)))
        elif isinstance(value, np.ndarray):
            table = value.copy()
            places = draw(st.lists(st.integers(0, max(len(table) // 8 - 1, 0)), max_size=3))
            for place in places if len(table) >= 8 else ():
                number = np.float64(draw(st.sampled_from(NUMBERS)))
                table[8 * place:8 * place + 8] = np.frombuffer(number.tobytes(), np.uint8)
            setattr(part, name, table[:draw(st.sampled_from((len(table), len(table) // 2, 0)))])
        elif isinstance(value, list):
            setattr(part, name, draw(st.sampled_from((value, value[:-1], value * 2, value[::-1], []))))
    return message


def mutations(frame):
    """Return a strategy of (kind, bytes), each a mutated message."""
    return st.sampled_from(serialised(frame)).flatmap(
        lambda pair: st.tuples(st.just(pair[0]), mutated_bytes(pair[1])))


@functools.cache
def serialised(frame):
    """Return (kind, bytes) of the messages to mutate."""
    return [(kind, encode(message, INPUT_TYPES[kind])) for kind, message in fuzzed_pairs(bag_types(), frame)]
