# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Codec: ROS messages of chains and actions to dataclasses and back; duck-typed, imports no rclpy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
import importlib
from typing import Any, Callable, ClassVar, Mapping, Union

import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError
from dlo_calibration.model.action import check_waypoints, MAXIMUM_HANDS
from dlo_calibration.model.chain import Chain, check_ends, Floats, frozen_array, MOST_POINTS
from dlo_calibration.model.trial import LARGEST_FORCE

INITIAL, ACTION, GOAL, WRENCH = 'initial_chain', 'action', 'goal_chain', 'wrench'
#: What every trial needs.
TRIAL_TYPES: Mapping[str, str] = {
    INITIAL: 'sensor_msgs/msg/PointCloud2',
    ACTION: 'trajectory_msgs/msg/MultiDOFJointTrajectory',
    GOAL: 'sensor_msgs/msg/PointCloud2',
}
INPUT_TYPES: Mapping[str, str] = {**TRIAL_TYPES, WRENCH: 'geometry_msgs/msg/WrenchStamped'}
#: What the node sends, name -> type; recorded with its inputs.
OUTPUT_TYPES: Mapping[str, str] = {
    'progress': 'diagnostic_msgs/msg/DiagnosticArray',
    'result': 'diagnostic_msgs/msg/DiagnosticArray',
    'dlo_description': 'std_msgs/msg/String',
    'advice': 'trajectory_msgs/msg/MultiDOFJointTrajectory',
    'status': 'diagnostic_msgs/msg/DiagnosticArray',
    'markers': 'visualization_msgs/msg/MarkerArray',
}

RANKS = {INITIAL: 0, ACTION: 1, GOAL: 2, WRENCH: 3}  # order of messages with equal stamps
Key = tuple[int, int, tuple[str, ...]]  # by which messages are sorted; each collected message has its own

NANOSECONDS = 10**9  # in a second
MAXIMUM_WAYPOINTS = 100_000  # of an action; a quarter of an hour at 100 Hz
MINIMUM_STEP = 1e-6  # s between waypoints; seconds since 1970 as float64 resolve 0.2 us
MAXIMUM_DURATION = 86_400.0  # s, of an action; a stamp sent as time_from_start is longer
UINT8, FLOAT32, FLOAT64 = 2, 7, 8  # datatypes of sensor_msgs/PointField
FIELD_TYPES = {1: 'int8', UINT8: 'uint8', 3: 'int16', 4: 'uint16', 5: 'int32', 6: 'uint32',
               FLOAT32: 'float32', FLOAT64: 'float64'}
COORDINATES = ('x', 'y', 'z')


def named(kind: str, stamp: int) -> str:
    """Return the name of a message in errors, e.g. ``goal_chain stamped 12.5 s``; `stamp` in ns."""
    sign, (seconds, rest) = '-' if stamp < 0 else '', divmod(abs(stamp), NANOSECONDS)
    return f'{kind} stamped {sign}{seconds}{f".{rest:09d}".rstrip("0").rstrip(".")} s'


def _check_stamp(kind: str, stamp: int) -> None:
    if stamp <= 0:
        raise InputError(named(kind, stamp), 'a stamp of zero' if stamp == 0 else 'a negative stamp',
                         'the time of the observation', 'set header.stamp')


@dataclass(frozen=True)
class ChainMessage:
    """
    An observed chain.

    :param kind: INITIAL or GOAL.
    :param stamp: when it was observed [ns], > 0.
    :param chain: its `hands` are None where the message has no field `hand`.
    """

    kind: str
    stamp: int
    frame_id: str
    chain: Chain

    def __post_init__(self) -> None:
        _check_stamp(self.kind, self.stamp)

    def __str__(self) -> str:
        return named(self.kind, self.stamp)

    @cached_property
    def key(self) -> Key:
        """Its place in the order of messages."""
        return self.stamp, RANKS[self.kind], ()


