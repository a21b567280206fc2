# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The wire: messages in and out, and the trials that they make; imports no rclpy."""
