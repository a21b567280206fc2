# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""In a flood, dropped messages are counted and reported."""

import pytest

from dlo_calibration.messages.codec import GOAL
from dlo_calibration.ros import calibrator_node as module
from dlo_calibration.ros.calibrator_node import Inbox


def dropped(numbers):
    inbox = Inbox()
    for number in numbers:
        inbox.put(GOAL, b'', number)
    return inbox.take_dropped()[GOAL]


@pytest.mark.parametrize(('numbers', 'count'), [
    ([1, 2, 3], 0), ([7, 8, 9], 0), ([1, 2, 6, 7], 3), ([101, 1, 102, 2, 105, 3], 2),
    ([5, 7, 10, 8], 3), ([900, 901, 1, 2], 0), ([None, None], 0),
], ids=['none', 'the subscription is younger than the publisher', 'a gap', 'one of two publishers',
        'two publishers that cannot be distinguished', 'the publisher was restarted', 'no numbers'])
def test_messages_that_are_missing_between_others_are_counted(numbers, count):
    assert dropped(numbers) == count


def test_messages_beyond_the_limit_are_dropped_and_counted_and_the_rest_comes_in_order(monkeypatch):
    monkeypatch.setattr(module, 'LIMIT', 3 * (10 + module.OVERHEAD))
    inbox = Inbox()
    for k in range(4):
        inbox.put(GOAL, b'%010d' % k, k + 1)
    inbox.put_request('start')
    assert inbox.take_dropped() == {GOAL: 1}
    assert [inbox.take() for _ in range(len(inbox))] == [
        *((GOAL, b'%010d' % k) for k in range(3)), ('start', None)]
    inbox.put(GOAL, b'x', 5)
    assert len(inbox) == 1