@dataclass(frozen=True)
class ActionMessage:
    """
    The paths of the hands of an action.

    :param stamp: the instant from which `times` count [ns], > 0.
    :param names: of the h hands, 1 to 8, all different.
    :param times: (k,) times of the waypoints [s], increasing, none negative.
    :param positions: (k, h, 3) [m].
    :param orientations: (k, h, 4) quaternions x y z w.
    """

    stamp: int
    frame_id: str
    names: tuple[str, ...]
    times: Floats
    positions: Floats
    orientations: Floats

    kind: ClassVar[str] = ACTION

    def __post_init__(self) -> None:
        names = tuple(self.names)
        times, positions, orientations = map(
            frozen_array, (self.times, self.positions, self.orientations))
        _check_stamp(ACTION, self.stamp)
        thing = str(self)
        if not 1 <= len(names) <= MAXIMUM_HANDS:
            raise InputError(thing, f'{len(names)} joint_names', f'1 to {MAXIMUM_HANDS}',
                             'name the hands that hold the DLO, and only those')
        if len(set(names)) < len(names) or '' in names:
            raise InputError(thing, f'joint_names {list(names)}', 'a different name for each hand',
                             'correct joint_names')
        if not len(times):
            raise InputError(thing, 'no trajectory points', 'at least one',
                             'send where the hands closed, moved and opened')
        check_waypoints(thing, 'trajectory point', names, {
            'time_from_start': times, 'translation': positions, 'rotation': orientations}, MINIMUM_STEP)
        if times[0] < 0 or times[-1] > MAXIMUM_DURATION:
            raise InputError(thing, f'time_from_start from {times[0]:g} to {times[-1]:g} s',
                             f'0 to {MAXIMUM_DURATION:g} s', 'count time_from_start from header.stamp')
        for name, value in (('names', names), ('times', times), ('positions', positions),
                            ('orientations', orientations)):
            object.__setattr__(self, name, value)

    def __str__(self) -> str:
        return named(ACTION, self.stamp)

    @cached_property
    def key(self) -> Key:
        """Its place in the order of messages."""
        return self.stamp, RANKS[ACTION], self.names


@dataclass(frozen=True)
class WrenchMessage:
    """
    What the force sensor of a hand measured.

    :param stamp: [ns], > 0.
    :param frame_id: name of the hand.
    :param force: (3,) [N] in the axes of the hand.
    """

    stamp: int
    frame_id: str
    force: Floats

    kind: ClassVar[str] = WRENCH

    def __post_init__(self) -> None:
        _check_stamp(WRENCH, self.stamp)
        force = frozen_array(self.force)
        if not self.frame_id:
            raise InputError(str(self), 'an empty frame_id', 'the name of a hand, as in joint_names',
                             'let frame_id name the hand')
        if not (np.abs(force) <= LARGEST_FORCE).all():  # NaN is not
            came = ' '.join(f'{value:g}' for value in force)
            raise InputError(f'{self} of {self.frame_id!r}', f'a force of {came} N',
                             f'finite numbers up to {LARGEST_FORCE:g} N', 'leave it out')
        object.__setattr__(self, 'force', force)

    def __str__(self) -> str:
        return named(WRENCH, self.stamp)

    @cached_property
    def key(self) -> Key:
        """Its place in the order of messages."""
        return self.stamp, RANKS[WRENCH], (self.frame_id,)


Message = Union[ChainMessage, ActionMessage]  # of trials
InputMessage = Union[Message, WrenchMessage]


def repeats(message: InputMessage, other: InputMessage) -> bool:
    """Return whether two messages of one kind and stamp have the same content."""
    here, there = (each.positions if isinstance(each, ActionMessage) else
                   each.force if isinstance(each, WrenchMessage) else each.chain.observed
                   for each in (message, other))
    return bool(np.array_equal(here, there, equal_nan=True))


def read(kind: str, message: Any) -> InputMessage:
    """
    Read a message of an input topic.

    :param kind: INITIAL, ACTION, GOAL or WRENCH.
    :param message: an rclpy or `rosbags` object, or anything with the same attributes.
    :raises InputError: where the message is invalid; the text names it.
    """
    stamp = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
    _check_stamp(kind, stamp)
    if kind == ACTION:
        return _read_action(message, stamp)
    if kind == WRENCH:
        force = message.wrench.force
        return WrenchMessage(stamp, message.header.frame_id,
                             np.array([force.x, force.y, force.z], dtype=float))
    return _read_chain(kind, message, stamp)


def _read_chain(kind: str, cloud: Any, stamp: int) -> ChainMessage:
    thing = named(kind, stamp)
    width, height, step = int(cloud.width), int(cloud.height), int(cloud.point_step)
    if 1 not in (width, height):
        raise InputError(thing, f'height {height} and width {width}', 'height 1 or width 1',
                         'send the ordered points along the DLO, not an image')
    count = width * height
    if count > MOST_POINTS:  # refused unread, as a camera image sent by mistake has many
        raise InputError(thing, f'{count} points', f'at most {MOST_POINTS}',
                         'send 20 to 100 points along the DLO, not the whole scene')
    stride = step
    if height > 1:
        stride = int(cloud.row_step)
        if stride < step:
            raise InputError(thing, f'row_step {stride} below point_step {step}',
                             'rows of at least one point', 'correct row_step')
    needed = max((count - 1) * stride + step, 0) if count else 0
    if len(cloud.data) < needed:
        raise InputError(thing, f'{len(cloud.data)} bytes of data',
                         f'{needed} for {count} points of {step} bytes',
                         'send all points, or correct width, height and point_step')
    if not count:
        return ChainMessage(kind, stamp, cloud.header.frame_id, _chain(thing, np.zeros((0, 3))))
    table = np.ndarray((count,), _point_type(thing, cloud, step), np.frombuffer(cloud.data, np.uint8),
                       strides=(stride,))
    given = table.dtype.names or ()
    hands = table['hand'] if 'hand' in given else None
    features = table['feature'] != 0 if 'feature' in given else None
    if hands is not None and (hands > MAXIMUM_HANDS).any():
        raise InputError(thing, f'hand {hands.max()}', f'0 for none, or 1 to {MAXIMUM_HANDS}',
                         'number the hands as in joint_names of the action')
    points = np.stack([table[name].astype(float) for name in COORDINATES], axis=1)
    chain = _chain(thing, points, hands, features)
    if kind != GOAL:  # an initial chain, or the one from which to plan
        check_ends(thing, chain)
    return ChainMessage(kind, stamp, cloud.header.frame_id, chain)


