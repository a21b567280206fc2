# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Photograph: the pixels of a JPEG or PNG file, upright, and what the camera wrote about its lens."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL.Image import Image, new
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from dlo_calibration.errors import InputError
from dlo_calibration.files.intake import require_file

Pixels = NDArray[np.uint8]

MAXIMUM_OCTETS = 64 * 2**20  # of a file; a telephone's JPEG of 50 megapixels has a third
MAXIMUM_PIXELS = 60_000_000
MINIMUM_SIDE = 100  # px; a DLO in a smaller picture is too thin to be found
#: Diagonal of a frame of 35 mm film, 36 mm x 24 mm [mm]; 35 mm equivalents of focal lengths refer to it.
FILM_DIAGONAL = math.hypot(36.0, 24.0)
EXPECTED = 'a photograph as a JPEG or PNG file'

#: Fields of Exif 2.32 (CIPA DC-008), in the first directory and in the one of the camera's settings.
_ORIENTATION, _SETTINGS = 0x0112, 0x8769
_WIDTH, _HEIGHT, _FOCAL_LENGTH_IN_FILM = 0xA002, 0xA003, 0xA405

_ON_A_TELEPHONE = 'set the camera to its most compatible format (JPEG), or export the photograph as JPEG'
_EXPORT = 'open it in a picture viewer and export it as JPEG'
#: Place and bytes of a signature -> what the file is, and what to do.
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
    octets = source if isinstance(source, bytes) else _content(source, thing)
    if len(octets) > MAXIMUM_OCTETS:
        raise InputError(thing, f'more than {MAXIMUM_OCTETS / 1e6:.0f} MB', EXPECTED + ' of a few MB',
                         'name a photograph as the camera wrote it')
    image = _opened(octets, thing)
    _check_size(*image.size, thing)
    try:
        image.load()
    except Exception as error:  # damaged files can raise anything
        raise InputError(thing, 'a file that ends too early or is damaged', EXPECTED,
                         'copy it from the camera again') from error
    orientation, focal_length = _camera_fields(image)
    pixels = _upright(_colours(image), orientation)
    pixels.setflags(write=False)
    return Photograph(pixels, focal_length)


def _content(path: Path, thing: str) -> bytes:
    try:
        require_file(path, thing, EXPECTED)
        with path.open('rb') as stream:
            return stream.read(MAXIMUM_OCTETS + 1)
    except (OSError, ValueError) as error:
        raise InputError(thing, getattr(error, 'strerror', None) or str(error), EXPECTED,
                         'check the path') from error


def _opened(octets: bytes, thing: str) -> Image:
    """Return the picture of which only the head was read."""
    # These two readers alone: the many others of Pillow are no use here, and more to attack.
    for signature, reader in ((b'\xff\xd8\xff', JpegImageFile), (b'\x89PNG\r\n\x1a\n', PngImageFile)):
        if octets.startswith(signature):
            try:
                image = reader(io.BytesIO(octets))
            except Exception as error:  # damaged files can raise anything
                raise InputError(thing, 'a file that ends too early or is damaged', EXPECTED,
                                 'copy it from the camera again') from error
            return image
    came, remedy = next(
        ((came, remedy) for begin, signatures, came, remedy in _FOREIGN
         if octets[begin:].startswith(signatures)),
        ('a file that is no photograph' if octets else 'an empty file', 'name a JPEG or PNG file'))
    raise InputError(thing, came, EXPECTED, remedy)


def _check_size(width: int, height: int, thing: str) -> None:
    came = f'{width} x {height} pixels'
    if width * height > MAXIMUM_PIXELS:
        raise InputError(thing, came, f'at most {MAXIMUM_PIXELS / 1e6:.0f} megapixels',
                         'reduce it; 12 megapixels are enough')
    if min(width, height) < MINIMUM_SIDE:
        raise InputError(thing, came, f'at least {MINIMUM_SIDE} pixels a side', 'take a larger photograph')


def _colours(image: Image) -> Pixels:
    """Return (h, w, 3) red, green, blue of a picture of any kind; what is transparent becomes white."""
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
    Return the focal length [px] of a picture, from what is written in Exif's settings of the camera.

    The field FocalLengthIn35mmFilm is that of a camera for 35 mm film with the same angle of view
    over the diagonal (CIPA DCG-001).
    """
    length = float(settings.get(_FOCAL_LENGTH_IN_FILM) or 0.0)
    taken = float(settings.get(_WIDTH) or width), float(settings.get(_HEIGHT) or height)
    cut = abs(max(taken) / min(taken) * min(width, height) / max(width, height) - 1.0) > 0.01
    if not 8.0 <= length <= 400.0 or cut:  # another picture was taken then
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
