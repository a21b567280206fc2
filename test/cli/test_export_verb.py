# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `export`: which file it writes, and what it refuses."""

import re

from exported_scene import write_scene
import numpy as np
import pytest

from dlo_calibration.cli import main as cli
from dlo_calibration.export import export_mjcf, export_sdf, export_usd
from dlo_calibration.files.chain_file import read_chain_file
from dlo_calibration.files.result import read_result
from dlo_calibration.files.session import samples
from dlo_calibration.simulation.scene import read_mesh

ROPE, START = samples() / 'xml/dlo.xml', samples() / 'chains/start.csv'


@pytest.fixture
def export(capsys, tmp_path):
    """Give a function that exports the sample; it returns exit code, stderr, and the file."""
    def export(*words, result=ROPE, start=START):
        file = tmp_path / 'rope.out'
        try:
            code = cli.main(['export', str(result), '--from', str(start), '--output', str(file), *words])
        except SystemExit as end:  # argparse
            code = end.code
        return code, capsys.readouterr().err, file

    return export


@pytest.mark.parametrize('name, function', [('mjcf', export_mjcf), ('usd', export_usd), ('sdf', export_sdf)])
def test_export_writes_what_the_function_returns(export, name, function):
    code, _, file = export('--format', name)
    assert code == 0
    assert file.read_text() == function(read_result(ROPE), read_chain_file(START))


def test_export_takes_a_form_and_options(export):
    code, _, file = export('--format', 'mjcf', '--form', 'inextensible', '--nodes', '11', '--no-table')
    assert code == 0
    text = file.read_text()
    assert 'type="slide"' not in text and 'type="plane"' not in text
    assert 'name="dlo_9"' in text and 'name="dlo_10"' not in text


def test_warnings_about_the_exported_dlo_are_printed(export, tmp_path):
    in_millimetres = tmp_path / 'start.csv'
    np.savetxt(in_millimetres, 1000 * read_chain_file(START).points, delimiter=',')
    code, warnings, _ = export('--format', 'sdf', start=in_millimetres)
    assert code == 0
    assert 'check that both are the same DLO' in warnings and 'elasticity is not identifiable' in warnings


@pytest.mark.parametrize('words, said', [
    (['--format', 'mjcf', '--form', 'soft'], "'soft'; expected one of extensible, inextensible"),
    (['--format', 'sdf', '--form', 'soft'], 'sdf has only one'),
    (['--format', 'urdf'], 'urdf'),
    (['--format', 'mjcf', '--nodes', '3'], 'nodes'),
])
def test_unknown_formats_and_forms_are_refused_in_one_line(export, words, said):
    code, error, file = export(*words)
    assert code == 2
    assert said in error and error.count('\n') == 1
    assert not file.exists()


def test_a_file_that_is_no_result_is_refused(export):
    code, error, _ = export('--format', 'mjcf', result=START)
    assert code == 2
    assert error.count('\n') == 1


def test_the_obstacles_of_a_scene_go_into_the_file_and_meshes_beside_it(export, tmp_path):
    scene = tmp_path / 'scene'
    scene.mkdir()
    code, _, file = export('--format', 'sdf', '--scene', write_scene(scene))
    assert code == 0
    name = re.search('<uri>(.*)</uri>', file.read_text())[1]
    assert len(read_mesh(str(file.parent / name))) == 4


def test_the_scene_of_a_calibration_is_exported_or_missed(export, tmp_path):
    write_scene(tmp_path)
    result = tmp_path / 'result.xml'
    result.write_text(re.sub(r'name="scene" value=".*?"', 'name="scene" value="scene.urdf"',
                             ROPE.read_text()))
    code, _, file = export('--format', 'mjcf', result=result)
    assert code == 0
    assert 'name="obstacle_4"' in file.read_text()
    (tmp_path / 'scene.urdf').unlink()
    code, error, _ = export('--format', 'mjcf', result=result)
    assert code == 2
    assert 'give it with --scene' in error