def _chain(thing: str, points: Floats, hands: Any = None, features: Any = None) -> Chain:
    """Return a chain; a refusal names the message."""
    try:
        return Chain(points, hands, features)
    except InputError as error:
        raise InputError(thing, error.came, error.expected, error.remedy) from error


def _point_type(thing: str, cloud: Any, step: int) -> np.dtype[Any]:
    """Return the dtype of field point: the fields that are used, at their offsets."""
    wanted = {**dict.fromkeys(COORDINATES, (FLOAT32, FLOAT64)), 'hand': (UINT8,), 'feature': (UINT8,)}
    layout: dict[str, tuple[str, int]] = {}
    for field in cloud.fields:
        if field.name not in wanted:
            continue
        if field.name in layout:
            raise InputError(thing, f'two fields {field.name!r}', 'one', 'give every field its own name')
        if field.datatype not in wanted[field.name] or field.count != 1:
            came = FIELD_TYPES.get(field.datatype, f'of datatype {field.datatype}')
            raise InputError(thing, f'field {field.name!r} {came} (count {field.count})',
                             f'{" or ".join(FIELD_TYPES[t] for t in wanted[field.name])} (count 1)',
                             'send it in that type' if field.name in COORDINATES else
                             'send it in that type, or under another name if it means something else')
        code = np.dtype(FIELD_TYPES[field.datatype]).newbyteorder('>' if cloud.is_bigendian else '<')
        if field.offset + code.itemsize > step:
            raise InputError(thing,
                             f'field {field.name!r} at offset {field.offset} of points of {step} bytes',
                             'fields inside the point', 'correct offset or point_step')
        layout[field.name] = (code.str, field.offset)
    missing = [name for name in COORDINATES if name not in layout]
    if missing:
        names = ' '.join(field.name for field in cloud.fields) or 'none'
        raise InputError(thing, f'no field {" ".join(missing)} (fields: {names})', 'fields x y z',
                         'send the coordinates in metres under these names')
    return np.dtype({'names': list(layout), 'formats': [code for code, _ in layout.values()],
                     'offsets': [offset for _, offset in layout.values()], 'itemsize': step})


def _read_action(message: Any, stamp: int) -> ActionMessage:
    thing = named(ACTION, stamp)
    names, points = tuple(message.joint_names), message.points
    if len(points) > MAXIMUM_WAYPOINTS:
        raise InputError(thing, f'{len(points)} trajectory points', f'at most {MAXIMUM_WAYPOINTS}',
                         'send fewer; between points a hand moves at constant speed')
    for k, point in enumerate(points):
        if len(point.transforms) != len(names):
            raise InputError(thing, f'{len(point.transforms)} transforms in trajectory point {k}',
                             f'one for each of the {len(names)} joint_names',
                             'give every hand a transform in every point')
    moves = [(t.translation, t.rotation) for point in points for t in point.transforms]
    shape = (len(points), len(names))
    return ActionMessage(
        stamp, message.header.frame_id, names,
        np.array([(p.time_from_start.sec * NANOSECONDS + p.time_from_start.nanosec) / NANOSECONDS
                  for p in points], dtype=float),
        np.array([(p.x, p.y, p.z) for p, _ in moves], dtype=float).reshape(*shape, 3),
        np.array([(q.x, q.y, q.z, q.w) for _, q in moves], dtype=float).reshape(*shape, 4))


