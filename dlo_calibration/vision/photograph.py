# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Photograph: the upright pixels of a JPEG or PNG file, and its focal length if the camera wrote one.

An uncompressed ROS image is decoded to the same form.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
import io
import math
from pathlib import Path
import re
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL.Image import Image, new
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from dlo_calibration.errors import InputError
from dlo_calibration.reading import read_octets

Pixels = NDArray[np.uint8]

MAXIMUM_OCTETS = 64 * 2**20  # of a file; a telephone's JPEG of 50 megapixels has a third
MAXIMUM_PIXELS = 60_000_000
MAXIMUM_SCANS = 100  # of a JPEG file, up to a tenth of a second each; a progressive one has about ten
MAXIMUM_PROFILES = 100  # of a PNG file, which needs one; opening it takes a hundredth of a second for each
MAXIMUM_CHUNKS = 100_000  # of a PNG file, some microseconds each; encoders write one for 8 kB or more
MINIMUM_SIDE = 100  # px; a DLO in a smaller picture is too thin to be found
#: Diagonal of a frame of 35 mm film, 36 mm x 24 mm [mm]; 35 mm equivalents of focal lengths refer to it.
FILM_DIAGONAL = math.hypot(36.0, 24.0)
EXPECTED = 'a photograph as a JPEG or PNG file'

#: Fields of Exif 2.32 (CIPA DC-008), in the first directory and in the one of the camera's settings.
_ORIENTATION, _SETTINGS = 0x0112, 0x8769
_WIDTH, _HEIGHT, _FOCAL_LENGTH_IN_FILM = 0xA002, 0xA003, 0xA405

#: Markers of JPEG that have a length, and the end (ITU-T T.81, table B.1).
_MARKER = re.compile(rb'\xff[\x02-\xcf\xd9-\xfe]')
_SCAN, _END = b'\xff\xda', b'\xff\xd9'

_ON_A_TELEPHONE = 'set the camera to its most compatible format (JPEG), or export the photograph as JPEG'
_EXPORT = 'open it in a picture viewer and export it as JPEG'
#: Place and bytes of a signature, the kind of file, and the remedy.
_FOREIGN = (
    (8, (b'avif', b'avis'), 'an AVIF photograph', _EXPORT),
    (4, (b'ftyphei', b'ftyphev', b'ftypmif', b'ftypmsf'), 'a HEIC photograph', _ON_A_TELEPHONE),
    (4, (b'ftyp',), 'a video', 'take a photograph, or save one picture of the video as JPEG'),
    (8, (b'WEBP',), 'a WebP picture', _EXPORT),
    (0, (b'II*\0', b'MM\0*'), 'a TIFF or raw photograph', _EXPORT),
    (0, (b'GIF8',), 'a GIF picture', _EXPORT),
    (0, (b'BM',), 'a BMP picture', _EXPORT),
    (0, (b'%PDF',), 'a PDF document', _EXPORT),
)
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

JPEG_QUALITY = 90  # 0 to 100: no blocks to be seen around a thin DLO
SMALLEST_WIDTH = 16  # px, of a reduced picture


@dataclass(frozen=True, eq=False)
class Photograph:
    """
    A photograph.

    :param pixels: (h, w, 3) red, green, blue of each pixel, 0 to 255; upright, read-only.
    :param focal_length: [px], as the camera wrote it into the file; None: it did not, or the picture was cut.
    """

    pixels: Pixels
    focal_length: float | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.pixels.shape[1], self.pixels.shape[0]


def read_photograph(source: Path | bytes, thing: str) -> Photograph:
    """
    Read a photograph from a file, or from a file's content.

    :param thing: what it is called in errors, e.g. ``photograph start.jpg``.
    :raises InputError: where it cannot be read.
    """
    octets = source if isinstance(source, bytes) else read_octets(source, thing, EXPECTED, MAXIMUM_OCTETS)
    if len(octets) > MAXIMUM_OCTETS:
        raise InputError(thing, f'more than {MAXIMUM_OCTETS / 1e6:.0f} MB', EXPECTED + ' of a few MB',
                         'name a photograph as the camera wrote it')
    if octets.count(b'iCCP') > MAXIMUM_PROFILES:
        raise InputError(thing, f'a PNG file with more than {MAXIMUM_PROFILES} colour profiles', EXPECTED,
                         'export it again')
    if _has_too_many_chunks(octets):
        raise InputError(thing, f'a PNG file with more than {MAXIMUM_CHUNKS} chunks', EXPECTED,
                         'export it again')
    try:
        image = _opened(octets, thing)
        _check_size(*image.size, thing)
        if isinstance(image, JpegImageFile) and _scans(octets) > MAXIMUM_SCANS:
            raise InputError(thing, f'a JPEG file with more than {MAXIMUM_SCANS} scans', EXPECTED,
                             'export it again, or copy it from the camera again')
        image.load()
    except InputError:
        raise
    except Exception as error:  # damaged files can raise anything
        raise InputError(thing, 'a file that ends too early or is damaged', EXPECTED,
                         'copy it from the camera again') from error
    orientation, focal_length = _camera_fields(image)
    pixels = _upright(_colours(image), orientation)
    pixels.setflags(write=False)
    return Photograph(pixels, focal_length)


