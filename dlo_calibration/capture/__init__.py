# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Capture: photographs of a DLO on a table become trials, on a page or from the command line.

- A photograph is read (`photograph`), and its scale found (`scale`, `pose`) from known points or the printed
  board (`board`, `board_sheet`), with the distortion of a `camera`'s lens.
- `trace.Tracer` finds the DLO's middle line between a few clicks: `ridge` measures where the photograph looks
  like the DLO, `path` finds the way between the clicks, `middle` fits both edges in the full resolution (in
  the straightened `strip`), and `ends` tells where the line ends.  `chains` and `two_views` make points in
  metres of it.
- What a person says is a `document` of `steps`, kept in the folder of a `project`; `interpretation` makes
  `readings`, `trials` and `remarks` of it, and `saving` writes them.
- `server` serves the folder `page`; behind it, `session` is all that the page can ask for.

OpenCV and aiohttp are loaded only where they are used.
"""

__all__: list[str] = []
