# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Draws from the posterior as models: their statistics, their files, and that MuJoCo loads them."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from dlo_calibration import InputError, Options, read_result
from dlo_calibration.cli import main as cli
from dlo_calibration.export.draws import drawn_dlos
from dlo_calibration.files.chain_file import read_chain_file
from dlo_calibration.files.session import samples

ROPE, START = samples() / 'xml/dlo.xml', samples() / 'chains/start.csv'


def correlated():
    """Return a result whose EI and friction are correlated."""
    result = read_result(ROPE)
    names = list(result.parameters)
    correlations = {name: {other: float(name == other) for other in names} for name in names}
    correlations['flexibility']['friction'] = correlations['friction']['flexibility'] = -0.8
    return replace(result, correlations=correlations)


def drawn(count, **rest):
    """Return the drawn values by name, (count,) each."""
    dlos = drawn_dlos(correlated(), read_chain_file(START), Options(), count, 3, **rest)
    return {name: np.array([dlo.parameters[name].value for dlo in dlos]) for name in dlos[0].parameters}


def test_draws_have_the_intervals_and_correlations_of_the_result():
    values, result = drawn(2000), correlated()
    for name in ('flexibility', 'friction'):
        found = result.parameters[name]
        inside = (values[name] >= found.lower) & (values[name] <= found.upper)
        assert inside.mean() == pytest.approx(0.9, abs=0.03)
    assert np.corrcoef(values['flexibility'], values['friction'])[0, 1] == pytest.approx(-0.8, abs=0.05)


def test_undetermined_parameters_keep_their_value_unless_asked():
    kept, varied, result = drawn(500), drawn(500, vary=True), correlated()
    elasticity = result.parameters['elasticity']
    assert set(kept['elasticity']) == {elasticity.value}
    quarters = np.histogram(varied['elasticity'], 4, (elasticity.lower, elasticity.upper))[0]
    assert quarters.sum() == 500
    assert quarters.min() > 90
    assert varied['flexibility'] == pytest.approx(kept['flexibility'])
    lying = float(np.median(read_chain_file(START).points[:, 2]))
    radii = [result.space.reported('self_collision', value)[0] for value in varied['self_collision']]
    assert 0.9 * lying < max(radii) < 1.1 * lying  # the height at which it lies
    assert np.median(radii) < 0.9 * lying


@pytest.mark.parametrize('kind', ['mjcf', 'usd', 'sdf'])
def test_the_verb_writes_each_draw_and_a_table(tmp_path, kind, capsys):
    words = ['export', str(ROPE), '--format', kind, '--from', str(START), '--draws', '3', '--seed', '5']
    assert cli.main([*words, '--output', str(tmp_path / 'rope.xml')]) == 0
    rows = list(csv.DictReader((tmp_path / 'draws.csv').read_text().splitlines()))
    assert [row['file'] for row in rows] == ['rope_1.xml', 'rope_2.xml', 'rope_3.xml']
    assert len({float(row['flexibility']) for row in rows}) == 3
    first = (tmp_path / 'rope_1.xml').read_text()
    assert first != (tmp_path / 'rope_2.xml').read_text()
    assert 'elasticity is not identifiable' in first
    assert 'this draw' in first
    assert cli.main([*words, '--output', str(tmp_path / 'again' / 'rope.xml')]) == 0
    assert (tmp_path / 'again' / 'rope_1.xml').read_text() == first


def test_mujoco_loads_draws_of_their_own_stiffness(tmp_path):
    mujoco = pytest.importorskip('mujoco', reason='needs MuJoCo: the extra "bench" of setup.py has it')
    assert cli.main(['export', str(ROPE), '--format', 'mjcf', '--from', str(START), '--draws', '2', '--nodes',
                     '11', '--output', str(tmp_path / 'rope.xml')]) == 0
    rows = list(csv.DictReader((tmp_path / 'draws.csv').read_text().splitlines()))
    models = [mujoco.MjModel.from_xml_path(str(tmp_path / row['file'])) for row in rows]
    stiffnesses = [model.jnt_stiffness[model.joint('dlo_bend_5').id] for model in models]
    wanted = [float(row['flexibility [N m^2]']) for row in rows]
    assert stiffnesses[0] / stiffnesses[1] == pytest.approx(wanted[0] / wanted[1], rel=1e-6)
    for model in models:
        state = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, state, model.key('start').id)
        mujoco.mj_step(model, state, 200)
        assert np.abs(state.qvel).max() < 1


def test_how_draws_vary_is_refused_without_draws(tmp_path, capsys):
    assert cli.main(['export', str(ROPE), '--format', 'mjcf', '--from', str(START), '--undetermined', 'vary',
                     '--output', str(tmp_path / 'rope.xml')]) == 2
    assert '--undetermined: no draws; expected --draws N' in capsys.readouterr().err


@pytest.mark.parametrize(('count', 'seed'), [(0, 1), (-1, 1), (10001, 1), (2, -1)])
def test_impossible_draws_are_refused(count, seed):
    with pytest.raises(InputError):
        drawn_dlos(correlated(), read_chain_file(START), Options(), count, seed)
