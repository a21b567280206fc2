# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Raw images: the pixels of an uncompressed image, in the encodings of ROS."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dlo_calibration.errors import InputError

Pixels = NDArray[np.uint8]

MAXIMUM_PIXELS = 60_000_000
#: Encoding (sensor_msgs/image_encodings.hpp) -> octets of a pixel, and OpenCV's conversion to RGB.
ENCODINGS: dict[str, tuple[int, int | None]] = {
    'rgb8': (3, None), '8UC3': (3, cv2.COLOR_BGR2RGB), 'bgr8': (3, cv2.COLOR_BGR2RGB),
    'rgba8': (4, cv2.COLOR_RGBA2RGB), 'bgra8': (4, cv2.COLOR_BGRA2RGB), '8UC4': (4, cv2.COLOR_BGRA2RGB),
    'mono8': (1, cv2.COLOR_GRAY2RGB), '8UC1': (1, cv2.COLOR_GRAY2RGB),
    'mono16': (2, cv2.COLOR_GRAY2RGB), '16UC1': (2, cv2.COLOR_GRAY2RGB),
    # OpenCV names a pattern by the second row's second and third pixel, ROS by the first two rows.
    'bayer_rggb8': (1, cv2.COLOR_BayerBG2RGB), 'bayer_bggr8': (1, cv2.COLOR_BayerRG2RGB),
    'bayer_gbrg8': (1, cv2.COLOR_BayerGR2RGB), 'bayer_grbg8': (1, cv2.COLOR_BayerGB2RGB),
    'yuv422': (2, cv2.COLOR_YUV2RGB_UYVY), 'uyvy': (2, cv2.COLOR_YUV2RGB_UYVY),
    'yuv422_yuy2': (2, cv2.COLOR_YUV2RGB_YUY2), 'yuyv': (2, cv2.COLOR_YUV2RGB_YUY2),
}
SIXTEEN_BITS = ('mono16', '16UC1')


def decoded(thing: str, message: Any) -> Pixels:
    """
    Return the pixels of a `sensor_msgs/msg/Image`: (h, w, 3) red, green, blue, 0 to 255.

    :param thing: what it is called in errors, e.g. ``image on /camera/image_raw``.
    :raises InputError: if it has another encoding, or is not as long as it says.
    """
    if message.encoding not in ENCODINGS:
        raise InputError(thing, f'encoding {message.encoding!r}',
                         'rgb8, bgr8, mono8, a bayer pattern or yuv422',
                         'choose another topic, e.g. one of compressed images')
    width, height, step = int(message.width), int(message.height), int(message.step)
    size, conversion = ENCODINGS[message.encoding]
    octets = np.frombuffer(message.data, np.uint8)
    if not 0 < width * height <= MAXIMUM_PIXELS or step < width * size or len(octets) < step * height:
        raise InputError(thing, f'{width} x {height} pixels in {len(octets)} octets, {step} a row',
                         f'at most {MAXIMUM_PIXELS / 1e6:.0f} megapixels, and all rows',
                         'check the driver of the camera')
    rows = octets[:step * height].reshape(height, step)[:, :width * size]
    if message.encoding in SIXTEEN_BITS:
        # A depth or 16-bit camera rarely uses all of its range.
        values = rows.copy().view('>u2' if message.is_bigendian else '<u2').astype(np.float64)
        rows, size = np.rint(values * (255.0 / max(values.max(), 1.0))).astype(np.uint8), 1
    shaped = np.ascontiguousarray(rows).reshape((height, width) if size == 1 else (height, width, size))
    pixels = shaped if conversion is None else cv2.cvtColor(shaped, conversion)
    return np.ascontiguousarray(pixels, dtype=np.uint8)
