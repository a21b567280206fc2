# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Vision: a photograph or a film of a DLO on a table becomes points in metres.

- A photograph is read (`photograph`).  Its scale is found (`scale`, `pose`) from known points or the printed
  `board`, with the distortion of the `lens`.
- `tracer.Tracer` finds the DLO's middle line between a few clicks: `ridge` measures where the photograph
  looks like the DLO, `path` finds a rough line from click to click, and `middle_line` fits both edges and
  finds both ends in the full resolution.  `axis` and `two_views` turn the line into points in metres.
- A `film` is read image by image, by the `decoder` in a process of its own; `view` follows the board.
- `tracker.Tracker` follows the DLO through it.  `appearance` is what the DLO looks like.  In each
  `dlo_image`, `followed_line` finds its line near where it is expected, and `line_end` its ends;
  `elastic_line` keeps its length, with the solver `elastic`, and `lift` guesses which part of it is in the
  air.  `line_search` finds a DLO that is lost in the whole picture.
"""

__all__: list[str] = []
