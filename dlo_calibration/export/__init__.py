# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrated DLO for other simulators, as the text of a file.

`rope` gathers in SI units what every format needs; one module writes each format.
"""

from dlo_calibration.export.mjcf import export_mjcf
from dlo_calibration.export.rope import ExportedRope

__all__ = ['ExportedRope', 'export_mjcf']
