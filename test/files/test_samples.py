# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Every file of msg_samples says what its README says."""

from importlib.util import module_from_spec, spec_from_file_location
import itertools
import json
from pathlib import Path

from fitted import fitted
import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_typestore, Stores
from wire import wire
import yaml

from dlo_calibration.calibration.options import Options
from dlo_calibration.cli import main as cli
from dlo_calibration.files.chain_file import read_chain_file
from dlo_calibration.files.result import read_result
from dlo_calibration.files.session import read_session
from dlo_calibration.messages.codec import ACTION, bag_types, read, TRIAL_TYPES
from dlo_calibration.messages.collector import TrialCollector
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.planner import checked
from dlo_calibration.search import RandomSearch
from dlo_calibration.simulation.compiled import CompiledSimulator

pytestmark = pytest.mark.usefixtures('without_drawings', 'without_slices')

SAMPLES = Path(__file__).resolve().parents[2] / 'msg_samples'
DOCUMENTS = ('README.md', 'make_yaml.py', 'make_xml.py')
SESSIONS = sorted(file.parent for file in SAMPLES.glob('*/metadata.yaml'))
FIELDS = get_typestore(Stores.ROS2_JAZZY).fielddefs


def files(*folders):
    return {file for folder in folders for file in folder.rglob('*')
            if file.is_file() and '__pycache__' not in file.parts}


def message_file(kind):
    return SAMPLES / f'{kind}.yaml'


def filled(types, name, values):
    """Build a message of type `name` from a mapping, as ros2 topic pub does; nothing unknown is allowed."""
    def value(what, given):
        node, rest = what
        if node == Nodetype.NAME:
            return filled(types, rest, given)
        if node == Nodetype.SEQUENCE:
            element, _ = rest
            return types.octets(bytes(given)) if element == (Nodetype.BASE, ('uint8', 0)) else \
                [value(element, item) for item in given]
        return given

    fields = dict(FIELDS[name][1])
    assert values.keys() <= fields.keys()
    # What is left out is empty; anything else that is left out would be an error here.
    values = {**{key: [] for key, what in fields.items() if what[0] == Nodetype.SEQUENCE}, **values}
    return types.build(name, **{key: value(what, values[key]) for key, what in fields.items()})


def sample_messages(types):
    """Return the (kind, message object) of the YAML files, after a journey over the wire."""
    travel = wire(types)
    texts = {kind: message_file(kind).read_text(encoding='utf-8') for kind in TRIAL_TYPES}
    return [(kind, travel(filled(types, name, yaml.safe_load(texts[kind]))))
            for kind, name in TRIAL_TYPES.items()]


def sample_trials(messages):
    collector = TrialCollector(Options())
    for kind, message in messages:
        collector.add(read(kind, message))
    return collector.trials


def test_every_file_is_used():
    listed = {SAMPLES / 'README.md', *SAMPLES.glob('make_*.py'), *SAMPLES.glob('xml/*.xml')}
    listed |= {SAMPLES / 'photographs' / name
               for name in ('README.md', 'truth.json', 'first.jpg', 'second.jpg', 'third.jpg')}
    listed |= {SAMPLES / 'chains' / name for name in ('start.csv', 'goal.csv', 'hairpin.csv',
                                                   'around_posts.csv', 'posts.urdf')}
    assert files(SAMPLES) == listed | {message_file(kind) for kind in TRIAL_TYPES} | files(*SESSIONS)
    readme = (SAMPLES / 'README.md').read_text(encoding='utf-8')
    for name in ('make_yaml.py', *(f'{kind}.yaml' for kind in TRIAL_TYPES),
                 *(session.name for session in SESSIONS), 'photographs', 'chains'):
        assert name in readme


def test_the_chains_are_a_start_and_a_goal_for_the_dlo_of_the_description():
    description = read_result(SAMPLES / 'xml' / 'dlo.xml')
    start, goal = (read_chain_file(SAMPLES / 'chains' / name) for name in ('start.csv', 'goal.csv'))
    assert checked(description, start, goal, description.file_options.options(), PlanOptions())[0] is start
    assert start.length == pytest.approx(description.length, rel=0.01)
    assert goal.length == pytest.approx(description.length, rel=0.01)


def test_yaml_messages_in_any_order_are_one_complete_trial(types):
    for messages in itertools.permutations(sample_messages(types)):
        trial, = sample_trials(messages)
        goal, = trial.goals
        assert (len(trial.initial), [hand.grips for hand in trial.hands]) == (11, [(0,)])
        assert goal.stable and goal.held_by == ()


def test_yaml_messages_show_the_first_trial_of_object1(types):
    whole = read_session(SAMPLES / 'object1').messages[:len(TRIAL_TYPES)]
    for (kind, message), (expected_kind, expected) in zip(sample_messages(types), whole, strict=True):
        sample, original = read(kind, message), read(expected_kind, expected)
        assert (sample.kind, sample.stamp, sample.frame_id) == (
            original.kind, original.stamp, original.frame_id)
        if kind == ACTION:
            np.testing.assert_array_equal(sample.times, original.times)
            actual, wanted = sample.positions, original.positions
        else:
            np.testing.assert_array_equal(sample.chain.hands, original.chain.hands[::2])
            actual, wanted = sample.chain.points, original.chain.points[::2]
        np.testing.assert_allclose(actual, wanted, rtol=0, atol=0.501e-4)


def test_yaml_messages_calibrate():
    result = fitted(sample_trials(sample_messages(bag_types())), ParameterSpace(mass=0.03),
                    CompiledSimulator(nodes=12), RandomSearch(4, seed=1), budget=2)
    assert len(result.evaluations) == 2
    assert result.best.score < 100


@pytest.mark.parametrize('kind', TRIAL_TYPES)
def test_yaml_file_begins_with_its_command_which_the_readme_has(kind):
    command = ' '.join(line.lstrip('# ').rstrip('\\ ') for line in
                       message_file(kind).read_text(encoding='utf-8').split('\n')[:2])
    assert command == f'ros2 topic pub --once /calibrator/{kind} {TRIAL_TYPES[kind]} ' \
        f'"$(cat msg_samples/{kind}.yaml)"'
    assert f'    {command}\n' in (SAMPLES / 'README.md').read_text(encoding='utf-8')


def test_script_writes_the_yaml_files(tmp_path):
    spec = spec_from_file_location('make_yaml', SAMPLES / 'make_yaml.py')
    script = module_from_spec(spec)
    spec.loader.exec_module(script)
    assert script.main([str(SAMPLES / 'object1'), str(tmp_path)]) == 0
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {
        f'{kind}.yaml': message_file(kind).read_text() for kind in TRIAL_TYPES}


@pytest.mark.parametrize('folder', SESSIONS, ids=lambda folder: folder.name)
def test_session_is_complete(folder, capsys):
    assert cli.main(['info', str(folder), '--json']) == 0
    printed = json.loads(capsys.readouterr().out)
    assert len(printed['trials']) == 4
    assert printed['messages'] == {f'/calibrator/{kind}': 4 for kind in TRIAL_TYPES}
    assert (printed['problems'], printed['refusals']) == ([], [])
