# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Photographs: what is seen in a photograph of a DLO on a table, and where that is in metres.

`trace.Tracer` finds the middle line of the DLO between a few clicks.  `ridge` measures where the photograph
looks like the DLO, `path` finds the way between the clicks, `middle` fits both edges in the full resolution
(in the straightened `strip`), and `ends` tells where the line ends.  OpenCV is loaded only with these.
"""

__all__: list[str] = []
