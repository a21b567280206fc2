# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A simulator in a process of its own: the same rollouts, and a crash that ends nothing else."""

from contextlib import closing
import copy
import os
import pickle

from processes import simulating as simulating_for
import pytest
from toy_messages import toy_trials
from toy_simulator import Deadly, ToySimulator

from dlo_calibration import DloCalibrationError, SimulationError
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.options import Options
from dlo_calibration.evaluation import Evaluator, ProcessExecutor, SimulatorApart
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.bullet import BulletSimulator

BOX = ('<robot name="box"><link name="box"><collision><geometry><box size="0.1 0.1 0.1"/></geometry>'
       '</collision></link></robot>')
MIDDLE = [0.5] * 4


@pytest.fixture
def scene(tmp_path):
    """Give the path of a scene."""
    (tmp_path / 'box.urdf').write_text(BOX, encoding='utf-8')
    return str(tmp_path / 'box.urdf')


def simulating():
    """Return the ids of the processes that simulate."""
    return set(simulating_for(os.getpid()))


def tried(simulator, point=MIDDLE):
    return Evaluator(toy_trials(2), ParameterSpace(), simulator).evaluate(0, point)


def test_it_gives_the_same_and_errors_pass(scene):
    for make in (ToySimulator, lambda: BulletSimulator(scene=scene, settle_limit=0.1, time_step=0.01)):
        with closing(SimulatorApart(make(), 'scene')) as apart, closing(make()) as itself:
            expected = tried(itself).residuals.tobytes()
            assert [tried(apart).residuals.tobytes() for _ in range(2)] == [expected, expected]
            assert apart.name == itself.name
    with closing(SimulatorApart(ToySimulator(fail_below=100.0), 'toy')) as failing:
        assert tried(failing).failure.endswith('diverged')
        with pytest.raises(SimulationError):
            failing.simulate(toy_trials(1)[0], ParameterSpace().physical({}, 1.0))


class Located(ToySimulator):
    """Its name for the process is asked for by `prepare`, as an error."""

    def prepare(self):
        """Tell the process."""
        raise SimulationError(f'{os.getpid()}')


def test_it_is_executed_elsewhere_and_pickled_it_is_the_simulator():
    apart = SimulatorApart(Located(), 'toy')
    before = simulating()
    with pytest.raises(SimulationError) as told:
        apart.prepare()
    assert int(str(told.value)) != os.getpid()
    assert simulating() == before  # nothing stays behind
    assert type(pickle.loads(pickle.dumps(apart))) is Located  # noqa: S301
    assert type(copy.copy(apart)) is SimulatorApart
    assert apart.refined() is None


def test_a_finer_one_is_in_the_same_process(scene):
    before = simulating()
    engine = BulletSimulator(scene=scene, settle_limit=0.1, time_step=0.01, nodes=9)
    with closing(SimulatorApart(engine, 'scene')) as apart, closing(engine.refined()) as itself:
        tried(apart)
        finer = apart.refined()
        assert tried(finer).residuals.tobytes() == tried(itself).residuals.tobytes()
        assert len(simulating() - before) == 1
        finer.close()
        assert len(simulating() - before) == 1
    assert simulating() == before


def test_a_crash_is_told_with_what_made_it_and_the_next_call_works():
    with closing(SimulatorApart(Deadly(), 'scene peg.urdf')) as apart:
        with pytest.raises(DloCalibrationError, match='the scene peg.urdf could not be simulated: '
                                                      '3 processes .* was killed by SIGKILL'):
            tried(apart, [0.99] * 4)
        assert tried(apart).residuals is not None


def test_a_scene_is_simulated_apart_but_in_a_worker(scene):
    options = Options(engine='bullet', scene=scene)
    with closing(make_simulator(options)) as simulator:
        assert type(simulator) is SimulatorApart
    with closing(ProcessExecutor(1)) as executor:
        assert executor.submit(kind_of_engine, options).result(60) is BulletSimulator


def kind_of_engine(options):
    return type(make_simulator(options))
