# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A pose transforms points and quaternions as SciPy's rotations do, and its inverse reverts it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from toy_messages import toy_trials
from trial_contents import contents

from dlo_calibration import InputError
from dlo_calibration.model.pose import Pose

TURN = Rotation.from_euler('xyz', [0.3, -1.1, 2.5])
POSE = Pose([0.5, -1.0, 2.0], 3 * TURN.as_quat())  # of no unit length, as rounded ones


def test_points_vectors_and_orientations_are_those_of_scipy():
    generator = np.random.default_rng(1)
    points, other = generator.normal(size=(2, 5, 3)), Rotation.random(4, random_state=2)
    assert np.allclose(POSE.points(points), TURN.apply(points.reshape(-1, 3)).reshape(2, 5, 3) + [0.5, -1, 2])
    assert np.allclose(POSE.vectors(points[0]), TURN.apply(points[0]))
    turned = Rotation.from_quat(POSE.orientations(other.as_quat()))
    assert np.allclose(turned.as_matrix(), (TURN * other).as_matrix())
    assert np.allclose(POSE.inverse.points(POSE.points(points)), points)


def test_text_of_a_pose_reads_back_exactly():
    again = Pose.of(str(POSE))
    assert np.array_equal(again.position, POSE.position)
    assert np.allclose(again.orientation, POSE.orientation, rtol=0, atol=1e-15)


@pytest.mark.parametrize('text', [
    '', '0 0 1', '0 0 1 0 0 0', '0 0 1 0 0 0 0', 'nan 0 0 0 0 0 1', '0 0 x 0 0 0 1'])
def test_text_that_is_no_pose_is_refused(text):
    with pytest.raises(InputError, match='frame_pose.*x y z qx qy qz qw'):
        Pose.of(text)


def test_the_identity_changes_no_digit():
    trials = toy_trials(2)
    assert contents([Pose.of('0 0 0 0 0 0 1').trial(trial) for trial in trials]) == contents(trials)
