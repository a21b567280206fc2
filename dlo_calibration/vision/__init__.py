# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Vision: a photograph or a film of a DLO on a table becomes points in metres.

- A photograph is read (`photograph`).  Its scale is found (`scale`, `pose`) from known points or the printed
  `board`, with the distortion of the `lens`.
- `tracer.Tracer` finds the DLO's middle line between a few clicks: `ridge` measures where the photograph
  looks like the DLO, `path` finds a rough line from click to click, and `middle_line` fits both edges and
  finds both ends in the full resolution.  `axis` and `two_views` turn the line into points in metres.
- A `film` is read image by image, by the `decoder` in a process of its own.  `tracker.Tracker` follows the
  DLO through it with an `elastic` line; `view` follows the board.
"""

__all__: list[str] = []
