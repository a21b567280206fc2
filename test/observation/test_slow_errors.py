# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Trials with errors that change slowly along the DLO and in time."""

import numpy as np
import pytest

from dlo_calibration import Action, Chain, Goal, Hand, Trial
from dlo_calibration.observation.slow_errors import with_slow_errors

POINTS = np.column_stack([np.linspace(0.0, 0.6, 21), np.zeros(21), np.full(21, 0.004)])
QUARTER = np.array([[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]])


def trial(grip=5):
    """Return a trial in which a hand turns the DLO by 90 degrees."""
    hand = Hand('hand', (grip,), [0.0, 1.0], [POINTS[grip], POINTS[grip] + (0.0, 0.1, 0.0)], QUARTER)
    return Trial('turned', Chain(POINTS), (Action((hand,)),), (Goal(Chain(POINTS), 2.0),))


def test_without_errors_there_are_no_copies():
    assert with_slow_errors([trial()], 0.0, 0.0) == []


def test_the_errors_of_a_chain_add_up_to_their_size_over_the_table():
    copies = with_slow_errors([trial()], 0.001, 0.0)
    moved = np.stack([copy.initial.points - POINTS for copy, in copies])
    assert np.square(moved).sum(axis=0).mean(axis=0) == pytest.approx([1e-6, 1e-6, 0.0], rel=0.1, abs=1e-12)
    assert all(copy.hands[0].positions.tolist() == trial().hands[0].positions.tolist() for copy, in copies)


@pytest.mark.parametrize('grip, way', [(5, 0.003), (20, -0.003)])
def test_a_hand_that_holds_another_place_has_the_path_of_that_place(grip, way):
    (copy,) = with_slow_errors([trial(grip)], 0.0, 0.003)[-1]
    hand = copy.hands[0]
    assert hand.grips[0] + hand.offset == pytest.approx(grip + way / 0.03)
    moved = hand.positions - trial(grip).hands[0].positions
    assert moved == pytest.approx(np.array([[way, 0.0, 0.0], [0.0, way, 0.0]]), abs=1e-9)


def test_a_hand_drifts_from_where_it_closes():
    drifts = with_slow_errors([trial()], 0.0, 0.003)[:-1]
    ends = [copy.hands[0].positions - trial().hands[0].positions for copy, in drifts]
    assert all((end[0] == 0.0).all() for end in ends)
    assert np.square(ends).sum(axis=0)[1] == pytest.approx([1e-6, 1e-6, 0.0])
