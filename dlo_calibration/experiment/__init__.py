# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The paper's experiment: how consistent found parameters are, and how valid."""
