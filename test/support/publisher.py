# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Robot software in a process of its own: `publisher.py SESSION` publishes a session's inputs to the node."""

import sys
import time

import rclpy

from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import INPUT_TYPES, rclpy_types

PATIENCE = 30.0  # s


def main():
    """Publish, and stay until the node has all of it."""
    records = read_session(sys.argv[1]).inputs
    rclpy.init(args=[])
    node, find = rclpy.create_node('robot'), rclpy_types().find
    publishers = {name: node.create_publisher(find(kind), f'/calibrator/{name}', 1000)
                  for name, kind in INPUT_TYPES.items()}
    until = time.monotonic() + PATIENCE
    while not all(publisher.get_subscription_count() for publisher in publishers.values()):
        assert time.monotonic() < until, 'nobody listens'
        rclpy.spin_once(node, timeout_sec=0.05)
    time.sleep(1.0)  # the other side of a match may not know of it yet
    for record in records:
        publishers[record.name].publish(bytes(record.data))
    print('sent', flush=True)
    time.sleep(10 * PATIENCE)  # the end of the test kills it


if __name__ == '__main__':
    main()
