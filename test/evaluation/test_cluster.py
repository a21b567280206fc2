# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A real Dask scheduler with real workers, over TCP on this machine: the same result if workers die."""

from concurrent.futures import Future
from contextlib import contextmanager
import json
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest
from toy_messages import toy_trials
from toy_simulator import Deadly, new_toy, ToySimulator

from dlo_calibration import calibrate, DloCalibrationError, InputError
from dlo_calibration.calibration.options import Options
from dlo_calibration.evaluation import cluster

distributed = pytest.importorskip('distributed', reason='the extra "distributed" of setup.py has it')

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 60.0
PATHS = os.pathsep.join([str(ROOT), str(ROOT / 'test/support'), os.environ.get('PYTHONPATH', '')])


def dask(part, *words, **environment):
    """Start a part of a cluster as a process of its own."""
    # By default, Dask tries for 30 s to get the results of a dead worker.
    environment = {'DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT': '5s', **environment}
    return subprocess.Popen(
        [sys.executable, '-m', f'distributed.cli.dask_{part}', '--host', '127.0.0.1', '--no-dashboard',
         *words], env={**os.environ, 'PYTHONPATH': PATHS, **environment}, cwd='/', stderr=subprocess.DEVNULL)


@contextmanager
def running(folder, workers=2, **environment):
    """Give the address of a scheduler that has Dask alone, and the processes: its own and the workers'."""
    file = folder / 'scheduler.json'
    scheduler = dask('scheduler', '--port', '0', '--scheduler-file', str(file), PYTHONPATH='', **environment)
    processes = [scheduler]
    try:
        begun = time.monotonic()
        while not file.exists() or not file.read_text():
            assert time.monotonic() - begun < PATIENCE and scheduler.poll() is None
            time.sleep(0.02)
        address = json.loads(file.read_text())['address']
        processes += [dask('worker', address, '--no-nanny', '--nthreads', '1')
                      for _ in range(workers)]
        yield address, processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


def wait_for_workers(address, count):
    with distributed.Client(address, set_as_default=False) as client:
        client.wait_for_workers(count, timeout=PATIENCE)


@pytest.fixture(scope='module')
def machines(tmp_path_factory):
    with running(tmp_path_factory.mktemp('machines')) as (address, processes):
        wait_for_workers(address, 2)
        yield address, processes


@pytest.fixture(scope='module')
def scheduler(tmp_path_factory):
    with running(tmp_path_factory.mktemp('scheduler'), 0) as (address, _):
        yield address


@pytest.fixture
def start_worker(scheduler):
    """Give a function that starts a worker of a scheduler which has none; all are killed at the end."""
    processes = []

    def start(**environment):
        processes.append(dask('worker', scheduler, '--no-nanny', '--nthreads', '1', **environment))
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        process.wait()
    with distributed.Client(scheduler, set_as_default=False) as client:
        begun = time.monotonic()
        while client.scheduler_info()['workers']:
            assert time.monotonic() - begun < PATIENCE
            time.sleep(0.02)


def options(address='', **flat):
    return Options.of({'search': 'random', 'evaluations': 100, 'workers': 1, 'scheduler': address, **flat})


def same(first, second):
    assert first.parameters == second.parameters
    assert first.simulations == second.simulations
    assert first.best.residuals.tobytes() == second.best.residuals.tobytes()
    assert [e.score for e in first.evaluations] == [e.score for e in second.evaluations]


@pytest.mark.long
def test_a_killed_worker_gives_a_warning_and_the_result_of_one_process(machines, capfd):
    address, processes = machines
    alone = calibrate(toy_trials(2), options(), make_simulator=new_toy)
    notices = []
    whole = calibrate(toy_trials(2), options(address), make_simulator=new_toy, on_notice=notices.append)
    same(alone, whole)
    assert notices == []

    def kill(evaluation):
        if evaluation.index == 10:
            os.kill(processes[1].pid, signal.SIGKILL)

    torn = calibrate(toy_trials(2), options(address),
                     make_simulator=lambda _: ToySimulator(0.005), on_evaluation=kill,
                     on_notice=notices.append)
    same(alone, torn)
    assert len(notices) == 1
    assert 'the scheduler lost the worker tcp://127.0.0.1:' in notices[0]
    assert torn.warnings == tuple(notices)
    assert capfd.readouterr() == ('', '')


def test_a_stop_leaves_nothing_at_the_scheduler(machines):
    address, _ = machines
    seen = []
    result = calibrate(toy_trials(1), options(address, evaluations=10000),
                       make_simulator=lambda _: ToySimulator(0.05), on_evaluation=seen.append,
                       should_stop=lambda: len(seen) >= 3)
    assert result.stop_reason == 'stopped on request'
    assert len(result.evaluations) == 3
    with distributed.Client(address, set_as_default=False) as client:
        begun = time.monotonic()
        while tasks := client.run_on_scheduler(lambda dask_scheduler: sorted(map(str, dask_scheduler.tasks))):
            assert time.monotonic() - begun < PATIENCE, tasks
            time.sleep(0.05)


