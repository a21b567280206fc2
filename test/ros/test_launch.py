# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What the launch files start, and what RViz and Foxglove are set up to show, exists."""

import importlib.util
import json
from pathlib import Path
import re
import shutil
import subprocess
import sys
from types import ModuleType, SimpleNamespace

from made_up_dlo import made_up_plan
import pytest
import yaml

from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.messages.codec import bag_types, INPUT_TYPES, OUTPUT_TYPES
from dlo_calibration.model.parameters import PAPER_PARAMETERS
from dlo_calibration.planning import PlanProgress
from dlo_calibration.ros import diagnostics, launching, planner_session, tracker_session
from dlo_calibration.workspace.worker import Progress

ROOT = Path(__file__).resolve().parents[2]
FOXGLOVE = {'calibrator': ROOT / 'config' / 'foxglove_layout.json',
            'planner': ROOT / 'config' / 'planner_foxglove_layout.json'}
TOPICS = {f'/{node}/{name}': kind for node, types in (
    ('calibrator', {**INPUT_TYPES, **OUTPUT_TYPES}),
    ('planner', {**planner_session.INPUT_TYPES, **planner_session.OUTPUT_TYPES}))
    for name, kind in types.items()}
#: Topics that both viewers show, or Foxglove alone.
SHOWN = {'calibrator': ('markers', 'progress', 'status', 'result'),
         'planner': ('markers', 'progress', 'status', 'chain', 'goal_chain', 'action', 'steps')}

#: Modules that launch files import, with the names used here; each becomes a record of how it was called.
LAUNCH_NAMES = {
    'launch': ['LaunchDescription'],
    'launch.actions': ['DeclareLaunchArgument', 'OpaqueFunction'],
    'launch.conditions': ['IfCondition'],
    'launch.substitutions': ['LaunchConfiguration'],
    'launch_ros': [],
    'launch_ros.actions': ['Node'],
}


@pytest.fixture(params=['calibrator', 'planner'])
def node(request):
    """Give the name of a node."""
    return request.param


@pytest.fixture
def described(node, monkeypatch):
    """Give what the launch file of a node describes without any argument."""
    return launched(node, monkeypatch)


