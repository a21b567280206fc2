# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Vision: a photograph of a DLO on a table becomes points in metres.

- A photograph is read (`photograph`).  Its scale is found (`scale`, `pose`) from known points or the printed
  `board`, with the distortion of a `camera`'s lens.
- `tracer.Tracer` finds the DLO's middle line between a few clicks: `ridge` measures where the photograph
  looks like the DLO, `path` finds the way between the clicks, and `middle_line` fits both edges and finds
  both ends in the full resolution.  `axis` and `two_views` make points in metres of it.
"""

__all__: list[str] = []