def test_without_workers_it_says_so_and_waits(scheduler):
    notices = []
    with pytest.raises(DloCalibrationError, match='stopped before the'):
        calibrate(toy_trials(1), options(scheduler),
                  make_simulator=new_toy, should_stop=lambda: bool(notices), on_notice=notices.append)
    assert 'has no workers yet' in notices[0]


@pytest.mark.long
def test_a_machine_without_a_module_or_with_another_version_is_refused(scheduler, start_worker, tmp_path):
    (tmp_path / 'toy_simulator.py').touch()
    for path, words in ((ROOT, 'a machine without the module toy_simulator; .* install'),
                        (tmp_path, "another version .*'ToySimulat.* the same version everywhere")):
        worker = start_worker(PYTHONPATH=os.pathsep.join([str(path), str(ROOT)]))
        with pytest.raises(InputError, match=words):
            calibrate(toy_trials(1), options(scheduler), make_simulator=new_toy)
        worker.kill()
        worker.wait()


@pytest.mark.long
def test_an_evaluation_that_kills_too_many_workers_ends_with_what_to_do(tmp_path):
    with running(tmp_path, 1, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES='0') as (address, _):
        with pytest.raises(DloCalibrationError, match='1 workers of the scheduler .* give them more memory'):
            calibrate(toy_trials(1), options(address), make_simulator=lambda _: Deadly())


@pytest.mark.long
def test_a_calibration_ends_if_no_worker_returns_in_time(scheduler, start_worker, monkeypatch):
    monkeypatch.setattr(cluster, 'RETURN', 1.0)
    notices = []
    start_worker()
    wait_for_workers(scheduler, 1)
    with pytest.raises(DloCalibrationError, match='lost its last worker, and none came back within 1 s'):
        calibrate(toy_trials(1), options(scheduler),
                  make_simulator=lambda _: Deadly(), on_notice=notices.append)
    assert len(notices) == 1
    assert 'the scheduler lost the worker' in notices[0]


@pytest.mark.long
def test_a_calibration_goes_on_when_a_worker_returns(scheduler, start_worker, monkeypatch):
    monkeypatch.setattr(cluster, 'RETURN', PATIENCE)
    first = start_worker()

    def replace(evaluation):
        if evaluation.index == 10:
            first.kill()
            start_worker()

    torn = calibrate(toy_trials(2), options(scheduler),
                     make_simulator=lambda _: ToySimulator(0.005), on_evaluation=replace)
    same(torn, calibrate(toy_trials(2), options(), make_simulator=new_toy))


@pytest.mark.long
def test_a_hanging_scheduler_does_not_delay_the_end_and_a_killed_one_ends_the_calibration(tmp_path, capfd):
    def search(address, **rest):
        return calibrate(toy_trials(1), options(address, evaluations=10000),
                         make_simulator=lambda _: ToySimulator(0.01), **rest)

    with running(tmp_path, 1) as (address, (scheduler, _)):
        seen = []

        def freeze(evaluation):
            seen.append(evaluation)
            scheduler.send_signal(signal.SIGSTOP)

        result = search(address, on_evaluation=freeze, should_stop=lambda: bool(seen))
        assert result.stop_reason == 'stopped on request'
        scheduler.send_signal(signal.SIGCONT)
        with pytest.raises(DloCalibrationError, match=f'the scheduler {address} is lost'):
            search(address, on_evaluation=lambda _: scheduler.kill())
    assert capfd.readouterr() == ('', '')


@pytest.mark.parametrize('address', ['nonsense', 'tcp://', 'tcp://127.0.0.1'])
def test_an_invalid_address_is_refused(address):
    with pytest.raises(InputError, match='parameter scheduler: .* start one with: dask scheduler'):
        calibrate(toy_trials(1), options(address), make_simulator=new_toy)


def test_a_scheduler_that_does_not_answer_is_refused():
    with socket.socket() as server:
        server.bind(('127.0.0.1', 0))  # and does not listen
        with pytest.raises(InputError, match='such as tcp://host:8786'):
            cluster.ClusterExecutor(f'tcp://127.0.0.1:{server.getsockname()[1]}')


def test_without_the_library_it_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    with pytest.raises(InputError, match='pip install distributed'):
        calibrate(toy_trials(1), options('tcp://127.0.0.1:1'), make_simulator=new_toy)


@pytest.mark.long
def test_a_call_whose_result_dask_misreads_as_an_error_is_sent_again():
    """A worker may be lost after its result has arrived, and before Dask has read its status."""
    from distributed.cfexecutor import _cascade_future
    from tornado.ioloop import IOLoop

    class Lost:
        status = 'lost'

        async def _result(self, raiseit):
            return 7

    class Scheduler:
        asked = 0

        def submit(self, load, packed):
            self.asked += 1
            there = Future()
            if self.asked == 1:
                IOLoop.current().run_sync(lambda: _cascade_future(Lost(), there))
            else:
                there.set_result(load(packed))
            return there

    executor = object.__new__(cluster.ClusterExecutor)
    executor._executor, executor._pending, executor._given_up = Scheduler(), {}, None
    executor._pickled = {}
    executor._closed = threading.Event()
    assert executor.submit(pow, 2, 3).result(timeout=5) == 8
    assert executor._executor.asked == 2
