# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""One photograph of a loop that hangs between two clamps gives its bending stiffness."""

import json

from hung_loops import BENDING, GAP, LENGTH, loop, MASS, picture, pixels, RADIUS, view
import numpy as np
from PIL import Image
import pytest

from dlo_calibration import calibrate, Options, read_session
from dlo_calibration.cli.main import main
from dlo_calibration.files.chain_file import read_chain_file


def words(pairs):
    return ' '.join(f'{u:.2f},{v:.2f}' for u, v in pairs)


def clicked(camera, off=0.0, seed=0):
    """Return four clicks along the loop, the middle ones `off` pixels beside it."""
    shape, _ = loop()
    clicks = pixels(camera, shape[[0, 100, 200, -1]])
    angles = np.random.default_rng(seed).uniform(0, 2 * np.pi, 2)
    clicks[1:3] += off * np.column_stack([np.cos(angles), np.sin(angles)])
    return words(clicks)


def in_clamps(camera):
    shape, ends = loop()
    return words(pixels(camera, ends + 4 * (ends - shape[[0, -1]])))


def traced(folder, camera, *flags, off=0.0):
    """Trace a rendered photograph; return the trials of the session that it gives, and its options."""
    Image.fromarray(picture(camera)).save(folder / 'loop.png', compress_level=1)
    assert main(['trace', str(folder / 'loop.png'), '--points', clicked(camera, off), '--hanging', *flags,
                 '--mass', str(MASS), '--output', str(folder / 'loop.mcap')]) == 0
    session = read_session(folder / 'loop.mcap')
    return session.trials, session.options


def fitted(trials, options):
    result = calibrate(trials, Options.of({**options.flat(), 'calibrate': ('flexibility',)}))
    return result.parameters['flexibility']


def known_points(camera):
    places = np.array([(-0.25, -0.25), (0.25, -0.25), (0.25, 0.25), (-0.25, 0.25), (0.0, 0.3)])
    flat = camera.project(np.column_stack([places, np.zeros(5)]))
    return ' '.join(f'{u:.3f},{v:.3f}={x:g},{y:g}' for (u, v), (x, y) in zip(flat, places, strict=True))


def traced_by(folder, scale):
    """Trace a photograph with one kind of scale, and clicks inside the clamps."""
    camera = view(tilt=0.3, distance=1.3) if scale == 'points' else view()
    flags = {'length': ('--length', str(LENGTH)), 'gap': ('--gap', str(GAP)),
             'points': (str(RADIUS), '--scale', known_points(camera))}[scale]
    return traced(folder, camera, *flags, '--clamps', in_clamps(camera), off=10.0)


@pytest.mark.parametrize('scale', ['length', *(pytest.param(name, marks=pytest.mark.long)
                                              for name in ('gap', 'points'))])
def test_the_chain_of_a_loop_stands_upright_and_is_clamped_at_both_ends(tmp_path, scale):
    trials, options = traced_by(tmp_path, scale)
    trial, (shape, _) = trials[0], loop()
    points = trial.initial.points[1:-1]
    assert np.abs(points[:, 1]).max() == 0
    across = points[:, [0, 2]] - points[:, [0, 2]].mean(axis=0)
    known = shape[np.linspace(0, len(shape) - 1, len(points)).round().astype(int)]
    assert np.linalg.norm(across - (known - known.mean(axis=0)), axis=1).max() < 0.003
    assert trial.clamped == (0, len(points)) and trial.goals[0].held_by == ('clamp_1', 'clamp_2')
    assert options.mass == pytest.approx(MASS, rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize('scale', ['length', 'gap', 'points'])
def test_stiffness_of_a_photographed_loop(tmp_path, scale):
    found = fitted(*traced_by(tmp_path, scale))
    assert found.identifiable
    assert found.physical_value == pytest.approx(BENDING, rel=0.1)
    if scale != 'gap':  # no interval has the error of the scale in it, and a gap is short
        assert found.physical_lower < BENDING < found.physical_upper


@pytest.mark.long
def test_without_clicks_in_the_clamps_the_line_gives_their_direction(tmp_path):
    trials, _ = traced(tmp_path, view(), '--length', str(LENGTH))
    points = trials[0].initial.points[:, [0, 2]]
    for into, side in ((points[0] - points[1], -1.0), (points[-1] - points[-2], 1.0)):
        assert np.degrees(np.arctan2(into[1], side * into[0])) == pytest.approx(30.0, abs=2.5)


@pytest.mark.long
def test_sessions_of_several_photographs_are_fitted_together(tmp_path, capsys):
    sessions = []
    for number in range(2):
        folder = tmp_path / str(number)
        folder.mkdir()
        traced(folder, view(roll=0.01 * number), '--length', str(LENGTH), off=4.0 * number)
        sessions.append(str(folder / 'loop.mcap'))
    capsys.readouterr()
    assert main(['fit', *sessions, '--calibrate', 'flexibility', '--json', '--workers', '1']) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed['trials'] == 2
    assert printed['parameters']['flexibility']['physical_value'] == pytest.approx(BENDING, rel=0.15)


@pytest.mark.long
def test_a_camera_that_is_turned_is_told_by_a_plumb_line(tmp_path):
    camera = view(roll=0.2)
    plumb = words(pixels(camera, np.array([(0.25, 0.2), (0.25, -0.2)])))
    trials, _ = traced(tmp_path, camera, '--length', str(LENGTH), '--plumb', plumb)
    shape, _ = loop()
    ends = trials[0].initial.points[[1, -2]]
    assert ends[1] - ends[0] == pytest.approx([GAP, 0.0, 0.0], abs=0.002)
    assert np.ptp(trials[0].initial.points[1:-1, 2]) == pytest.approx(np.ptp(shape[:, 1]), abs=0.002)


@pytest.mark.parametrize('flags, words', [
    (('--hanging',), '--length'), (('--length', '0.6', '--mass', '0.03'), '--hanging'),
    (('--length', '0.6', '--output', 'x.mcap'), '--hanging'), (('--hanging', '--length', '-1'), 'length'),
    (('--hanging', '--length', '0.6', '--mass', '-1'), '--mass'),
    (('--hanging', '--length', '0.6', '--clamps', '1,2'), 'two'),
    (('--hanging', '--length', '0.6', '--count', '6'), '--count')])
def test_what_does_not_belong_together_is_refused_in_one_line(tmp_path, capsys, flags, words):
    camera = view()
    Image.fromarray(picture(camera)).save(tmp_path / 'loop.png', compress_level=1)
    assert main(['trace', str(tmp_path / 'loop.png'), '--points', clicked(camera), *flags]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count('\n') == 1


@pytest.mark.long
def test_the_chain_of_a_loop_can_be_written_by_itself(tmp_path, capsys):
    camera = view()
    Image.fromarray(picture(camera)).save(tmp_path / 'loop.png', compress_level=1)
    assert main(['trace', str(tmp_path / 'loop.png'), '--points', clicked(camera), '--hanging', '--length',
                 str(LENGTH), '--output', str(tmp_path / 'loop.csv'), '--json']) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed['length_m'] == pytest.approx(LENGTH)
    np.testing.assert_array_equal(read_chain_file(tmp_path / 'loop.csv').points, printed['points'])
