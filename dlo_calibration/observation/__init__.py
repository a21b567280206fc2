# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What chains alone say: their noise, what lies and hangs in them, and first guesses of parameters."""
