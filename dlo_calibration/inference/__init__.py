# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What a fit tells: intervals, what is identifiable, which action would tell more, what is missing."""
