# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A clock that goes back is distinguished from messages that come late."""

import pytest
from test_collector import action, goal, initial

from dlo_calibration.errors import InputError
from dlo_calibration.messages.collector import StampOrder

TRIALS = (initial(100), action(101), goal(110), initial(160), action(161), goal(170))


def after(*messages):
    order = StampOrder()
    for message in messages:
        order.add(message)
    return order


@pytest.mark.parametrize('message', [
    initial(30), initial(105), initial(140)], ids=['before all', 'within a trial', 'between trials'])
def test_an_initial_chain_long_before_the_newest_one_shows_that_the_clock_went_back(message):
    assert after(*TRIALS).clock_went_back(message)


@pytest.mark.parametrize(('earlier', 'message'), [
    (TRIALS, initial(159.5)), (TRIALS, initial(200)),
    (TRIALS[:4], action(101)), ((initial(100), goal(110)), action(50)),
    ((initial(2000), initial(101), action(102)), initial(105)),
], ids=['another tracker', 'the next trial', 'an action that is sent when it is over', 'its topic is new',
        'one stamp was wrong'])
def test_a_late_message_is_no_clock_that_went_back(earlier, message):
    order = after(*earlier)
    assert not order.clock_went_back(message)
    order.check(message)


@pytest.mark.parametrize('message', [goal(105), action(120)])
def test_an_action_or_goal_that_goes_back_into_an_earlier_trial_is_refused(message):
    with pytest.raises(InputError, match='in an earlier trial'):
        after(*TRIALS).check(message)


def test_messages_under_way_as_the_clock_went_back_are_left_over():
    order = StampOrder(after(*TRIALS))
    order.add(initial(30))
    assert order.left_over(goal(170.5))
    for message in (action(31), goal(40), initial(160), action(161), goal(170)):  # the same as before
        assert not order.clock_went_back(message)
        assert not order.left_over(message)
        order.check(message)
        order.add(message)


def test_the_same_trial_again_is_not_left_over():
    order = StampOrder(after(*TRIALS[:3]))
    for message in TRIALS[:3]:
        assert not order.left_over(message)
        order.add(message)
