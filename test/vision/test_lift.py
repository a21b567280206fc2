# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What a hand lifts follows from what moved, what is hidden, and what is behind the ends."""

import numpy as np
import pytest

from dlo_calibration.vision.lift import Lift

LINE = np.column_stack([np.linspace(0.0, 300.0, 61), np.zeros(61)])
SHOWN = np.ones(61, bool)
LEAST = 1.0  # px
APART = 50.0  # half widths between both ends


def hidden(centre, reach=3):
    """Return which points are seen beside a hand."""
    return np.abs(np.arange(61) - centre) > reach


def bent(points, ways):
    """Return the line after some of its points moved across it [px]."""
    return LINE + np.column_stack([np.zeros(61), np.interp(np.arange(61), points, ways)])


def test_a_hand_that_hides_what_moves_farthest_raises_it():
    now = bent([0, 20, 40, 60], [0.0, 8.0, 0.0, 0.0])
    lift = Lift.of(LINE, np.zeros(2)).seen(now, now[[0, -1]], hidden(20), LEAST)
    assert lift.raises
    assert lift.centre == pytest.approx(20)
    share = lift.share(60)
    assert np.argmax(share) in (19, 20)
    assert share[-1] == 0.0


def test_a_hand_that_only_passes_raises_nothing():
    now = bent([0, 40, 60], [0.0, 0.0, 8.0])
    lift = Lift.of(LINE, np.zeros(2)).seen(now, now[[0, -1]], hidden(20), LEAST)
    assert not lift.raises


def test_what_was_raised_stays_so_while_it_comes_back():
    now = bent([0, 20, 40, 60], [0.0, 8.0, 0.0, 0.0])
    lift = Lift.of(LINE, np.zeros(2)).seen(now, now[[0, -1]], hidden(20), LEAST)
    back = bent([0, 20, 40, 60], [0.0, 0.0, 0.0, 0.0])
    for way in (10.0, 20.0):
        ends = LINE[[0, -1]] + [[way, 0.0], [0.0, 0.0]]
        assert lift.seen(back, ends, hidden(20), LEAST).raises
    assert not lift.seen(back, LINE[[0, -1]] + [[40.0, 0.0], [0.0, 0.0]], hidden(20), LEAST).raises


def test_both_ends_slide_towards_a_hand_that_lifts_straight_up():
    ends = LINE[[0, -1]] + [[6.0, 0.0], [-5.0, 0.0]]
    assert Lift.of(LINE, np.zeros(2)).seen(LINE, ends, hidden(30), LEAST).raises


def test_a_hand_behind_an_end_holds_that_end():
    ends = LINE[[0, -1]] + [[6.0, 0.0], [-5.0, 0.0]]
    lift = Lift.of(LINE, np.zeros(2))
    for _ in range(5):
        lift = lift.behind([30.0, 2.0], APART)
    assert lift.held == 0
    assert not lift.seen(LINE, ends, hidden(30), LEAST).raises
    # An end that is not seen changes nothing; one image alone does not, either.
    assert lift.behind([None, None], np.inf).held == 0
    assert lift.behind([2.0, 2.0], APART).held == 0
    # A part of the DLO that it bends over itself hides the hand, and looks like an end.
    for _ in range(10):
        lift = lift.behind([2.0, 1.0], APART)
    assert (lift.held, lift.shows_hand) == (0, False)
    assert not lift.seen(LINE, ends, hidden(30), LEAST).raises
    # The DLO lies on the table again; the hand comes to the other end.
    lift = Lift.of(LINE, lift.strange)
    assert lift.held is None
    for _ in range(5):
        lift = lift.behind([2.0, 30.0], APART)
    assert lift.held == 1


def test_a_hand_that_brings_one_end_to_the_other_hides_that_one_until_there_is_nothing_behind_it():
    lift = Lift.of(LINE, np.zeros(2))
    # Two ends that lie side by side, and no hand.
    assert lift.behind([1.0, 2.0], 2.5).hides is None
    for _ in range(5):
        lift = lift.behind([1.0, 30.0], APART)
    assert (lift.held, lift.hides) == (1, None)
    # Where the hand has both, it may hide itself.
    for strange in ([30.0, 30.0], [2.0, 2.0], [None, 1.0]):
        lift = lift.behind(strange, 1.5)
        assert (lift.held, lift.hides) == (1, 0)
    # It lets go of its end, and is still over the other one; then it goes.
    lift = lift.behind([30.0, 1.0], APART)
    assert lift.hides == 0
    assert lift.behind([None, 1.0], np.inf).hides == 0
    assert lift.behind([1.0, 1.0], APART).hides is None


def test_nothing_moved_and_nothing_is_raised():
    assert not Lift.of(LINE, np.zeros(2)).seen(LINE + 0.3, LINE[[0, -1]] + 0.2, SHOWN, LEAST).raises
