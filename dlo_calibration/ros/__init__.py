# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The nodes `calibrator` and `planner`, and the graph of the capture page: only they import rclpy."""
