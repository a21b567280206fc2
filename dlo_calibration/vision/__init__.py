# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Vision: a photograph of a DLO on a table becomes points in metres.

- A photograph is read (`photograph`).  Its scale is found (`scale`, `pose`) from known points or the printed
  `board`, with the distortion of the `lens`.
- `tracer.Tracer` finds the DLO's middle line between a few clicks: `ridge` measures where the photograph
  looks like the DLO, `path` finds a rough line from click to click, and `middle_line` fits both edges and
  finds both ends in the full resolution.  `axis` and `two_views` turn the line into points in metres.
"""

__all__: list[str] = []
