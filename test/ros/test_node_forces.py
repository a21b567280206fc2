# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Wrenches over a real graph: the node finds the mass, and its recording replays to the same result."""

import functools
import json
from pathlib import Path

from felt_trials import felt_trials, LIFTS, ROPE
import publisher
import pytest
from rclpy.parameter import Parameter
from ros_robot import python_process, robot_of, whole
from toy_command import one_worker
from wire import result_values

from dlo_calibration.cli import main as cli
from dlo_calibration.files.recording import write_records
from dlo_calibration.files.session import read_session, trial_records
from dlo_calibration.messages.codec import WRENCH
from dlo_calibration.ros.calibrator_node import CalibratorNode
from dlo_calibration.simulation.compiled import CompiledSimulator

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

FLAGS = {'evaluations': 40, 'seed': 3, 'workers': 1}


def simulator(_):
    return CompiledSimulator(nodes=21)


@pytest.fixture(scope='module')
def session(tmp_path_factory):
    """Give the path of a recorded session with wrenches, and one of an unknown hand."""
    path = tmp_path_factory.mktemp('felt') / 'felt.mcap'
    records = trial_records(felt_trials(1, lifts=LIFTS[:2]))
    write_records(path, records, None)
    return path


@pytest.mark.long
def test_a_robot_in_another_process_publishes_wrenches_and_the_recording_replays(
        ros_environment, tmp_path, session, capsys):
    with robot_of(ros_environment) as robot:
        robot.calibrator = CalibratorNode(
            functools.partial(simulator), context=robot.context, parameter_overrides=[
                Parameter(name, value=value) for name, value in {
                    **FLAGS, 'output_directory': str(tmp_path)}.items()])
        robot.executor.add_node(robot.calibrator)
        try:
            with python_process(ros_environment, str(Path(publisher.__file__)), str(session)):
                robot.until_status(trials='2')
                inputs = read_session(session).inputs
                robot.until(lambda: robot.calibrator.session.collecting.collector.trials[-1].forces)
                assert robot.call('start').success
                live = robot.until_result()
        finally:
            robot.calibrator.close()
    folder, = tmp_path.glob('dlo_session_*')
    assert sum(record.name == WRENCH for record in read_session(folder).inputs) == sum(
        record.name == WRENCH for record in inputs)
    values = result_values(live)
    assert values['mass']['physical_lower'] < ROPE['mass'] < values['mass']['physical_upper']
    assert values['flexibility']['physical_unit'] == 'N m^2'
    assert 'they tell the mass' in whole(live)['findings']

    assert cli.main(one_worker(['fit', str(folder), '--json']), simulator) == 0
    replayed = json.loads(capsys.readouterr().out)
    for name, estimate in replayed['parameters'].items():
        for key, value in estimate.items():
            assert repr(value) == repr(values[name][key]), (name, key)
