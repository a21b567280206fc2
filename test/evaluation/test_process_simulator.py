# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A simulator in a process of its own: the same rollouts, and a crash or hang that ends nothing else."""

from concurrent.futures import CancelledError
from contextlib import closing
import os
from pathlib import Path
import pickle
import signal
import subprocess
import sys
import threading
import time

from process_engines import AlwaysHanging, Deadly, Dying, Hanging, in_process, Slow, Telling
from processes import simulating
import pytest
from toy_messages import toy_trials
from toy_simulator import ToySimulator

from dlo_calibration import calibrate, DloCalibrationError, SimulationError
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.options import Options
from dlo_calibration.evaluation import Evaluator, Pool, ProcessSimulator, Threads
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.simulation.protocol import Stop

ROOT = Path(__file__).resolve().parents[2]
BOX = ('<robot name="box"><link name="box"><collision><geometry><box size="0.1 0.1 0.1"/></geometry>'
       '</collision></link></robot>')
MIDDLE, LIMP = [0.5] * 4, 0.99 * ParameterSpace().upper
PATIENCE = 60.0


@pytest.fixture
def scene(tmp_path):
    """Give the path of a scene."""
    (tmp_path / 'box.urdf').write_text(BOX, encoding='utf-8')
    return str(tmp_path / 'box.urdf')


def tried(simulator, point=MIDDLE):
    return Evaluator(toy_trials(2), ParameterSpace(), simulator).evaluate(0, point)


def a_job(value=50.0):
    return toy_trials(1)[0], ParameterSpace().physical({'flexibility': value}, 1.0)


def wait_until(condition):
    begun = time.monotonic()
    while not condition():
        assert time.monotonic() - begun < PATIENCE
        time.sleep(0.01)


def test_rollouts_and_errors_are_those_of_the_simulator_itself():
    before = simulating(os.getpid())
    with closing(in_process(ToySimulator, 0.0, 30.0)) as away:
        expected = tried(ToySimulator()).residuals.tobytes()
        assert [tried(away).residuals.tobytes() for _ in range(2)] == [expected, expected]
        assert tried(away, [0.1] * 4).failure == 'trial 1: diverged'
        with pytest.raises(SimulationError, match='diverged'):
            away.simulate(*a_job(10.0))
        assert len(simulating(os.getpid())) == len(before) + 1
        there = pickle.loads(pickle.dumps(away))  # noqa: S301  # as other machines get it
        assert (there.name, there._idle) == ('toy', [])
    assert simulating(os.getpid()) == before
    with closing(in_process(Telling)) as away, pytest.raises(RuntimeError) as error:
        away.simulate(*a_job())
    process, nice = map(int, str(error.value).split())
    assert (process != os.getpid(), nice) == (True, min(os.nice(0) + 5, 19))


@pytest.mark.long
def test_pybullet_gives_the_same_rollouts_in_its_process(scene):
    bullet = pytest.importorskip('dlo_calibration.simulation.bullet')
    options = Options(engine='bullet', scene=scene, nodes=9, settle_limit=0.1, time_step=0.01)
    engine = bullet.BulletSimulator(scene=scene, nodes=9, settle_limit=0.1, time_step=0.01)
    with closing(make_simulator(options)) as away, closing(engine) as itself:
        assert tried(away).residuals.tobytes() == tried(itself).residuals.tobytes()
        with closing(away.refined()) as finer:
            assert tried(finer).residuals.tobytes() == tried(itself.refined()).residuals.tobytes()


def test_a_crash_is_reported_with_the_scene_and_the_next_call_works(caplog):
    with closing(in_process(Deadly)) as away:
        with pytest.raises(DloCalibrationError, match='the scene peg.urdf could not be simulated: '
                                                      '3 processes .* was killed by SIGKILL'):
            tried(away, LIMP)
        assert tried(away).residuals is not None
    assert [record.getMessage() for record in caplog.records] == [
        'a process that simulates the scene peg.urdf was killed by SIGKILL, as happens when memory runs out; '
        'its rollout is repeated'] * 3


def test_a_rollout_whose_process_dies_is_repeated(tmp_path):
    with closing(in_process(Deadly, tmp_path / 'died')) as away:
        assert tried(away, LIMP).residuals.tobytes() == tried(ToySimulator(), LIMP).residuals.tobytes()


