# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A film is read image by image; what is no film, or a hostile one, is refused with one error."""

import os
from pathlib import Path
import struct

from films import write_film
import numpy as np
import pytest

from dlo_calibration.errors import InputError
from dlo_calibration.vision import decoder
from dlo_calibration.vision.film import read_film

SIZE, RATE = (320, 240), 25.0
COUNT = 50


def image(number):
    """Return an image that shows its number as the place of a bright bar, red above and blue below."""
    pixels = np.full((SIZE[1], SIZE[0], 3), 40, np.uint8)
    pixels[:120, 6 * number:6 * number + 12] = (250, 40, 40)
    pixels[120:, 6 * number:6 * number + 12] = (40, 40, 250)
    return pixels


def number_of(pixels):
    """Return the number that an image shows."""
    bright = pixels[20:100, :, 0].mean(axis=0) > 140
    return round((np.flatnonzero(bright).mean() - 5.5) / 6)


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp('films')


@pytest.fixture(scope='module')
def mp4(folder):
    path = folder / 'film.mp4'
    write_film(path, map(image, range(COUNT)), RATE)
    return path


@pytest.mark.parametrize(('suffix', 'code'), [
    ('mp4', 'mp4v'), ('mov', 'mp4v'), ('mkv', 'mp4v'), ('avi', 'MJPG'), ('webm', 'VP80')])
def test_every_kind_of_film_gives_its_images_and_their_times(folder, suffix, code):
    path = folder / f'kind.{suffix}'
    write_film(path, map(image, range(COUNT)), RATE, code)
    film = read_film(path)
    assert film.size == SIZE
    assert film.duration == pytest.approx(COUNT / RATE, abs=0.05)
    assert film.frame_rate == pytest.approx(RATE, rel=0.01)
    frames = list(film)
    assert [number_of(frame.pixels) for frame in frames] == list(range(COUNT))
    assert [frame.time for frame in frames] == pytest.approx(np.arange(COUNT) / RATE, abs=0.001)
    colours = frames[10].pixels[[60, 180], 66]
    assert (colours[0][0] > 200, colours[1][2] > 200) == (True, True)
    assert (colours[0][2] < 100, colours[1][0] < 100) == (True, True)


@pytest.mark.long
def test_a_film_is_read_again_from_a_time_and_backwards(mp4, monkeypatch):
    film = read_film(mp4)
    assert len(list(film)) == len(list(film)) == COUNT
    assert [number_of(frame.pixels) for frame in film.frames(0.8, 1.2)] == list(range(20, 30))
    # Pieces of seven images.
    monkeypatch.setattr('dlo_calibration.vision.film.PIECE', 7 * 3 * SIZE[0] * SIZE[1])
    assert [number_of(frame.pixels) for frame in film.backwards()] == list(range(COUNT))[::-1]
    assert [number_of(frame.pixels) for frame in film.backwards(0.42)] == list(range(11))[::-1]


def test_the_flag_of_a_telephone_turns_the_images_upright(mp4, folder):
    octets = bytearray(mp4.read_bytes())
    # ISO/IEC 14496-12: the matrix of the track's header (tkhd), fixed point: a quarter of a turn clockwise.
    place = octets.index(b'tkhd') + 4 + 40
    octets[place:place + 36] = struct.pack('>9i', 0, 1 << 16, 0, -1 << 16, 0, 0, 240 << 16, 0, 1 << 30)
    path = folder / 'turned.mp4'
    path.write_bytes(octets)
    film = read_film(path)
    assert film.size == SIZE[::-1]
    pixels = next(iter(film)).pixels
    assert pixels.shape == (SIZE[0], SIZE[1], 3)
    # What was at the left is at the top; what was above is at the right.
    assert pixels[5, 200, 0] > 200
    assert pixels[5, 40, 2] > 200


