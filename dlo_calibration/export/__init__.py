# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrated DLO for other simulators, as the text of a file.

`rope` gathers in SI units what every format needs; one module writes each format.
"""

from dlo_calibration.export.mjcf import export_mjcf
from dlo_calibration.export.rope import ExportedRope
from dlo_calibration.export.sdf import export_sdf, sdf_meshes
from dlo_calibration.export.usd import export_usd

__all__ = ['ExportedRope', 'export_mjcf', 'export_sdf', 'export_usd', 'sdf_meshes']
