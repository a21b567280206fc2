# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""One parameter set tried on all trials, here, in processes or on a cluster."""
