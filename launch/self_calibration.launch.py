# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Start tracker and calibrator for a robot that asks its own questions, and RViz if wanted.

    ros2 launch dlo_calibration self_calibration.launch.py wanted:="flexibility 2, friction 3" height:=0.1

Its other arguments are those of tracker.launch.py, and the limits of the hands.  The robot does what comes on
/calibrator/advice; the tracker tells what hands and DLO did.
"""

from dlo_calibration.ros.launching import tracker_and_calibrator


def generate_launch_description():
    """Describe the arguments, and what to start."""
    return tracker_and_calibrator(__file__, {
        'wanted': "half widths of 90 % intervals, e.g. 'flexibility 2, friction 3'",
        'hands': 'number of hands', 'reach_1': 'where hand_1 can be', 'reach_2': 'where hand_2 can be',
        'height': 'lift of an action [m]', 'speed': 'of the hands [m/s]',
        'resume': 'folder of a session that was interrupted, even by a crash'})
