# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The choice of an engine: what each name gives, what it refuses, and its warnings."""

from contextlib import closing
import logging
import pickle
import sys

import numpy as np
import pytest
from toy_messages import toy_trials

from dlo_calibration import calibrate
from dlo_calibration.calibration.engines import ENGINES, make_simulator
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.evaluation import ProcessSimulator
from dlo_calibration.model.parameters import ParameterSpace

BOX = ('<robot name="box"><link name="box"><collision><geometry><box size="0.1 0.1 0.1"/></geometry>'
       '</collision></link></robot>')


@pytest.fixture
def warnings(caplog):
    """Give a function that returns the warnings so far, as of a new process."""
    caplog.set_level(logging.WARNING, 'dlo_calibration')
    return lambda: [record.getMessage() for record in caplog.records]


@pytest.fixture
def scene(tmp_path):
    """Give the path of a scene."""
    (tmp_path / 'box.urdf').write_text(BOX, encoding='utf-8')
    return str(tmp_path / 'box.urdf')


def test_every_engine_that_can_be_chosen_can_be_made():
    engine, = (declaration for declaration in Options.declarations() if declaration.name == 'engine')
    assert set(ENGINES) == set(engine.choices)
    assert Options().engine == 'auto'


def test_auto_is_the_compiled_engine_without_a_warning(warnings):
    for engine in ('auto', 'compiled'):
        assert make_simulator(Options(engine=engine)).name == 'compiled'
    assert warnings() == []


@pytest.mark.pybullet
def test_the_option_engine_chooses_bullet(warnings):
    simulator = make_simulator(Options(engine='bullet'))
    assert type(simulator) is ProcessSimulator
    assert simulator.name == 'bullet'
    assert warnings() == []


@pytest.mark.parametrize('finer', [False, True])
def test_an_engine_that_was_sent_to_another_process_is_the_same_there(finer):
    trial, physical = toy_trials(1)[0], ParameterSpace().physical({}, 1.0)
    itself = make_simulator(Options())
    if finer:
        itself = itself.refined()
    expected = itself.simulate(trial, physical).chains.tobytes()
    sent = pickle.loads(pickle.dumps(itself))  # noqa: S301  # our own
    assert sent.simulate(trial, physical).chains.tobytes() == expected


@pytest.mark.parametrize('engine', ['auto', 'compiled'])
def test_a_scene_is_simulated_by_the_compiled_engine(engine, scene, warnings):
    trial, physical = toy_trials(1)[0], ParameterSpace().physical({}, 1.0)
    with closing(make_simulator(Options(engine=engine, scene=scene))) as among:
        assert among.name == 'compiled'
        seen = among.simulate(trial, physical)
    alone = make_simulator(Options()).simulate(trial, physical)
    assert not np.allclose(seen.chains, alone.chains, atol=1e-3)
    assert warnings() == []


@pytest.mark.pybullet
@pytest.mark.parametrize('engine', ['auto', 'bullet'])
def test_a_scene_that_is_not_there_is_refused_before_anything_is_simulated(engine):
    options = Options(engine=engine, scene='nowhere.urdf', workers=1)
    with pytest.raises(InputError, match='scene nowhere.urdf: .*No such file.*expected a URDF file'):
        calibrate(toy_trials(1), options, make_simulator=make_simulator)


@pytest.mark.pybullet
def test_a_path_is_relative_to_the_working_directory(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert make_simulator(Options(engine='bullet', scene='box.urdf')).name == 'bullet'


@pytest.fixture
def without_pybullet(monkeypatch):
    """Hide PyBullet, as if it were not installed."""
    monkeypatch.setitem(sys.modules, 'pybullet', None)


def test_without_pybullet_its_engine_is_refused_in_a_sentence(without_pybullet):
    with pytest.raises(InputError) as refusal:
        calibrate(toy_trials(1), Options(engine='bullet'))
    assert str(refusal.value) == ('engine bullet: no PyBullet; expected that library; '
                                  'install it: pip install pybullet')


def test_without_pybullet_a_result_is_not_confirmed_and_says_so(without_pybullet):
    result = calibrate(toy_trials(1), Options(evaluations=4, search='random', workers=2))
    assert result.confirmation is None
    assert result.warnings[-1] == ('PyBullet is not installed, so no second engine confirmed the result; '
                                   'pip install pybullet')