@dataclass(frozen=True)
class MessageTypes:
    """
    The message classes of a library, and its values for two kinds of field.

    :param find: returns the class of a type such as ``std_msgs/msg/Header``.
    :param octets: returns the value of a ``uint8[]`` field.
    :param level: returns the value of a ``byte`` field.
    """

    find: Callable[[str], Any]
    octets: Callable[[bytes], Any]
    level: Callable[[int], Any]

    def build(self, type_name: str, **fields: Any) -> Any:
        """Build a message; all its fields must be given."""
        return self.find(type_name)(**fields)

    def header(self, stamp: int, frame_id: str = '') -> Any:
        """Build a header; `stamp` in ns."""
        seconds, rest = divmod(stamp, NANOSECONDS)
        return self.build('std_msgs/msg/Header', frame_id=frame_id, stamp=self.build(
            'builtin_interfaces/msg/Time', sec=seconds, nanosec=rest))


def rclpy_types() -> MessageTypes:
    """Return the message classes of the ROS 2 installation."""
    from array import array

    @cache  # markers have thousands of points, and the search for their class takes as long as they do
    def find(type_name: str) -> Any:
        package, _, name = type_name.split('/')
        return getattr(importlib.import_module(f'{package}.msg'), name)

    return MessageTypes(find, lambda octets: array('B', octets), lambda level: bytes([level]))


def bag_types() -> MessageTypes:
    """Return the message classes of the library `rosbags`, which needs no ROS installation."""
    from rosbags.typesys import get_typestore, Stores

    return MessageTypes(get_typestore(Stores.ROS2_JAZZY).types.__getitem__,
                        lambda octets: np.frombuffer(octets, np.uint8), int)


def built(types: MessageTypes, message: InputMessage) -> Any:
    """Build the message of an input topic."""
    if isinstance(message, WrenchMessage):
        vectors = ({axis: float(value) for axis, value in zip(COORDINATES, values, strict=True)}
                   for values in (message.force.tolist(), np.zeros(3)))
        force, torque = (types.build('geometry_msgs/msg/Vector3', **vector) for vector in vectors)
        wrench = types.build('geometry_msgs/msg/Wrench', force=force, torque=torque)
        return types.build('geometry_msgs/msg/WrenchStamped', wrench=wrench,
                           header=types.header(message.stamp, message.frame_id))
    return action_trajectory(types, message) if isinstance(message, ActionMessage) else \
        chain_cloud(types, message.chain, message.stamp, message.frame_id)


def chain_cloud(types: MessageTypes, chain: Chain, stamp: int, frame_id: str) -> Any:
    """
    Build a PointCloud2 with the fields x y z, and `hand` and `feature` where they are annotated.

    Coordinates are float64, which is exact; those of a point that was not seen are NaN.

    :param stamp: [ns].
    """
    columns: list[tuple[str, int, NDArray[Any]]] = [
        (name, FLOAT64, chain.observed[:, axis]) for axis, name in enumerate(COORDINATES)]
    if chain.hands is not None:
        columns.append(('hand', UINT8, chain.hands))
    if chain.features.any():
        columns.append(('feature', UINT8, chain.features))
    dtype = np.dtype([(name, FIELD_TYPES[datatype]) for name, datatype, _ in columns]).newbyteorder('<')
    table = np.empty(len(chain), dtype)
    for name, _, values in columns:
        table[name] = values
    fields = [types.build('sensor_msgs/msg/PointField', name=name, datatype=datatype, count=1,
                          offset=dtype.fields[name][1])  # type: ignore[index]
              for name, datatype, _ in columns]
    return types.build(
        'sensor_msgs/msg/PointCloud2', header=types.header(stamp, frame_id), height=1, width=len(chain),
        fields=fields, is_bigendian=False, point_step=dtype.itemsize,
        row_step=dtype.itemsize * len(chain), data=types.octets(table.tobytes()),
        is_dense=bool(chain.seen.all()))


def action_trajectory(types: MessageTypes, action: ActionMessage) -> Any:
    """Build a MultiDOFJointTrajectory; times are rounded to ns."""
    points = []
    for time, positions, orientations in zip(
            action.times, action.positions.tolist(), action.orientations.tolist(), strict=True):
        seconds, rest = divmod(round(float(time) * NANOSECONDS), NANOSECONDS)
        transforms = [
            types.build('geometry_msgs/msg/Transform',
                        translation=types.build('geometry_msgs/msg/Vector3', x=x, y=y, z=z),
                        rotation=types.build('geometry_msgs/msg/Quaternion', x=qx, y=qy, z=qz, w=qw))
            for (x, y, z), (qx, qy, qz, qw) in zip(positions, orientations, strict=True)]
        points.append(types.build(
            'trajectory_msgs/msg/MultiDOFJointTrajectoryPoint', transforms=transforms, velocities=[],
            accelerations=[], time_from_start=types.build(
                'builtin_interfaces/msg/Duration', sec=seconds, nanosec=rest)))
    return types.build('trajectory_msgs/msg/MultiDOFJointTrajectory', points=points,
                       header=types.header(action.stamp, action.frame_id), joint_names=list(action.names))
