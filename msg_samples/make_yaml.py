# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Write the first trial of a session as YAML, one file per message, for `ros2 topic pub`.

    python msg_samples/make_yaml.py [SESSION] [FOLDER]

SESSION is object1 beside this file by default, and FOLDER is the folder of this file.
Only every second point of a chain is written.
"""

from __future__ import annotations

from pathlib import Path
import sys
from typing import Sequence

import numpy as np

from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import ActionMessage, ChainMessage, NANOSECONDS, read, TRIAL_TYPES

HERE = Path(__file__).resolve().parent
EVERY = 2  # points of a chain, so that the files stay short
#: Layout of one point in a message.
POINT = np.dtype([('x', '<f4'), ('y', '<f4'), ('z', '<f4'), ('hand', 'u1')])

TITLE = """\
# ros2 topic pub --once /calibrator/{kind} {type} \\
#   "$(cat msg_samples/{kind}.yaml)"
#
# {what}
"""
WHAT = {
    'initial_chain': 'Where the DLO was before the action.',
    'action': 'What the hand did: it closed at the first waypoint, and opened at the last.',
    'goal_chain': 'Where the DLO was when it had come to rest after the action.',
}
HEADER = """\
header:
  stamp: {{sec: {sec}, nanosec: {nanosec}}}  # when: it orders the messages, and is never zero
  frame_id: {frame}  # the same in all messages; its z points up
"""
CLOUD = """\
height: 1
width: {count}  # points along the DLO, from its first end to its last; as many in initial and goal
fields:  # datatype 7 is float32, 8 float64 and 2 uint8
  - {{name: x, offset: 0, datatype: 7, count: 1}}  # metres
  - {{name: y, offset: 4, datatype: 7, count: 1}}
  - {{name: z, offset: 8, datatype: 7, count: 1}}
  - {{name: hand, offset: 12, datatype: 2, count: 1}}  # {hand}
is_bigendian: false
point_step: {step}  # bytes of one point
row_step: {row}  # bytes of all points
is_dense: true
data: [  # the bytes of the points, in a line each
"""
HAND = {
    'initial_chain': 'optional: 1 where the first of joint_names grips, 0 none',
    'goal_chain': 'optional: 1 where the first of joint_names still holds, 0 none',
}
ACTION = """\
joint_names: [{names}]  # the hands, one to eight
# Waypoints, each with one transform (in metres) for each hand; time_from_start counts from header.stamp.
# Between them a hand moves on the shortest path at constant speed.
points:
"""
WAYPOINT = """\
  - time_from_start: {{sec: {sec}, nanosec: {nanosec}}}
    transforms:
"""
TRANSFORM = """\
      - translation: {{x: {:.4f}, y: {:.4f}, z: {:.4f}}}
        rotation: {{x: {:.4f}, y: {:.4f}, z: {:.4f}, w: {:.4f}}}
"""


def written(message: ChainMessage | ActionMessage) -> str:
    """Return a message as YAML with comments."""
    sec, nanosec = divmod(message.stamp, NANOSECONDS)
    top = TITLE.format(kind=message.kind, type=TRIAL_TYPES[message.kind], what=WHAT[message.kind]) \
        + HEADER.format(sec=sec, nanosec=nanosec, frame=message.frame_id)
    return top + (written_action(message) if isinstance(message, ActionMessage) else written_chain(message))


def written_chain(message: ChainMessage) -> str:
    """Return the lines after the header of a chain message."""
    points = message.chain.points[::EVERY]
    table = np.zeros(len(points), POINT)
    for axis, values in zip('xyz', points.T, strict=True):
        table[axis] = values.round(4)
    if message.chain.hands is not None:
        table['hand'] = message.chain.hands[::EVERY]
    lines = []
    for k, row in enumerate(table):
        octets = ''.join(f'{octet:3d}, ' for octet in row.tobytes())
        lines.append(f'  {octets} # {k:2d}: {row["x"]:7.4f} {row["y"]:7.4f} {row["z"]:7.4f}, {row["hand"]}\n')
    head = CLOUD.format(count=len(table), step=POINT.itemsize, row=table.nbytes, hand=HAND[message.kind])
    return head + ''.join(lines) + ']\n'


def written_action(message: ActionMessage) -> str:
    """Return the lines after the header of an action message."""
    text = ACTION.format(names=', '.join(message.names))
    for time, positions, turns in zip(message.times, message.positions, message.orientations, strict=True):
        sec, nanosec = divmod(round(float(time) * NANOSECONDS), NANOSECONDS)
        text += WAYPOINT.format(sec=sec, nanosec=nanosec)
        for position, turn in zip(positions, turns, strict=True):
            text += TRANSFORM.format(*position, *turn)
    return text


def main(arguments: Sequence[str]) -> int:
    """Write the files."""
    session = Path(arguments[0]) if arguments else HERE / 'object1'
    folder = Path(arguments[1]) if len(arguments) > 1 else HERE
    for kind, message in read_session(session).messages[:len(TRIAL_TYPES)]:
        (folder / f'{kind}.yaml').write_text(written(read(kind, message)), encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
