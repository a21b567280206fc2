# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The balance of moments of hanging parts."""

import numpy as np
import pytest
from rods_at_rest import hung, LENGTH, observed

from dlo_calibration.observation.estimate import balance, hanging_parts, Part

MASS = 0.03
WEIGHT = MASS * 9.81 / LENGTH
MILLIMETRE = 1e-3
CLAMP = {0: (0, 0, 1), 1: (0.01, 0, 1)}  # at the left, horizontal


def load_of(points, part, noise=MILLIMETRE):
    return balance(points, np.linspace(0, LENGTH, len(points)), part, noise)


@pytest.mark.parametrize('bending', [1e-3, 1e-2, 1e-1])
def test_stiffness_of_a_cantilever(bending):
    load = load_of(observed(hung(bending, CLAMP), 31), Part(1, 30, ('unknown', 'free')))
    assert WEIGHT / load.load == pytest.approx(bending, rel=0.05)
    assert load.error < 0.3 * MILLIMETRE


@pytest.mark.parametrize('bending', [1e-4, 1e-3])
@pytest.mark.parametrize('ends', [('pin', 'pin'), ('unknown', 'unknown')])
def test_stiffness_of_a_loop_between_two_pins(bending, ends):
    shape = hung(bending, {0: (0, 0, 1), 60: (0.3, 0.1, 1.05)})
    load = load_of(observed(shape, 31), Part(0, 30, ends))
    assert WEIGHT / load.load == pytest.approx(bending, rel=0.1)


def test_a_hand_in_the_middle_is_a_force_of_its_own():
    shape = hung(1e-3, {0: (0.1, 0, 1), 30: (0.3, 0, 1.1), 60: (0.5, 0, 1)})
    load = load_of(observed(shape, 31), Part(0, 30, ('pin', 'pin'), (15,)))
    assert WEIGHT / load.load == pytest.approx(1e-3, rel=0.1)


def test_stretch_of_a_hanging_dlo():
    shape = hung(1e-4, {0: (0, 0, 1)}, stretching=5.0)
    load = load_of(observed(shape, 31), Part(0, 30, ('pin', 'free')))
    assert WEIGHT / load.stretch == pytest.approx(5.0, rel=0.1)


def test_std_is_how_far_noise_moves_the_result():
    shape = hung(1e-3, {0: (0, 0, 1), 60: (0.4, 0, 1)})
    part = Part(0, 20, ('pin', 'pin'))
    results = [load_of(observed(shape, 21, MILLIMETRE, seed), part) for seed in range(40)]
    loads = np.array([result.load for result in results])
    assert np.mean([result.std for result in results]) == pytest.approx(loads.std(), rel=0.4)
    assert np.abs(loads - WEIGHT / 1e-3).max() < 5 * loads.std()


def test_order_and_frame_do_not_matter():
    points = observed(hung(1e-3, CLAMP), 31)
    part = Part(1, 30, ('unknown', 'free'))
    load = load_of(points, part)
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    assert load_of(points @ turn + 7, part).load == pytest.approx(load.load, rel=1e-3)
    assert load_of(points[::-1], Part(0, 29, ('free', 'unknown'))).load == pytest.approx(load.load, rel=1e-3)


def test_too_few_points_give_no_estimate():
    assert load_of(np.eye(3), Part(0, 2, ('unknown', 'unknown'))) is None


def parts(height, level, clamps=(), pins=(), touching=()):
    points = np.stack([np.arange(len(height)) * 0.1, 0 * np.array(height), height], axis=1)
    return list(hanging_parts(points, level, 0.005, clamps, pins, touching))


def test_a_hanging_part_ends_at_the_table():
    assert parts([0, 0, .1, .2, .1, 0, 0], 0.0, pins=[3]) == [Part(2, 4, ('unknown', 'unknown'), (3,))]
    assert parts([0, 0, .1, .2, .3], 0.0, pins=[4]) == [Part(2, 4, ('unknown', 'pin'))]


def test_a_clamp_ends_a_part_and_belongs_to_it():
    assert parts([1, 1, 1, 1, 1], None, clamps=[0, 1]) == [Part(1, 4, ('unknown', 'free'))]


def test_parts_that_nothing_holds_or_that_touch_something_are_left_out():
    assert parts([1, 1, 1, 1, 1], None) == []
    assert parts([1, 1, 1, 1, 1], None, pins=[0], touching=[3]) == []