def test_times_come_from_the_file_where_the_frame_rate_varies(mp4, folder):
    octets = bytearray(mp4.read_bytes())
    # ISO/IEC 14496-12: the table of durations (stts) gets a second entry, so that the boxes around it grow;
    # the list of edits, which would end the film as early as before, becomes free space.
    octets = octets.replace(b'elst', b'free')
    place = octets.index(b'stts')
    count, duration = struct.unpack('>2i', octets[place + 12:place + 20])
    assert count == COUNT
    octets[place + 8:place + 20] = struct.pack('>5i', 2, 20, duration, COUNT - 20, 2 * duration)
    for name in (b'moov', b'trak', b'mdia', b'minf', b'stbl', b'stts'):
        begin = octets.index(name) - 4
        size, = struct.unpack('>i', octets[begin:begin + 4])
        octets[begin:begin + 4] = struct.pack('>i', size + 8)
    path = folder / 'varying.mp4'
    path.write_bytes(octets)
    film = read_film(path)
    times = np.array([frame.time for frame in film])
    expected = np.where(np.arange(COUNT) < 20, np.arange(COUNT), 2 * np.arange(COUNT) - 20) / RATE
    assert times == pytest.approx(expected, abs=0.001)
    assert film.duration == pytest.approx(80 / RATE, rel=0.05)
    frame = next(film.frames(1.5))
    assert frame.time == pytest.approx(1.52, abs=0.001)
    assert number_of(frame.pixels) == 29


@pytest.mark.parametrize(('content', 'came'), [
    (b'', 'an empty file'),
    (b'#EXTM3U\n#EXTINF:10,\n/etc/passwd\n', 'a file that is no film'),
    (b"ffconcat version 1.0\nfile '/etc/passwd'\n", 'a file that is no film'),
    (b'\xff\xd8\xff\xe0' + bytes(100), 'a photograph'),
    (b'\0\0\0\x18ftypisom' + bytes(1000), 'a film whose end is missing or that is damaged'),
    (b'\x1aE\xdf\xa3' + bytes(range(256)) * 20, 'a film whose end is missing or that is damaged'),
    (b'RIFF\xff\xff\xff\x7fAVI LIST' + bytes(1000), 'a film'),
], ids=['empty', 'playlist', 'concatenation', 'photograph', 'mp4', 'matroska', 'avi'])
def test_what_is_no_film_is_refused_in_a_sentence(tmp_path, content, came):
    path = tmp_path / 'film.mp4'
    path.write_bytes(content)
    with pytest.raises(InputError) as error:
        read_film(path)
    assert error.value.came.startswith(came)
    assert error.value.remedy


def test_a_folder_a_pipe_and_nothing_are_refused(tmp_path):
    os.mkfifo(tmp_path / 'pipe.mp4')
    for path in (tmp_path, tmp_path / 'pipe.mp4', tmp_path / 'nothing.mp4'):
        with pytest.raises(InputError):
            read_film(path)


def test_a_film_that_ends_too_early_gives_what_it_has(mp4, folder):
    whole = folder / 'whole.avi'
    write_film(whole, map(image, range(COUNT)), RATE, 'MJPG')
    path = folder / 'cut.avi'
    path.write_bytes(whole.read_bytes()[:whole.stat().st_size // 2])
    numbers = [number_of(frame.pixels) for frame in read_film(path)]
    assert numbers == list(range(len(numbers)))
    assert 10 < len(numbers) < 40


@pytest.mark.parametrize('ending', ['crash', 'hang'])
def test_a_decoder_that_crashes_or_hangs_is_one_error(mp4, monkeypatch, ending):
    film = read_film(mp4)
    program = {'crash': 'import os; os.abort()',
               'hang': 'import faulthandler, os, time; '
                       'faulthandler.dump_traceback_later(0.3, exit=True, file=open(os.devnull, "w")); '
                       'time.sleep(60)'}[ending]
    monkeypatch.setattr('dlo_calibration.vision.film.PROGRAM', program)
    with pytest.raises(InputError, match='crashes' if ending == 'crash' else 'cannot be decoded within'):
        next(iter(film))


def test_the_decoder_opens_nothing_but_the_film_and_writes_no_file():
    assert 'protocol_whitelist;file' in decoder.OPTIONS
    assert not {'hls', 'concat', 'dash', 'image2'} & set(decoder.FORMATS.split(','))


def test_the_process_ends_with_the_iteration(mp4):
    frames = iter(read_film(mp4))
    next(frames)
    children = Path(f'/proc/self/task/{os.getpid()}/children')
    before = children.read_text().split()
    frames.close()
    assert len(children.read_text().split()) == len(before) - 1
