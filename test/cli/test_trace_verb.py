# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb trace: a photograph and a few clicks give the line, the chain, and files."""

import json
from pathlib import Path
import re

from curve_views import curve, DIAMETER, drawn, view
import numpy as np
from PIL import Image
import pytest

from dlo_calibration.cli.main import main
from dlo_calibration.files.chain_file import read_chain_file

POINTS, SCALE = curve(), view(0.3)
CLICKS = SCALE.to_pixels(POINTS[[1, 100, 200, 300, 398]]) + (3.0, -2.0)
CORNERS = np.array([(-0.2, -0.15), (0.2, -0.15), (0.2, 0.15), (-0.2, 0.15), (0.0, 0.2)])


def words(pairs):
    return ' '.join(f'{u:.2f},{v:.2f}' for u, v in pairs)


PLACES = SCALE.to_pixels(np.column_stack([CORNERS, np.zeros(5)]))
KNOWN = ' '.join(f'{u:.3f},{v:.3f}={x:g},{y:g}' for (u, v), (x, y) in zip(PLACES, CORNERS, strict=True))


@pytest.fixture(scope='module')
def photograph(tmp_path_factory):
    path = tmp_path_factory.mktemp('photographs') / 'rope.png'
    Image.fromarray(drawn(POINTS, SCALE)).save(path, compress_level=1)
    return str(path)


def traced(capsys, *args):
    assert main(['trace', *args, '--json']) == 0
    return json.loads(capsys.readouterr().out)


def test_clicks_and_known_points_give_the_chain(photograph, capsys, tmp_path):
    files = ['--output', str(tmp_path / 'chain.csv'), '--picture', str(tmp_path / 'picture.png')]
    printed = traced(capsys, photograph, '--points', words(CLICKS), '--scale', KNOWN, '--diameter', '0.008',
                   *files)
    along = np.linspace(0, len(POINTS) - 1, 21).round().astype(int)
    np.testing.assert_allclose(printed['points'], POINTS[along], atol=3e-3)  # a pixel is 0.9 mm
    assert printed['length_m'] == pytest.approx(0.5, abs=5e-3)
    assert printed['width_px'] == pytest.approx(9, abs=3)
    assert printed['crossings'] == []
    steps = np.linalg.norm(np.diff(printed['pixels'], axis=0), axis=1)
    assert steps.max() < 5
    np.testing.assert_allclose(printed['pixels'][0], SCALE.to_pixels(POINTS[:1])[0], atol=4)
    np.testing.assert_array_equal(read_chain_file(tmp_path / 'chain.csv').points, printed['points'])
    with Image.open(tmp_path / 'picture.png') as picture:
        changed = np.asarray(picture).astype(int) - np.asarray(Image.open(photograph))
    u, v = np.rint(printed['pixels'][len(printed['pixels']) // 3]).astype(int)
    assert np.abs(changed[v, u]).max() > 50


def test_without_a_scale_there_is_only_the_line(photograph, capsys):
    printed = traced(capsys, photograph, '--points', words(CLICKS[::-1]))
    document = (Path(__file__).parents[2] / 'doc/messages.md').read_text(encoding='utf-8')
    assert [key for key in printed if f'`{key}`' not in document] == []
    assert printed['points'] is printed['length_m'] is None
    np.testing.assert_allclose(printed['pixels'][-1], SCALE.to_pixels(POINTS[:1])[0], atol=4)


def test_people_read_the_length(photograph, capsys, tmp_path):
    xml = tmp_path / 'chain.xml'
    assert main(['trace', photograph, '--points', words(CLICKS), '--scale', KNOWN, '--count', '11',
                 '--output', str(xml)]) == 0
    assert re.search(r'DLO (49|50)\d\.\d mm long, (7|8|9|10)\.\d mm thick', capsys.readouterr().out)
    chain = read_chain_file(xml)
    assert len(chain) == 11
    assert chain.points[:, 2] == pytest.approx(np.full(11, DIAMETER / 2), rel=0.4)


BOTH_ENDS = words(CLICKS[[0, -1]])


@pytest.mark.parametrize('args, text', [
    (['--points', '10,20'], 'click'),
    (['--points', ''], 'click'),
    (['--points', '10,20 x,y'], '--points'),
    (['--points', '10,20 nan,5'], '--points'),
    (['--points', '10,20 99999,5'], 'click 2'),
    (['--points', BOTH_ENDS, '--scale', '1,2=0,0'], 'scale'),
    (['--points', BOTH_ENDS, '--scale', '1,2'], '--scale'),
    (['--points', BOTH_ENDS, '--board'], 'board'),
    (['--points', BOTH_ENDS, '--camera', 'missing.yaml', '--board'], 'missing.yaml'),
    (['--points', BOTH_ENDS, '--count', '1'], '--count'),
    (['--points', BOTH_ENDS, '--diameter', '-1'], '--diameter'),
    (['--points', BOTH_ENDS, '--output', 'chain.csv'], '--output'),
])
def test_unusable_input_is_refused_in_one_sentence(photograph, args, text, capsys):
    assert main(['trace', photograph, *args]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.count('\n') == 1
    assert text in err


def test_a_text_file_is_no_photograph(tmp_path, capsys):
    path = tmp_path / 'rope.jpg'
    path.write_text('no photograph')
    assert main(['trace', str(path), '--points', '1,2 3,4']) == 2
    assert 'no photograph' in capsys.readouterr().err
