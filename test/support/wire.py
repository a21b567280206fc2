# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The two sources of message classes, the wire between them, and what a `result` message says."""

import numpy as np
import pytest

from dlo_calibration.messages import codec
from dlo_calibration.ros.diagnostics import WHOLE


def graph_types():
    pytest.importorskip('sensor_msgs.msg', reason='the message classes of ROS 2 are not installed')
    return codec.rclpy_types()


SOURCES = {'rosbags': codec.bag_types, 'rclpy': graph_types}


def wire(types):
    """Return a function that serialises a message of these types and reads it back."""
    if isinstance(types.octets(b''), np.ndarray):
        from rosbags.typesys import get_typestore, Stores
        store = get_typestore(Stores.ROS2_JAZZY)

        def travel(message):
            name = message.__msgtype__
            return store.deserialize_cdr(store.serialize_cdr(message, name), name)
    else:
        serialization = pytest.importorskip('rclpy.serialization', reason='ROS 2 is not installed')

        def travel(message):
            return serialization.deserialize_message(serialization.serialize_message(message), type(message))

    return travel


def result_values(message):
    """Read the parameters of a `result` message: name -> key -> number, text or bool."""
    parameters = {}
    for status in message.status:
        if status.name != WHOLE:
            values = {pair.key: pair.value for pair in status.values}
            parameters[status.name] = {
                key: value == 'true' if key == 'identifiable' else
                value if key.endswith(('unit', 'verdict', 'note')) else float(value)
                for key, value in values.items()}
    return parameters
