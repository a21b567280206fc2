# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Messages to and from the calibrator, and the trials made from them; imports no rclpy."""

from dlo_calibration.messages.codec import ActionMessage, ChainMessage, read
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.messages.encoder import trial_messages

__all__ = ['ActionMessage', 'ChainMessage', 'TrialCollector', 'read', 'trial_messages']
