# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""From trials to a parameter set: options, engines, the pipeline, its result, and the thread that runs it."""
