# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Start tracker and calibrator: a camera that is on, and a hand with a tag, give trials; and RViz if wanted.

    ros2 launch dlo_calibration tracker.launch.py image:=/camera/image_raw points:="100,200 300,210 500,190"
"""

from dlo_calibration.ros.launching import tracker_and_calibrator


def generate_launch_description():
    """Describe the arguments, and what to start."""
    return tracker_and_calibrator(__file__)