def _opened(octets: bytes, thing: str) -> Image:
    """Open a picture; only its header is read."""
    # Only these two readers: Pillow's many others are useless here, and can be attacked.
    for signature, reader in ((b'\xff\xd8\xff', JpegImageFile), (b'\x89PNG\r\n\x1a\n', PngImageFile)):
        if octets.startswith(signature):
            return reader(io.BytesIO(octets))
    came, remedy = next(
        ((came, remedy) for begin, signatures, came, remedy in _FOREIGN
         if octets[begin:].startswith(signatures)),
        ('a file that is no photograph' if octets else 'an empty file', 'name a JPEG or PNG file'))
    raise InputError(thing, came, EXPECTED, remedy)


def _has_too_many_chunks(octets: bytes) -> bool:
    """Tell whether a PNG file has more than `MAXIMUM_CHUNKS` chunks, which may be empty."""
    if not octets.startswith(b'\x89PNG'):
        return False
    place = 8
    for _ in range(MAXIMUM_CHUNKS):
        place += 12 + int.from_bytes(octets[place:place + 4], 'big')  # length, kind and check sum
        if place >= len(octets):
            return False
    return True


def _scans(octets: bytes) -> int:
    """
    Count the scans of a JPEG file.

    Each may have a few bytes, and takes the decoder as long as the whole picture.
    """
    scans, place = 0, 2
    marker = _MARKER.search(octets, place)
    while marker and marker[0] != _END and scans <= MAXIMUM_SCANS:
        scans += marker[0] == _SCAN
        length = int.from_bytes(octets[marker.end():marker.end() + 2], 'big')
        marker = _MARKER.search(octets, marker.end() + length)
    return scans


def _check_size(width: int, height: int, thing: str) -> None:
    came = f'{width} x {height} pixels'
    if width * height > MAXIMUM_PIXELS:
        raise InputError(thing, came, f'at most {MAXIMUM_PIXELS / 1e6:.0f} megapixels',
                         'reduce it; 12 megapixels are enough')
    if min(width, height) < MINIMUM_SIDE:
        raise InputError(thing, came, f'at least {MINIMUM_SIDE} pixels a side', 'take a larger photograph')


def _colours(image: Image) -> Pixels:
    """Return (h, w, 3) red, green, blue of a picture of any mode; transparent pixels become white."""
    if image.mode.startswith('I'):  # 16 bits of grey
        grey = np.asarray(image).astype(np.uint32, copy=False)
        return np.repeat((np.minimum(grey, 65535) >> 8).astype(np.uint8)[..., None], 3, axis=2)
    if image.mode in ('RGBA', 'LA', 'PA') or 'transparency' in image.info:
        image = image.convert('RGBA')
        ground = new('RGB', image.size, 'white')
        ground.paste(image, mask=image.getchannel('A'))
        image = ground
    return np.array(image.convert('RGB'))


def _camera_fields(image: Image) -> tuple[int, float | None]:
    """Return the orientation, 1 to 8, and the focal length [px] that the camera wrote into the file."""
    orientation, focal_length = 1, None
    with suppress(Exception):  # they can hold anything, and are no reason to refuse a photograph
        fields = image.getexif()
        orientation = int(fields.get(_ORIENTATION, 1))
        focal_length = _focal_length(fields.get_ifd(_SETTINGS), *image.size)
    return orientation, focal_length


def _focal_length(settings: dict[int, Any], width: int, height: int) -> float | None:
    """
    Return the focal length [px] of a picture from Exif's settings of the camera.

    The field FocalLengthIn35mmFilm is that of a camera for 35 mm film with the same angle of view
    over the diagonal (CIPA DCG-001).
    """
    length = float(settings.get(_FOCAL_LENGTH_IN_FILM) or 0.0)
    original = float(settings.get(_WIDTH) or width), float(settings.get(_HEIGHT) or height)
    cropped = abs(max(original) / min(original) * min(width, height) / max(width, height) - 1.0) > 0.01
    if not 8.0 <= length <= 400.0 or cropped:
        return None
    return length / FILM_DIAGONAL * math.hypot(width, height)


def _upright(pixels: Pixels, orientation: int) -> Pixels:
    """Return the pixels turned, and mirrored, as Exif's field Orientation says."""
    if orientation >= 5:  # rows and columns are exchanged
        pixels = pixels.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def decoded(thing: str, message: Any) -> Pixels:
    """
    Return the pixels of a `sensor_msgs/msg/Image`: (h, w, 3) red, green, blue, 0 to 255.

    :param thing: what it is called in errors, e.g. ``image on /camera/image_raw``.
    :raises InputError: if its encoding is another one, or its length contradicts its size.
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


def jpeg(photograph: Photograph, width: int | None = None) -> bytes:
    """
    Return a photograph as a JPEG file.

    :param width: of the picture [px]; at most that of the photograph.  None: that of the photograph.
    :raises InputError: for a width below `SMALLEST_WIDTH`.
    """
    pixels = photograph.pixels
    full_width, full_height = photograph.size
    if width is not None and width < SMALLEST_WIDTH:
        raise InputError('picture', f'a width of {width} pixels', f'at least {SMALLEST_WIDTH}',
                         'ask for a larger one')
    if width is not None and width < full_width:
        size = width, max(1, round(full_height * width / full_width))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return _encoded('.jpg', pixels, cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)


def png(pixels: Pixels) -> bytes:
    """Return pixels (h, w, 3), red, green, blue, as a PNG file."""
    return _encoded('.png', pixels, cv2.IMWRITE_PNG_COMPRESSION, 1)


def _encoded(suffix: str, pixels: Pixels, option: int, value: int) -> bytes:
    encoded, octets = cv2.imencode(suffix, cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [option, value])
    assert encoded
    return bytes(octets)
