# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Kernels as Python calls them: what they take."""

import os
import subprocess
import sys

import numpy as np
import pytest

from dlo_calibration.simulation.compilation import entry
from dlo_calibration.simulation.entries import start_distances
from dlo_calibration.simulation.machine_code import Packed
from dlo_calibration.simulation.rod import _no_friction
from dlo_calibration.simulation.rope import self_contact
from dlo_calibration.simulation.states import Move

CONTACT = self_contact(np.full(10, 0.02), 0.004, 0.5)
POINTS = np.stack([np.linspace(0, 0.2, 11), np.zeros(11), np.zeros(11)], axis=1)


@pytest.mark.parametrize('points', [
    POINTS.astype(np.float32), POINTS[:, :2].T.copy().T, POINTS[0], np.repeat(POINTS, 2, axis=0)[::2]],
    ids=['numbers of 32 bits', 'columns in memory', 'one axis', 'with gaps'])
def test_an_array_that_a_kernel_would_misread_is_refused(points):
    with pytest.raises(TypeError, match='points is an array of float.* a kernel takes one of float64 with 2'):
        start_distances(CONTACT, points)


def test_an_array_of_others_that_may_not_be_written_is_refused():
    points = POINTS.copy()
    points.flags.writeable = False
    with pytest.raises(TypeError, match='not read-only'):
        start_distances(CONTACT, points)


def test_a_field_of_a_state_is_named():
    with pytest.raises(TypeError, match='room is an array of int64 with 1 axes'):
        Packed(CONTACT._replace(room=np.zeros(3, int)))


def test_a_kernel_takes_as_many_values_as_it_declares():
    with pytest.raises(ValueError, match='longer'):
        start_distances(CONTACT)


def test_a_state_that_was_packed_before_gives_the_same():
    overlapping = POINTS * (0.1, 1, 1)
    found = []
    for given in (CONTACT, Packed(CONTACT)):
        CONTACT.distances[:] = 0
        start_distances(given, overlapping)
        found.append(CONTACT.distances.copy())
    assert np.array_equal(*found) and 0 < found[0].min() < CONTACT.diameter


def test_fields_of_a_packed_state_can_be_set():
    wider = CONTACT._replace(diameter=0.1, next_one=3, room=np.zeros(3))
    contact = Packed(CONTACT)
    contact.set(diameter=0.1, next_one=3, room=wider.room)
    assert contact.words == Packed(wider).words
    assert contact.state.diameter == 0.1
    with pytest.raises(TypeError, match='room is an array of int64'):
        contact.set(room=np.zeros(3, int))
    assert contact.words == Packed(wider).words


def test_a_packed_state_within_another_can_be_set():
    contact, nothing, cube = Packed(CONTACT), np.zeros((0, 3)), np.zeros((0, 0, 0))
    move = Packed(Move(cube, cube, cube, 3, np.zeros(0, int), cube, 0.0, np.zeros(4, int), np.zeros(0, int),
                       nothing, np.ones(11), contact))
    contact.set(diameter=0.1)
    move.set(contact=contact)
    assert move.words == Packed(move.state._replace(contact=contact.state)).words


def test_a_kernel_must_be_defined_as_it_is_declared():
    def start(contact, points):
        """Forget the types."""

    with pytest.raises(TypeError, match='start_distances is declared with'):
        entry(start_distances)(start)


def test_another_state_is_refused():
    with pytest.raises(TypeError, match='contact is of Packed; a kernel takes .*SelfContact'):
        start_distances(Packed(_no_friction()), POINTS)
    with pytest.raises(TypeError, match='points is of list'):
        start_distances(CONTACT, POINTS.tolist())


def test_kernels_and_functions_that_numba_compiled_work_in_one_process():
    """Numba's functions raise; those that kernels would call for that do not."""
    program = """
if {first}:
    import numba
from test_machine_code import CONTACT, POINTS, start_distances
start_distances(CONTACT, POINTS)
import numba

@numba.njit
def refuse(number):
    if number > 1:
        raise ValueError('too large')
    return number

try:
    refuse(2)
except ValueError as error:
    print(error)
"""
    for first in (True, False):
        done = subprocess.run(
            [sys.executable, '-c', program.format(first=first)], capture_output=True, text=True, check=False,
            env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)})
        assert (done.returncode, done.stdout) == (0, 'too large\n'), done.stderr
