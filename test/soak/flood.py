# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Flood: messages from tiny to the largest that are allowed, on all topics, as fast as they can be sent.

In every second burst, actions and goal chains have shuffled stamps; a late initial chain would begin another
session.

Lost: messages that the node neither recorded nor counts as dropped.  Died: a node that ends by itself, or
not within a minute after SIGTERM.  Silence: the longest time until a request was answered.
"""

from __future__ import annotations

import json
from pathlib import Path
import signal
import subprocess
import time

from mcap.exceptions import McapError
from mcap.reader import make_reader
import numpy as np
from ros_domain import ros_graph
from tally import peak_of, Tally
from toy_messages import MINUTE, session_messages

from dlo_calibration.errors import InputError
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import (
    ACTION,
    chain_cloud,
    INITIAL,
    INPUT_TYPES,
)
from dlo_calibration.model.chain import Chain, MOST_POINTS

FULL = 130
BURST = 3000  # messages, or as many as these bytes hold
BURST_BYTES = 60_000_000
LATER = 1000  # s, stamp of the first burst
QUIET = 3.0  # s without a new message in the node's count, after which all have come


def conduct(amount: int, seed: int, folder: Path) -> Tally:
    """Send `amount` bursts to one node, and a request after each."""
    from ros_robot import child, robot_of, TYPES

    tally, generator = Tally(), np.random.default_rng(seed)
    with ros_graph(folder) as environment, child(environment, folder / 'out') as process, \
            robot_of(environment) as robot:
        sent = 0
        for kind, message in session_messages(TYPES, 1):  # so that the numbers of all publishers are known
            robot.send([(kind, message)])
            sent += 1
        robot.until_status(trials='1')
        sizes = _messages(TYPES)
        sizes = sizes[seed % len(sizes):] + sizes[:seed % len(sizes)]
        try:
            for k in range(amount):
                kind, message, size = sizes[k % len(sizes)]
                numbers = np.arange(sent, sent + min(BURST, BURST_BYTES // size))
                if k % 2 and kind != INITIAL:
                    generator.shuffle(numbers)
                _burst(robot, kind, message, numbers.tolist())
                sent += len(numbers)
                begun = time.monotonic()
                robot.call('stop')
                tally.remember(silence=time.monotonic() - begun, peak=peak_of(process.pid))
                tally.tried += 1
            _wait(robot)
            tally.remember(peak=peak_of(process.pid))
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=60.0)
            tally.died += process.returncode != 0
        except (AssertionError, OSError, subprocess.TimeoutExpired):
            tally.died += 1
    try:
        session_folder, = (folder / 'out').glob('dlo_session_*')
        read_session(session_folder)
        heard, tally.refused = _recorded(session_folder)
        tally.lost = abs(sent - heard - tally.refused)
    except (InputError, ValueError, McapError):  # as of a node that was killed
        tally.lost = sent
    return tally


def _recorded(folder):
    """
    Return how many input messages are in a recording, and how many it says were dropped.

    `read_session` does not read more than a limit.
    """
    file, = folder.glob('*.mcap')
    with file.open('rb') as stream:
        reader = make_reader(stream)
        about = reader.get_summary()
        heard = sum(count for number, count in about.statistics.channel_message_counts.items()
                    if about.channels[number].topic.rsplit('/', 1)[-1] in INPUT_TYPES)
        dropped = [one.metadata['dropped'] for one in reader.iter_metadata() if 'dropped' in one.metadata]
    return heard, sum(json.loads(dropped[-1]).values()) if dropped else 0


def _messages(types):
    """Return (kind, message, bytes) of all topics, from tiny to the largest."""
    from rclpy.serialization import serialize_message

    (_, chain), (_, action), (_, goal) = session_messages(types, 1)
    tiny = chain_cloud(types, Chain(np.eye(3)), MINUTE, 'world')
    rows = np.zeros((MOST_POINTS, 3))
    rows[:, 0] = np.linspace(0, 1, MOST_POINTS)
    largest = chain_cloud(types, Chain(rows), MINUTE, 'world')
    long = types.build(INPUT_TYPES[ACTION], header=action.header, joint_names=action.joint_names,
                       points=list(action.points) * 2000)
    return [(kind, message, len(serialize_message(message)))
            for kind, message in (('goal_chain', goal), (INITIAL, largest), (ACTION, action),
                                  ('goal_chain', largest), (INITIAL, tiny), (ACTION, long), (INITIAL, chain))]


def _burst(robot, kind, message, numbers):
    """Publish one message several times, stamped so many milliseconds after LATER."""
    for number in numbers:
        message.header.stamp.sec = LATER + number // 1000
        message.header.stamp.nanosec = number % 1000 * 1_000_000
        robot.publishers[kind].publish(message)


def _wait(robot):
    """Wait until the node's status no longer changes."""
    seen, since = -1, time.monotonic()
    while time.monotonic() - since < QUIET:
        robot.executor.spin_once(timeout_sec=0.05)
        if len(robot.heard['status']) != seen:
            seen, since = len(robot.heard['status']), time.monotonic()
