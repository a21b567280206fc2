# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Start the calibrator with its parameter file, and RViz if wanted.

    ros2 launch dlo_calibration calibrator.launch.py mass:=0.03 goal_chain:=/trackdlo/results_pc rviz:=true
"""

from dlo_calibration.ros.launching import node_and_rviz


def generate_launch_description():
    """Describe the arguments, and what to start."""
    return node_and_rviz(
        __file__, 'calibrator',
        parameters={'mass': 'mass of the whole DLO [kg]', 'table_height': 'height of the table [m]'},
        topics={'goal_chain': "topic of the goal chains, e.g. a tracker's"},
        shown=('markers', 'initial_chain', 'goal_chain'))
