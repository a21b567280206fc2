# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Line picture: the traced line, drawn over its photograph."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from dlo_calibration.capture.photograph import Pixels
from dlo_calibration.capture.trace import Trace
from dlo_calibration.model.chain import Floats
from dlo_calibration.writing import whole

LINE, UNSURE, POINTS = (0, 220, 255), (255, 60, 0), (255, 255, 0)  # red, green, blue
OUTLINE = (0, 0, 0)


def write_picture(path: Path, pixels: Pixels, trace: Trace, points: Floats | None = None) -> None:
    """
    Write a photograph as PNG with its line; unsure parts have another colour.

    :param points: (n, 2) [px] of the chain's points, which become dots; None: there are none.
    :raises InputError: where the file cannot be written.
    """
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    thick = max(round(trace.width / 6), 2)
    for colour, width in ((OUTLINE, thick + 2), (None, thick)):
        for begin, end, sure in zip(trace.pixels[:-1], trace.pixels[1:], trace.sure[:-1], strict=True):
            draw.line([*begin.tolist(), *end.tolist()], colour or (LINE if sure else UNSURE), width)
    for u, v in np.zeros((0, 2)) if points is None else points:
        draw.ellipse([u - thick, v - thick, u + thick, v + thick], POINTS, OUTLINE)
    with whole(path) as new, new.open('wb') as stream:
        image.save(stream, 'PNG', compress_level=1)
