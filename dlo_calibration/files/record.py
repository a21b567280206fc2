# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Record: one recorded message, its bytes to an object and back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from dlo_calibration.errors import InputError

#: The messages of the input topics, as Jazzy defines them: all of Jazzy's take a tenth of a second to load.
DEFINITIONS = {
    'std_msgs/msg/Header': 'builtin_interfaces/Time stamp\nstring frame_id',
    'geometry_msgs/msg/Vector3': 'float64 x\nfloat64 y\nfloat64 z',
    'geometry_msgs/msg/Quaternion': 'float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1',
    'geometry_msgs/msg/Transform': 'geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation',
    'geometry_msgs/msg/Twist': 'geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular',
    'geometry_msgs/msg/Wrench': 'geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque',
    'geometry_msgs/msg/WrenchStamped': 'std_msgs/Header header\ngeometry_msgs/Wrench wrench',
    'sensor_msgs/msg/PointField': """
        uint8 INT8=1
        uint8 UINT8=2
        uint8 INT16=3
        uint8 UINT16=4
        uint8 INT32=5
        uint8 UINT32=6
        uint8 FLOAT32=7
        uint8 FLOAT64=8
        string name
        uint32 offset
        uint8 datatype
        uint32 count""",
    'sensor_msgs/msg/PointCloud2': """
        std_msgs/Header header
        uint32 height
        uint32 width
        sensor_msgs/PointField[] fields
        bool is_bigendian
        uint32 point_step
        uint32 row_step
        uint8[] data
        bool is_dense""",
    'trajectory_msgs/msg/MultiDOFJointTrajectoryPoint': """
        geometry_msgs/Transform[] transforms
        geometry_msgs/Twist[] velocities
        geometry_msgs/Twist[] accelerations
        builtin_interfaces/Duration time_from_start""",
    'trajectory_msgs/msg/MultiDOFJointTrajectory': """
        std_msgs/Header header
        string[] joint_names
        trajectory_msgs/MultiDOFJointTrajectoryPoint[] points""",
}


@dataclass(frozen=True, slots=True)
class Record:
    """
    One recorded message.

    :param type: full name, ``package/msg/Type``.
    :param data: CDR bytes, with the encapsulation header.
    :param log_time: time of the recording [ns].
    :param stands_for: the input topic as which the user reads it; empty: its own name counts.
    """

    topic: str
    type: str
    data: bytes
    log_time: int
    stands_for: str = ''

    @property
    def name(self) -> str:
        """The last component of the topic's name, or the input topic for which it stands."""
        return self.stands_for or self.topic.rsplit('/', 1)[-1]

    @property
    def namespace(self) -> str:
        """The topic's name without its last component."""
        return self.topic.rpartition('/')[0]


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Return the message definitions of Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=1)
def input_types() -> Typestore:
    """Return the message definitions of the input topics."""
    store, types = get_typestore(Stores.EMPTY), {}
    for name, text in DEFINITIONS.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


def decode(record: Record) -> Any:
    """
    Return the message of a record, as an object with the fields of its type.

    :raises InputError: where the bytes are not a message of that type.
    """
    try:
        types = input_types() if record.type in DEFINITIONS else typestore()
        return types.deserialize_cdr(record.data, record.type)
    except Exception as error:  # damaged bytes can raise anything
        raise InputError(
            f'{record.name} recorded at {record.log_time / 1e9:.3f} s',
            f'bytes that do not decode ({error!r})', f'a {record.type}',
            'leave that message out, or record the session again') from error


def encode(message: Any, message_type: str) -> bytes:
    """Return the CDR bytes of a message object of the library rosbags."""
    return bytes(typestore().serialize_cdr(message, message_type))
