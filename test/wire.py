# Copyright 2026 The dlo_calibration authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.


"""The two sources of message classes, and the wire between them."""

import numpy as np
import pytest

from dlo_calibration import messages


def graph_types():
    pytest.importorskip('sensor_msgs.msg', reason='the message classes of ROS 2 are not installed')
    return messages.rclpy_types()


SOURCES = {'rosbags': messages.bag_types, 'rclpy': graph_types}


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