def test_an_idle_process_that_died_is_replaced():
    with closing(in_process(ToySimulator)) as away:
        tried(away)
        for pid in simulating(os.getpid()):
            os.kill(pid, signal.SIGKILL)
        assert tried(away).residuals is not None


@pytest.mark.long
def test_a_hanging_process_is_replaced_and_a_slow_one_is_not(monkeypatch):
    monkeypatch.setattr('dlo_calibration.evaluation.process_simulator.DEATHS', 1)
    with closing(in_process(Hanging, limit=1.0)) as away:
        with pytest.raises(DloCalibrationError, match='gave no answer for 1 s .*; raise answer_limit'):
            tried(away, LIMP)
        assert tried(away).residuals is not None
    with closing(in_process(Slow, limit=1.0)) as away:
        assert away.simulate(*a_job()).chains.shape == (1, 11, 3)


def test_a_stop_ends_a_rollout_in_its_middle():
    stop = Stop()
    with closing(in_process(Hanging)) as away:
        threading.Timer(0.5, stop.set).start()
        with pytest.raises(CancelledError):
            away.simulate_together([a_job(95.0)], stop)
        assert not simulating(os.getpid())


@pytest.mark.long
def test_each_thread_has_a_process():
    with closing(in_process(Slow)) as away, closing(Threads(2)) as threads:
        begun = Pool(away, threads).begin([a_job(), a_job()])
        wait_until(lambda: len(simulating(os.getpid())) == 2)
        first, second = begun()
        assert first.chains.tobytes() == second.chains.tobytes()
    assert not simulating(os.getpid())


class Second:
    """Makes a toy, and for the confirmation another engine in a process of its own."""

    def __init__(self, kind, **rest):
        self.kind, self.rest = kind, rest

    def __call__(self, options):
        second = options.engine == 'bullet'
        return ProcessSimulator('second', self.kind, 'trials', **self.rest) if second else ToySimulator()


@pytest.mark.long
@pytest.mark.parametrize('kind, limit, ending', [
    (Dying, 60.0, 'ended unexpectedly with exit code 3; free memory, or use fewer workers'),
    (AlwaysHanging, 1.0, 'gave no answer for 1 s and is replaced; raise answer_limit')])
def test_a_confirmation_that_crashes_or_hangs_does_no_harm(kind, limit, ending, monkeypatch):
    monkeypatch.setattr('dlo_calibration.evaluation.process_simulator.DEATHS', 2)
    result = calibrate(toy_trials(1), Options(evaluations=4, workers=2),
                       make_simulator=Second(kind, answer_limit=limit))
    assert result.best.residuals is not None
    assert result.warnings[-1] == (
        'not confirmed by engine bullet: the trials could not be simulated: 2 processes one after the other '
        f'ended unexpectedly at the same evaluation, the last one {ending}')


PROGRAM = """
import sys
sys.path[:0] = ['test/support']
from process_engines import Hanging, in_process, Slow
from test_process_simulator import a_job
away = in_process({kind}, limit={limit})
print('begins', flush=True)
away.simulate(*a_job(95.0))
"""


@pytest.mark.long
@pytest.mark.parametrize(('kind', 'limit'), [('Slow', 60.0), ('Hanging', 2.0)])
def test_kill_9_of_the_parent_leaves_no_process_behind(kind, limit):
    parent = subprocess.Popen(
        [sys.executable, '-c', PROGRAM.format(kind=kind, limit=limit)], cwd=ROOT, stdout=subprocess.PIPE,
        text=True, env={**os.environ, 'PYTHONPATH': f'{ROOT}:{ROOT}/test/support:{ROOT}/test/evaluation'})
    assert parent.stdout.readline() == 'begins\n'
    wait_until(lambda: simulating(parent.pid))
    child, = simulating(parent.pid)
    wait_until(lambda: os.getpgid(child) == child)  # Ctrl-C in a terminal does not reach it
    time.sleep(1.0)  # it simulates now
    parent.kill()
    parent.wait()
    wait_until(lambda: not Path(f'/proc/{child}').exists())


@pytest.mark.long
def test_a_program_that_ends_without_closing_does_not_wait():
    program = PROGRAM.format(kind='Slow', limit=60.0)
    subprocess.run([sys.executable, '-c', program], cwd=ROOT, stdout=subprocess.DEVNULL, check=True,
                   timeout=PATIENCE,
                   env={**os.environ, 'PYTHONPATH': f'{ROOT}:{ROOT}/test/support:{ROOT}/test/evaluation'})