def launched(node, monkeypatch, **given):
    """Return what the launch file of a node describes, with launch replaced by records of its calls."""
    for module, names in LAUNCH_NAMES.items():
        replacement = ModuleType(module)
        for name in names:
            setattr(replacement, name, lambda *words, _name=name, **options: SimpleNamespace(
                kind=_name, words=words, options=options, perform=lambda context: context[words[0]]))
        monkeypatch.setitem(sys.modules, module, replacement)
    index = ModuleType('ament_index_python.packages')
    index.get_package_share_directory = {'dlo_calibration': str(ROOT)}.__getitem__
    monkeypatch.setitem(sys.modules, 'ament_index_python.packages', index)
    monkeypatch.setitem(sys.modules, 'ament_index_python', ModuleType('ament_index_python'))
    spec = importlib.util.spec_from_file_location(
        f'{node}_launch', ROOT / 'launch' / f'{node}.launch.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    description = module.generate_launch_description().words[0]
    context = {**{entity.words[0]: entity.options['default_value'] for entity in description
                  if entity.kind == 'DeclareLaunchArgument'}, **given}
    return [action for entity in description for action in (
        entity.options['function'](context) if entity.kind == 'OpaqueFunction' else [entity])]


def declared(entities):
    """Return the options of the launch arguments, by name."""
    return {entity.words[0]: entity.options for entity in entities if entity.kind == 'DeclareLaunchArgument'}


def test_launch_starts_the_node_with_its_parameter_file(node, described):
    arguments = declared(described)
    started, = (entity for entity in described
                if entity.kind == 'Node' and entity.options['package'] == 'dlo_calibration')
    assert f"f'{started.options['executable']} = " in (ROOT / 'setup.py').read_text(encoding='utf-8')
    assert started.options['name'] == started.options['executable'] == node
    assert 'condition' not in started.options
    flag, file = started.options['ros_arguments']
    assert flag == '--params-file'
    assert Path(arguments[file.words[0]]['default_value']) == ROOT / 'config' / f'{node}.yaml'


def test_launch_passes_a_description_on(monkeypatch):
    started, = (entity for entity in launched('planner', monkeypatch, description='some/result.xml')
                if entity.kind == 'Node' and entity.options['package'] == 'dlo_calibration')
    assert started.options['ros_arguments'][2:] == ['-p', 'description:=some/result.xml']


def test_the_launch_file_of_the_tracker_starts_a_calibrator_that_hears_it(monkeypatch):
    started = {entity.options['name']: entity.options for entity in launched(
        'tracker', monkeypatch, image='/camera/image_raw', points='1,2 3,4', mass='0.03')
        if entity.kind == 'Node'}
    assert set(started) == {'tracker', 'calibrator', 'rviz2'}
    assert 'condition' in started['rviz2']
    words = started['tracker']['ros_arguments']
    assert ['-r', '~/image:=/camera/image_raw'] == words[words.index('-r'):][:2]
    assert 'points:=1,2 3,4' in words
    heard = started['calibrator']['ros_arguments']
    assert {'~/initial_chain:=/tracker/initial_chain', '~/action:=/tracker/action',
            '~/goal_chain:=/tracker/chain', 'mass:=0.03'} <= set(heard)
    shown = (ROOT / 'config' / 'tracker.rviz').read_text(encoding='utf-8')
    assert {f'/tracker/{name}' for name in tracker_session.OUTPUT_TYPES} >= set(
        re.findall(r'Value: (/tracker/.*)', shown))


def test_the_launch_file_of_a_self_calibration_passes_on_what_is_wanted_and_the_limits(monkeypatch):
    given = {'wanted': 'flexibility 2, friction 3', 'reach_1': 'annulus 0 0 0.2 0.8', 'height': '0.1',
             'resume': 'dlo_session_1'}
    started = {entity.options['name']: entity.options['ros_arguments'] for entity in launched(
        'self_calibration', monkeypatch, image='/camera/image_raw', **given)
        if entity.kind == 'Node' and entity.options['name'] != 'rviz2'}
    assert set(started) == {'tracker', 'calibrator'}
    assert {f'{name}:={value}' for name, value in given.items()} <= set(started['calibrator'])
    assert '~/goal_chain:=/tracker/chain' in started['calibrator']
    assert not any(word.startswith('hands:=') for word in started['calibrator'])


def test_launch_starts_rviz_only_where_it_is_asked_for(node, described):
    arguments = declared(described)
    rviz, = (entity for entity in described if entity.kind == 'Node' and entity.options['package'] == 'rviz2')
    asked, = rviz.options['condition'].words
    assert arguments[asked.words[0]]['default_value'] == 'false'
    assert Path(rviz.options['arguments'][1]) == ROOT / 'config' / f'{node}.rviz'
    assert rviz.options['arguments'][0] == '-d'


def test_launch_arguments_are_described(node, described):
    arguments = declared(described)
    assert set(arguments) == {'params_file', 'namespace', 'goal_chain', 'rviz', 'frame', *(
        ['description', 'chain'] if node == 'planner' else ['mass', 'table_height'])}
    assert all(options['description'] for options in arguments.values())


def test_launch_passes_arguments_on_and_rviz_shows_the_topics(node, monkeypatch):
    monkeypatch.setattr(launching, 'check_rviz', lambda wanted: None)
    given = {'namespace': 'left', 'goal_chain': '/trackdlo/results_pc', 'rviz': 'true'}
    if node == 'calibrator':
        given |= {'mass': '0.03', 'table_height': '0.7'}
    started = {entity.options['package']: entity.options for entity in launched(node, monkeypatch, **given)
               if entity.kind == 'Node'}
    words = started['dlo_calibration']['ros_arguments'][2:]
    assert words[-2:] == ['-r', '~/goal_chain:=/trackdlo/results_pc']
    assert words[:-2] == (['-p', 'mass:=0.03', '-p', 'table_height:=0.7'] if node == 'calibrator' else [])
    assert started['dlo_calibration']['namespace'] == 'left'
    topics = {display['Topic']['Value'] for display in rviz_displays(node) if 'Topic' in display}
    remapped = dict(started['rviz2']['remappings'])
    assert set(remapped) == topics
    assert remapped[f'/{node}/goal_chain'] == '/trackdlo/results_pc'
    assert remapped[f'/{node}/markers'] == f'/left/{node}/markers'


def test_launch_is_refused_if_rviz_is_wanted_and_not_installed(node, monkeypatch):
    with pytest.raises(InputError, match='rviz:=true: no package rviz2; .*apt install'):
        launched(node, monkeypatch, rviz='true')


def test_launch_refuses_an_argument_that_it_does_not_know_and_lists_the_others(node, monkeypatch):
    command = ['/opt/ros/jazzy/bin/ros2', 'launch', 'dlo_calibration', f'{node}.launch.py', 'rviz:=false']
    monkeypatch.setattr(sys, 'argv', command)
    launched(node, monkeypatch)
    monkeypatch.setattr(sys, 'argv', [*command, 'tabel_height:=0.7'])
    with pytest.raises(InputError, match='argument tabel_height; expected one of params_file, .*goal_chain'):
        launched(node, monkeypatch)
    monkeypatch.setattr(sys, 'argv', [*command, 'namspace:=left'])
    with pytest.raises(InputError, match=r'did you mean namespace\?'):
        launched(node, monkeypatch)
    # The arguments of another launch file, which includes this one, are its own.
    monkeypatch.setattr(sys, 'argv', ['ros2', 'launch', 'cell', 'cell.launch.py', 'robot:=left'])
    launched(node, monkeypatch)


@pytest.mark.long
def test_ros2_launch_knows_the_launch_file(node, install):
    if shutil.which('ros2') is None:
        pytest.skip('the command ros2 is not installed')
    done = subprocess.run(
        ['sh', '-c', '. "$0" && exec ros2 launch dlo_calibration "$1".launch.py --show-args',
         install / 'setup.sh', node], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert 'params_file' in done.stdout


def rviz_displays(node):
    text = (ROOT / 'config' / f'{node}.rviz').read_text(encoding='utf-8')
    return yaml.safe_load(text)['Visualization Manager']['Displays']


def test_rviz_shows_topics_of_the_contract_with_displays_of_their_types(node):
    shown = {display['Topic']['Value']: display['Class']
             for display in rviz_displays(node) if 'Topic' in display}
    assert f'/{node}/markers' in shown
    for topic, display in shown.items():
        assert display.split('/')[1] == TOPICS[topic].split('/')[2]


def test_rviz_gets_markers_that_were_sent_before_it_started(node):
    markers, = (display for display in rviz_displays(node)
                if display.get('Topic', {}).get('Value') == f'/{node}/markers')
    assert markers['Topic']['Durability Policy'] == 'Transient Local'
    assert markers['Enabled'] is True


def texts(value):
    """List all texts in a JSON document, keys too."""
    if isinstance(value, dict):
        return [text for pair in value.items() for part in pair for text in texts(part)]
    if isinstance(value, list):
        return [text for item in value for text in texts(item)]
    return [value] if isinstance(value, str) else []


def foxglove_layout(node):
    return json.loads(FOXGLOVE[node].read_text(encoding='utf-8'))


def test_foxglove_shows_topics_of_the_contract(node):
    topics = {match[0] for text in texts(foxglove_layout(node)) if (match := re.match(r'/[\w/]+', text))}
    assert topics <= set(TOPICS)
    assert topics >= {f'/{node}/{name}' for name in SHOWN[node]}


def test_foxglove_shows_every_panel_that_is_set_up_and_no_other(node):
    layout = foxglove_layout(node)
    named = {text for text in texts(layout['layout']) if '!' in text}
    assert named == set(layout['configById'])


def test_foxglove_plots_values_that_the_node_sends():
    best = Evaluation(0, None, dict.fromkeys(PAPER_PARAMETERS, 50.0), (1.0,))
    progress = Progress(2, 1)
    progress.take(best)
    message = diagnostics.progress(bag_types(), progress, 1)
    plotted = foxglove_plots('calibrator')
    assert plotted <= sent('progress', message)
    assert {('progress', 'progress', f'{what}_{name}') for name in PAPER_PARAMETERS
            for what in ('best', 'spread')} <= plotted
    assert {('progress', 'progress', 'score'), ('progress', 'progress', 'best_score')} <= plotted


def test_foxglove_plots_values_that_the_planner_sends():
    types = bag_types()
    progress = diagnostics.plan_progress(types, PlanProgress(1, 10, 20, 0.01, 1.0), 1)
    status = diagnostics.planner_status(types, 1, {'state': 'done', 'detail': ''}, made_up_plan())
    plotted = foxglove_plots('planner')
    assert plotted <= sent('progress', progress) | sent('status', status)
    assert {('progress', 'progress', 'best_error_mm'), ('status', 'status', 'error_after_mm')} <= plotted


def sent(topic, message):
    return {(topic, status.name, pair.key) for status in message.status for pair in status.values}


def foxglove_plots(node):
    """List (topic, name of the status, key) of everything that is plotted."""
    return {re.fullmatch(
        rf'/{node}/(\w+)\.status\[:\]\{{name=="(\w+)"\}}\.values\[:\]\{{key=="(\w+)"\}}\.value',
        path['value']).groups()
        for panel in foxglove_layout(node)['configById'].values() for path in panel.get('paths', [])}
