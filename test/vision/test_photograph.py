# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Photographs are read upright and in colour from any camera; any other file is refused in one sentence."""

import io
import os
import struct
import zlib

import cv2
import numpy as np
from PIL import Image, ImageOps
import pytest

from dlo_calibration.errors import InputError
from dlo_calibration.vision.photograph import MAXIMUM_OCTETS, read_photograph

WIDTH, HEIGHT = 160, 120


def picture():
    """Return a picture with four different corners."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return Image.fromarray(np.stack([u + 40, 2 * v, 255 - u], axis=2).astype(np.uint8))


def octets(image, kind='JPEG', **options):
    stream = io.BytesIO()
    image.save(stream, kind, **({'quality': 95} if kind == 'JPEG' else {}), **options)
    return stream.getvalue()


def read(content):
    return read_photograph(content, 'photograph start.jpg')


def refusal(content):
    with pytest.raises(InputError) as caught:
        read(content)
    assert str(caught.value).startswith('photograph start.jpg: ')
    return str(caught.value)


def exif(orientation=1, film=None, original=None):
    fields = Image.Exif()
    fields[0x0112] = orientation
    settings = {}
    if film is not None:
        settings[0xA405] = film
    if original is not None:
        settings[0xA002], settings[0xA003] = original
    fields[0x8769] = settings
    return fields


@pytest.mark.parametrize('kind', ['JPEG', 'PNG'])
@pytest.mark.parametrize('orientation', range(1, 9))
def test_a_photograph_is_upright(kind, orientation):
    content = octets(picture(), kind, exif=exif(orientation))
    upright = np.asarray(ImageOps.exif_transpose(Image.open(io.BytesIO(content))))
    photograph = read(content)
    assert np.array_equal(photograph.pixels, upright)
    assert photograph.size == ((WIDTH, HEIGHT) if orientation < 5 else (HEIGHT, WIDTH))


def test_pixels_are_read_only():
    with pytest.raises(ValueError, match='read-only'):
        read(octets(picture())).pixels[0, 0] = 0


@pytest.mark.parametrize('mode', ['L', '1', 'P', 'RGBA', 'LA', 'I;16', 'CMYK'])
def test_pictures_of_any_kind_become_colours(mode):
    image = picture()
    coloured = mode in ('RGBA', 'CMYK')
    expected = np.asarray(image if coloured else image.convert('L').convert('RGB')).astype(int)
    if mode == 'I;16':
        image = Image.fromarray(np.asarray(image.convert('L')).astype(np.uint16) * 257)
    elif mode == 'P':
        image = image.convert('L').convert('P')
    elif mode == '1':
        image = image.convert('L').point(lambda value: 255 * (value > 127), '1')
        expected = np.asarray(image.convert('RGB')).astype(int)
    else:
        image = image.convert(mode)
    pixels = read(octets(image, 'JPEG' if mode == 'CMYK' else 'PNG')).pixels
    assert pixels.dtype == np.uint8
    assert np.abs(pixels - expected).max() <= (20 if mode == 'CMYK' else 1)


def test_a_png_with_16_bits_a_channel_becomes_8():
    image = np.asarray(picture())
    content = cv2.imencode('.png', image[..., ::-1].astype(np.uint16) * 257)[1].tobytes()
    assert np.array_equal(read(content).pixels, image)


def test_transparent_pixels_become_white():
    image = picture().convert('RGBA')
    image.putalpha(Image.new('L', image.size, 0))
    assert (read(octets(image, 'PNG')).pixels == 255).all()


def test_of_several_pictures_in_a_file_the_first_is_read():
    """Telephones write a JPEG with a second picture of the same scene (MPO)."""
    other = Image.new('RGB', (WIDTH, HEIGHT))
    pixels = read(octets(picture(), 'MPO', save_all=True, append_images=[other])).pixels
    assert np.abs(pixels - np.asarray(picture()).astype(int)).mean() < 3


@pytest.mark.parametrize('orientation', [1, 6])
def test_the_focal_length_is_read_from_the_file(orientation):
    """26 mm of 35 mm film: the diagonal of 43.27 mm is seen under the same angle."""
    content = octets(picture(), exif=exif(orientation, 26, (WIDTH, HEIGHT)))
    assert read(content).focal_length == pytest.approx(26 / 43.2666 * 200.0, rel=1e-4)


@pytest.mark.parametrize('film, original', [(None, None), (0, None), (26, (160, 90)), (3000, None)])
def test_an_absent_or_wrong_focal_length_is_unknown(film, original):
    assert read(octets(picture(), exif=exif(1, film, original))).focal_length is None


@pytest.mark.parametrize('fields', [b'Exif\0\0', b'Exif\0\0II*\0\xff\xff\xff\xff', b'Exif\0\0' + bytes(100)])
def test_damaged_fields_are_no_reason_to_refuse_a_photograph(fields):
    photograph = read(octets(picture(), exif=fields))
    assert (photograph.size, photograph.focal_length) == ((WIDTH, HEIGHT), None)


@pytest.mark.parametrize('content, words', [
    (b'', 'an empty file'),
    (b'u v x y\n10 20 0.1 0.2\n', 'no photograph'),
    (b'\0\0\0\x1cftypheic\0\0\0\0mif1heic', 'most compatible format'),
    (b'\0\0\0\x1cftypmif1\0\0\0\0mif1heic', 'most compatible format'),
    (b'\0\0\0\x20ftypavif\0\0\0\0avifmif1', 'AVIF'),
    (b'\0\0\0\x20ftypisom\0\0\0\0isommp42', 'video'),
    (b'RIFF\x24\0\0\0WEBPVP8 ', 'WebP'),
    (b'II*\0\x08\0\0\0', 'TIFF or raw'),
    (b'GIF89a\x01\0\x01\0', 'GIF'),
    (b'%PDF-1.4\n', 'PDF'),
    (b'\xff\xd8\xff', 'ends too early'),
    (b'\x89PNG\r\n\x1a\n', 'ends too early'),
])
def test_a_file_that_is_no_photograph_is_refused_in_one_sentence(content, words):
    message = refusal(content)
    assert words in message
    assert 'JPEG' in message


@pytest.mark.parametrize('kind', ['JPEG', 'PNG'])
@pytest.mark.parametrize('part', [0.1, 0.5, 0.8])
def test_a_truncated_photograph_is_refused(kind, part):
    content = octets(picture(), kind)
    assert 'ends too early or is damaged' in refusal(content[:int(part * len(content))])


def test_a_damaged_photograph_is_read_or_refused():
    generator = np.random.default_rng(1)
    outcomes = {True: 0, False: 0}
    for kind in ('JPEG', 'PNG'):
        good = octets(picture(), kind, exif=exif(6, 26))
        for _ in range(150):
            content = bytearray(good)
            for place in generator.integers(0, len(good), 3):
                content[place] = generator.integers(256)
            try:
                pixels = read(bytes(content)).pixels
            except InputError:
                outcomes[False] += 1
            else:
                assert pixels.shape[2:] == (3,)
                outcomes[True] += 1
    assert min(outcomes.values()) > 20


def header(width, height):
    """Return a PNG file with nearly no data, so that decoding it would fail."""
    fields = b'IHDR' + struct.pack('>IIBBBBB', width, height, 8, 2, 0, 0, 0)
    data = b'IDAT' + zlib.compress(b'\0')
    chunks = [struct.pack('>I', len(chunk) - 4) + chunk + struct.pack('>I', zlib.crc32(chunk))
              for chunk in (fields, data)]
    return b'\x89PNG\r\n\x1a\n' + b''.join(chunks)


@pytest.mark.parametrize('width, height', [(20000, 10000), (2**31 - 1, 2**31 - 1), (10000, 6001)])
def test_a_photograph_with_too_many_pixels_is_refused_before_it_is_decoded(width, height, recwarn):
    message = refusal(header(width, height))
    assert f'{width} x {height} pixels' in message
    assert '60 megapixels' in message
    assert not recwarn.list


def test_a_photograph_with_too_few_pixels_is_refused():
    assert '160 x 99 pixels' in refusal(octets(picture().crop((0, 0, 160, 99))))


def test_a_file_that_is_too_large_is_refused(tmp_path):
    path = tmp_path / 'start.jpg'
    with path.open('wb') as stream:
        stream.truncate(MAXIMUM_OCTETS + 10)  # takes no place on the disk
    assert 'more than 67 MB' in refusal(path)


def test_a_photograph_is_read_from_a_path(tmp_path):
    path = tmp_path / 'start.jpg'
    path.write_bytes(octets(picture()))
    assert np.array_equal(read(path).pixels, read(path.read_bytes()).pixels)


@pytest.mark.parametrize('make, words', [
    (lambda path: None, 'No such file'),
    (lambda path: path.mkdir(), 'a folder'),
    (os.mkfifo, 'a FIFO'),
])
def test_a_path_without_a_file_is_refused(make, words, tmp_path):
    make(tmp_path / 'start.jpg')
    assert words in refusal(tmp_path / 'start.jpg')


def test_a_jpeg_file_of_very_many_scans_is_refused_before_it_is_decoded():
    content = octets(picture(), progressive=True)
    last = content[content.rindex(b'\xff\xda'):-2]
    assert 'more than 100 scans' in refusal(content[:-2] + last * 10**5 + content[-2:])
    hidden = b'\xff\xfe\0\4\xff\xd9'  # a comment that looks like the end of the file
    assert 'more than 100 scans' in refusal(content[:-2] + hidden + last * 10**5 + content[-2:])
    assert read(content[:-2] + last * 50 + content[-2:]).size == (WIDTH, HEIGHT)
    assert read(content + last * 10**5).size == (WIDTH, HEIGHT)  # what comes after the picture is not decoded


def test_a_png_file_of_very_many_colour_profiles_is_refused_before_they_are_unpacked():
    content = octets(picture(), 'PNG')
    packed = b'iCCPa\0\0' + zlib.compress(bytes(10**6 - 10), 9)
    profile = struct.pack('>I', len(packed) - 4) + packed + struct.pack('>I', zlib.crc32(packed))
    after_head = content[:33], content[33:]
    assert 'colour profiles' in refusal(profile.join([after_head[0], *[b''] * 5000, after_head[1]]))
    assert read(profile.join(after_head)).size == (WIDTH, HEIGHT)


@pytest.mark.parametrize('kind', [b'IDAT', b'abCd'])
def test_a_png_file_of_very_many_empty_chunks_is_refused_before_they_are_visited(kind):
    content = octets(picture(), 'PNG')
    empty = struct.pack('>I', 0) + kind + struct.pack('>I', zlib.crc32(kind))
    assert 'chunks' in refusal(content[:33] + 5_000_000 * empty + content[33:])
