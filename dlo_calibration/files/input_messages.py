# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Definitions of the messages that a session consists of, as ROS 2 Jazzy has them.

The library rosbags has those of all messages of Jazzy, but takes a tenth of a second to load them.
"""

from __future__ import annotations

from functools import lru_cache

from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

DEFINITIONS = {
    'std_msgs/msg/Header': """
        builtin_interfaces/Time stamp
        string frame_id""",
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
    'geometry_msgs/msg/Vector3': """
        float64 x
        float64 y
        float64 z""",
    'geometry_msgs/msg/Quaternion': """
        float64 x 0
        float64 y 0
        float64 z 0
        float64 w 1""",
    'geometry_msgs/msg/Transform': """
        geometry_msgs/Vector3 translation
        geometry_msgs/Quaternion rotation""",
    'geometry_msgs/msg/Twist': """
        geometry_msgs/Vector3 linear
        geometry_msgs/Vector3 angular""",
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


@lru_cache(maxsize=1)
def input_types() -> Typestore:
    """Return what decodes the input messages."""
    store = get_typestore(Stores.EMPTY)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store
