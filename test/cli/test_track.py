# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `track`: from a rendered film to a session that `fit` reads."""

import json
import re
import shutil
import subprocess
import sys

import cv2
from filmed_trials import clicks, film_camera, filmed_trials, LENGTH, Move, MOVES
from films import write_film
import numpy as np
import pytest

from dlo_calibration import read_session
from dlo_calibration.cli.main import main
from dlo_calibration.files.record import encode, Record
from dlo_calibration.files.recording import write_records
from dlo_calibration.messages.codec import bag_types

KEYS = {'frames', 'tracked', 'fps', 'seconds', 'length_m', 'diameter_m', 'trials', 'lost', 'problems'}
TRIAL = {'start_s', 'end_s', 'hands', 'goals'}
HAND = {'name', 'grip_fraction', 'closes_s', 'opens_s'}
RATE, SIZE = 15.0, (1280, 720)
BLUE = (0.10, 0.24, 0.55)


def words(film, camera):
    """Return the clicks of a person as --points."""
    return ' '.join(f'{u:.0f},{v:.0f}' for u, v in clicks(film, camera))


def still(camera, count, folder):
    """Write a film of a DLO at rest, and return its path and clicks."""
    film = filmed_trials((Move(12, (0.06, 0.1), seconds=0.4),), rate=RATE)
    image = next(film.images(camera, colour=BLUE))
    path = folder / 'film.mp4'
    write_film(path, [image] * count, RATE)
    return path, words(film, camera), image


@pytest.fixture(scope='module')
def resting(tmp_path_factory):
    """Give a short film in which nothing moves, its clicks, and its image."""
    return still(film_camera(SIZE), 8, tmp_path_factory.mktemp('film'))


def tracked(capsys, *arguments):
    """Return the JSON document of the verb."""
    code = main(['track', *map(str, arguments), '--json'])
    assert code == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.long
@pytest.mark.parametrize('moves', [MOVES[:1], MOVES])
def test_a_film_becomes_a_session_with_the_trials_of_the_hand(moves, tmp_path):
    camera = film_camera(SIZE)
    film = filmed_trials(moves, rate=RATE)
    write_film(tmp_path / 'film.mp4', film.images(camera, colour=BLUE), RATE)
    done = subprocess.run(
        [sys.executable, '-m', 'dlo_calibration', 'track', str(tmp_path / 'film.mp4'), '--points',
         words(film, camera), '--board', '--output', str(tmp_path / 'out'), '--json'],
        capture_output=True, text=True, check=True)
    report = json.loads(done.stdout)
    assert set(report) >= KEYS
    assert report['frames'] == len(film.times)
    assert report['tracked'] >= 0.98 * report['frames']
    assert report['length_m'] == pytest.approx(LENGTH, rel=0.02)
    assert len(report['trials']) == len(film.holds), report['problems']
    for trial, (closes, opens, node) in zip(report['trials'], film.holds, strict=True):
        assert set(trial) >= TRIAL
        hand, = trial['hands']
        assert set(hand) >= HAND
        assert hand['name'] == 'hand_1'
        assert hand['grip_fraction'] == pytest.approx(node / 60, abs=0.05)
        assert hand['closes_s'] == pytest.approx(closes, abs=0.3)
        assert hand['opens_s'] == pytest.approx(opens, abs=0.4)
        assert trial['goals'] > 5
    trials = read_session(tmp_path / 'out' / 'session.mcap').trials
    assert [len(trial.goals) for trial in trials] == [trial['goals'] for trial in report['trials']]
    assert trials[0].goals[-1].stable
    drawing = cv2.VideoCapture(str(tmp_path / 'out' / 'tracked.mp4'))
    assert int(drawing.get(cv2.CAP_PROP_FRAME_COUNT)) == len(film.times)


