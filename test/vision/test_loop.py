# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A line that turns back where its loop closes follows the loop the other way round."""

import numpy as np
import pytest

from dlo_calibration.vision.loop import straight_on

WIDTH = 3.0


def with_loop(angle):
    """Return an even line (n, 2) with a round loop, which it meets at an angle [rad] to its tangents."""
    turn = np.linspace(-np.pi + angle, np.pi - angle, 120)
    loop = 20.0 * np.column_stack([np.sin(turn), np.cos(turn)])
    step = np.linalg.norm(loop[1] - loop[0])
    way = step * np.arange(1, 60)[:, None]
    begin, end = loop[1] - loop[0], loop[-1] - loop[-2]
    return np.concatenate([(loop[0] - way * begin / step)[::-1], loop, loop[-1] + way * end / step])


def reversed_loop(line):
    return np.concatenate([line[:59], line[59:-59][::-1], line[-59:]])


def test_a_loop_that_is_followed_the_wrong_way_round_is_turned():
    line = with_loop(0.0)
    assert np.abs(straight_on(reversed_loop(line), WIDTH) - line).max() < 0.5 * WIDTH


@pytest.mark.parametrize('line', [
    with_loop(0.0),
    with_loop(0.4),
    np.column_stack([np.arange(200.0), np.zeros(200)]),
    np.zeros((200, 2)),
    # Two strands beside each other, behind a bend.
    np.column_stack([np.r_[np.arange(90.0), 90 + 2 * np.sin(np.linspace(0, np.pi, 8)), np.arange(90.0)[::-1]],
                     np.r_[np.zeros(90), np.linspace(0.0, 4.0, 8), np.full(90, 4.0)]]),
])
def test_other_lines_are_left_as_they_are(line):
    assert straight_on(line, WIDTH) is line
