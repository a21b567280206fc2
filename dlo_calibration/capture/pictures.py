# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures: photographs as JPEG files of any width, kept in memory within a bound."""

from __future__ import annotations

from collections import OrderedDict
import threading
from typing import Callable

import cv2

from dlo_calibration.capture.photograph import Photograph
from dlo_calibration.errors import InputError

QUALITY = 90  # of JPEG, 0 to 100: no blocks to be seen around a thin DLO
KEPT = 96 * 2**20  # bytes of files in memory: twenty photographs of 12 megapixels, in full
SMALLEST = 16  # px


class Pictures:
    """
    Encodes photographs, each width once as long as there is room; usable from any thread.

    :param photograph: returns a photograph by its id.
    """

    def __init__(self, photograph: Callable[[str], Photograph]) -> None:
        self._photograph = photograph
        self._kept: OrderedDict[tuple[str, int | None], bytes] = OrderedDict()
        self._lock = threading.Lock()

    def jpeg(self, identity: str, width: int | None) -> bytes:
        """
        Return a photograph as a JPEG file.

        :param width: of the picture [px]; at most that of the photograph. None: that of the photograph.
        :raises InputError: if there is no such photograph, or for a width that no picture has.
        """
        key = identity, width
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        octets = _encoded(self._photograph(identity), width)
        with self._lock:
            self._kept[key] = octets
            while sum(map(len, self._kept.values())) > KEPT and len(self._kept) > 1:
                self._kept.popitem(last=False)
        return octets


def _encoded(photograph: Photograph, width: int | None) -> bytes:
    pixels = photograph.pixels
    full_width, full_height = photograph.size
    if width is not None and width < SMALLEST:
        raise InputError('picture', f'a width of {width} pixels', f'at least {SMALLEST}',
                         'ask for a larger one')
    if width is not None and width < full_width:
        size = width, max(1, round(full_height * width / full_width))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    done, octets = cv2.imencode('.jpg', cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR),
                                [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    return bytes(octets)
