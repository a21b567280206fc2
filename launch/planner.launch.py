# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Start the planner with its parameter file, and RViz if wanted.

    ros2 launch dlo_calibration planner.launch.py description:=result.xml rviz:=true
"""

from dlo_calibration.ros.launching import node_and_rviz


def generate_launch_description():
    """Describe the arguments, and what to start."""
    return node_and_rviz(
        __file__, 'planner',
        parameters={'description': 'path of a result.xml'},
        topics={'chain': "topic of the chains, e.g. a tracker's", 'goal_chain': 'topic of the goal chain'},
        shown=('markers', 'chain', 'goal_chain'))
