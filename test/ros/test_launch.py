# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What the launch file starts, and what RViz and Foxglove are set up to show, exists."""

import importlib.util
import json
from pathlib import Path
import re
import shutil
import subprocess
import sys
from types import ModuleType, SimpleNamespace

import pytest
from ruamel.yaml import YAML

from dlo_calibration.calibration.options import Options
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.files.intake import OUTPUT_TYPES
from dlo_calibration.messages.codec import bag_types, INPUT_TYPES
from dlo_calibration.ros import diagnostics

ROOT = Path(__file__).resolve().parents[2]
LAUNCH_FILE = ROOT / 'launch' / 'calibrator.launch.py'
RVIZ, FOXGLOVE = ROOT / 'config' / 'calibrator.rviz', ROOT / 'config' / 'foxglove_layout.json'
TOPICS = {f'/calibrator/{name}': kind for name, kind in {**INPUT_TYPES, **OUTPUT_TYPES}.items()}

#: Modules that launch files import, with the names used here; each becomes a record of how it was called.
LAUNCH_NAMES = {
    'launch': ['LaunchDescription'],
    'launch.actions': ['DeclareLaunchArgument'],
    'launch.conditions': ['IfCondition'],
    'launch.substitutions': ['LaunchConfiguration'],
    'launch_ros': [],
    'launch_ros.actions': ['Node'],
}


@pytest.fixture
def described(monkeypatch):
    """Give what the launch file describes, with launch replaced by records of its calls."""
    for module, names in LAUNCH_NAMES.items():
        replacement = ModuleType(module)
        for name in names:
            setattr(replacement, name, lambda *words, _name=name, **options: SimpleNamespace(
                kind=_name, words=words, options=options))
        monkeypatch.setitem(sys.modules, module, replacement)
    index = ModuleType('ament_index_python.packages')
    index.get_package_share_directory = {'dlo_calibration': str(ROOT)}.__getitem__
    monkeypatch.setitem(sys.modules, 'ament_index_python.packages', index)
    monkeypatch.setitem(sys.modules, 'ament_index_python', ModuleType('ament_index_python'))
    spec = importlib.util.spec_from_file_location('calibrator_launch', LAUNCH_FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description().words[0]


def test_launch_starts_the_node_with_its_parameter_file(described):
    arguments = {one.words[0]: one.options for one in described if one.kind == 'DeclareLaunchArgument'}
    node, = (one for one in described if one.kind == 'Node' and one.options['package'] == 'dlo_calibration')
    assert f"'{node.options['executable']} = " in (ROOT / 'setup.py').read_text(encoding='utf-8')
    assert node.options['name'] == 'calibrator'
    assert 'condition' not in node.options
    flag, file = node.options['ros_arguments']
    assert flag == '--params-file'
    assert Path(arguments[file.words[0]]['default_value']) == ROOT / 'config' / 'calibrator.yaml'


def test_launch_starts_rviz_only_where_it_is_asked_for(described):
    arguments = {one.words[0]: one.options for one in described if one.kind == 'DeclareLaunchArgument'}
    rviz, = (one for one in described if one.kind == 'Node' and one.options['package'] == 'rviz2')
    asked, = rviz.options['condition'].words
    assert arguments[asked.words[0]]['default_value'] == 'false'
    assert Path(rviz.options['arguments'][1]) == RVIZ
    assert rviz.options['arguments'][0] == '-d'


def test_launch_arguments_are_described(described):
    arguments = [one.options for one in described if one.kind == 'DeclareLaunchArgument']
    assert len(arguments) == 3
    assert all(one['description'] for one in arguments)


def test_ros2_launch_knows_the_launch_file(install):
    if shutil.which('ros2') is None:
        pytest.skip('the command ros2 is not installed')
    done = subprocess.run(
        ['sh', '-c', '. "$0" && exec ros2 launch dlo_calibration calibrator.launch.py --show-args',
         install / 'setup.sh'], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert 'params_file' in done.stdout


def rviz_displays():
    return YAML(typ='safe').load(RVIZ.read_text(encoding='utf-8'))['Visualization Manager']['Displays']


def test_rviz_shows_topics_of_the_contract_with_displays_of_their_types():
    shown = {one['Topic']['Value']: one['Class'] for one in rviz_displays() if 'Topic' in one}
    assert '/calibrator/markers' in shown
    for topic, display in shown.items():
        assert display.split('/')[1] == TOPICS[topic].split('/')[2]


def test_rviz_gets_markers_that_were_sent_before_it_started():
    markers, = (one for one in rviz_displays()
                if one.get('Topic', {}).get('Value') == '/calibrator/markers')
    assert markers['Topic']['Durability Policy'] == 'Transient Local'
    assert markers['Enabled'] is True


def texts(value):
    """List all texts in a JSON document, keys too."""
    if isinstance(value, dict):
        return [text for pair in value.items() for one in pair for text in texts(one)]
    if isinstance(value, list):
        return [text for one in value for text in texts(one)]
    return [value] if isinstance(value, str) else []


def foxglove_layout():
    return json.loads(FOXGLOVE.read_text(encoding='utf-8'))


def test_foxglove_shows_topics_of_the_contract():
    topics = {match[0] for text in texts(foxglove_layout()) if (match := re.match(r'/[\w/]+', text))}
    assert topics <= set(TOPICS)
    assert topics >= {f'/calibrator/{name}' for name in ('markers', 'progress', 'status', 'result')}


def test_foxglove_shows_every_panel_that_is_set_up_and_no_other():
    layout = foxglove_layout()
    named = {text for text in texts(layout['layout']) if '!' in text}
    assert named == set(layout['configById'])


def test_foxglove_plots_values_that_the_node_sends():
    best = Evaluation(0, None, dict.fromkeys(Options().calibrate, 50.0), (1.0,))
    message = diagnostics.progress(bag_types(), stamp=1, evaluation=best, best=best, evaluations=2,
                                   simulations_per_second=1.0, seconds_left=1.0,
                                   spread=dict.fromkeys(Options().calibrate, 1.0))
    sent = {(one.name, pair.key) for one in message.status for pair in one.values}
    plotted = {re.fullmatch(
        r'/calibrator/progress\.status\[:\]\{name=="(\w+)"\}\.values\[:\]\{key=="(\w+)"\}\.value',
        path['value']).groups()
        for panel in foxglove_layout()['configById'].values() for path in panel.get('paths', [])}
    assert plotted <= sent
    assert {('progress', f'{what}_{name}') for name in Options().calibrate
            for what in ('best', 'spread')} <= plotted
    assert {('progress', 'score'), ('progress', 'best_score')} <= plotted