@pytest.mark.long
def test_a_film_in_which_nothing_moves_is_tracked_and_makes_no_trial(resting, tmp_path, capsys):
    path, points, _ = resting
    report = tracked(capsys, path, '--points', points, '--board', '--output', tmp_path, '--at', 0.2)
    assert (report['frames'], report['tracked'], report['trials'], report['lost']) == (8, 8, [], [])
    assert report['length_m'] == pytest.approx(LENGTH, rel=0.02)
    assert (tmp_path / 'tracked.mp4').stat().st_size > 1000
    assert not (tmp_path / 'session.mcap').exists()


@pytest.mark.long
def test_images_of_a_recorded_session_are_a_film(resting, tmp_path, capsys):
    _, points, image = resting
    types, records = bag_types(), []
    for k in range(4):
        stamp = 1_700_000_000_000_000_000 + k * 66_000_000
        header = types.header(stamp, 'camera')
        if k < 2:
            kind, topic = 'sensor_msgs/msg/Image', '/camera/image_raw'
            message = types.build(kind, header=header, height=SIZE[1], width=SIZE[0], encoding='rgb8',
                                  is_bigendian=0, step=3 * SIZE[0], data=types.octets(image.tobytes()))
        else:
            kind, topic = 'sensor_msgs/msg/CompressedImage', '/camera/image_raw/compressed'
            message = types.build(kind, header=header, format='jpeg', data=types.octets(
                cv2.imencode('.jpg', image[..., ::-1])[1].tobytes()))
        records.append(Record(topic, kind, encode(message, kind), stamp))
    write_records(tmp_path / 'bag.mcap', records, None)
    for topic in ('/camera/image_raw', '/camera/image_raw/compressed'):
        report = tracked(capsys, tmp_path / 'bag.mcap', '--image', topic, '--points', points, '--board')
        assert report['frames'] == report['tracked'] == 2
    assert main(['track', str(tmp_path / 'bag.mcap'), '--image', '/other', '--points', points]) == 2
    assert '/camera/image_raw' in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.parametrize('arguments, said', [
    (['--points', '10,10 40,40', '--board'], 'clicks'), (['--board', '--at', '100'], '--at'),
    (['--board', '--held', '20,20'], '--held')])
def test_arguments_that_do_not_fit_the_film_get_one_line_with_the_remedy(resting, capsys, arguments, said):
    path, points, _ = resting
    given = arguments if '--points' in arguments else ['--points', points, *arguments]
    refused(capsys, said, 'track', path, *given)


@pytest.mark.parametrize('arguments, said', [
    (['--points', '10,10'], 'two or more'),
    (['--points', '10,10 40,40', '--board', '--held', '20'], '--held'),
    (['--points', '10,10 40,40', '--board', '--count', '2'], '--count')])
def test_bad_arguments_get_one_line_with_the_remedy(tmp_path, capsys, arguments, said):
    write_film(tmp_path / 'film.mp4', [np.zeros((120, 160, 3), dtype=np.uint8)] * 2, RATE)
    refused(capsys, said, 'track', tmp_path / 'film.mp4', *arguments)


def refused(capsys, said, *words):
    """Check that a command ends with one line that says what and the remedy."""
    assert main([*map(str, words)]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert said in line
    assert ';' in line


@pytest.mark.long
def test_bad_films_get_one_line_with_the_remedy(resting, tmp_path, capsys):
    path, points, image = resting
    dark, empty = tmp_path / 'dark.mp4', tmp_path / 'empty.mp4'
    write_film(dark, [np.zeros_like(image)] * 3, RATE)
    write_film(empty, [np.full_like(image, 128)] * 3, RATE)
    shutil.copy(__file__, tmp_path / 'text.mp4')
    for film, said in ((dark, 'board|dark'), (empty, 'board'), (tmp_path / 'text.mp4', 'no film'),
                       (tmp_path / 'missing.mp4', 'film')):
        assert main(['track', str(film), '--points', points, '--board']) == 2
        line = capsys.readouterr().err.strip().splitlines()[-1]
        assert re.search(said, line), line
        assert ';' in line
    assert main(['track', str(dark), '--points', points]) == 2
    assert 'dark' in capsys.readouterr().err
