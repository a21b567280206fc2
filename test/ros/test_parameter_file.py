# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The parameter file has every parameter with its default and a comment, and the node starts with it."""

from pathlib import Path
import subprocess
import sys

import pytest
import yaml

from dlo_calibration.ros.calibrator_options import CalibratorOptions
from dlo_calibration.ros.node_session import NO_TEXTS
from dlo_calibration.ros.parameter_file import NODES, parameter_file

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / 'config' / 'calibrator.yaml'
DECLARED = [(node, declaration) for node, kind in NODES.items() for declaration in kind.declarations()]


def test_file_is_what_the_documented_command_makes():
    command = [sys.executable, '-m', 'dlo_calibration.ros.parameter_file', 'calibrator']
    done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    assert done.stdout == FILE.read_text(encoding='utf-8')
    for node in NODES:
        assert parameter_file(node) == (ROOT / 'config' / f'{node}.yaml').read_text(encoding='utf-8'), \
            f'make it again: python -m dlo_calibration.ros.parameter_file {node} > config/{node}.yaml'


@pytest.mark.parametrize('node, kind', NODES.items(), ids=NODES)
def test_file_has_every_parameter_with_its_default(node, kind):
    values = yaml.safe_load(parameter_file(node))['/**']['ros__parameters']
    assert list(values) == [declaration.name for declaration in kind.declarations()]
    for declaration in kind.declarations():
        value = values[declaration.name]
        assert type(value) is (list if isinstance(declaration.default, tuple) else type(declaration.default))
    assert kind.of({name: [] if value == NO_TEXTS else value for name, value in values.items()}) == kind()


@pytest.mark.parametrize('node, declaration', DECLARED, ids=lambda value: getattr(value, 'name', value))
def test_comments_give_meaning_unit_and_range(node, declaration):
    lines = parameter_file(node).splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith(f'    {declaration.name}: '))
    comment = []
    while (line := lines[at - 1 - len(comment)]).startswith('    # '):
        comment.insert(0, line[len('    # '):].strip())
    text = ' '.join(comment)
    assert declaration.description[1:] in text
    assert declaration.unit in text
    for choice in declaration.choices:
        assert choice in text
    if declaration.minimum is not None:
        assert f'{declaration.minimum:g} to ' in text
        low, high = text.split('From ')[-1].split(' to ')
        assert float(low) == declaration.minimum
        assert float(high.rstrip('.').split()[0]) == pytest.approx(declaration.maximum, rel=1e-5)


def test_no_line_is_too_long_to_read():
    assert max(len(line) for node in NODES for line in parameter_file(node).splitlines()) <= 110


def test_node_starts_with_the_file_and_uses_its_changed_values(ros_environment, tmp_path):
    rclpy = pytest.importorskip('rclpy', reason='needs ROS 2, sourced or from PyPI')
    pytest.importorskip('diagnostic_msgs', reason='needs the message packages common_interfaces')
    from rclpy.context import Context
    from rclpy.signals import SignalHandlerOptions

    from dlo_calibration.ros.calibrator_node import CalibratorNode

    text = FILE.read_text(encoding='utf-8').replace('output_directory: "."',
                                                    f'output_directory: "{tmp_path}"')
    changed = text.replace('evaluations: 0', 'evaluations: 7').replace(
        '    mass: 0.0', '    mass: 0.25')
    for name, content, expected in (
            ('same.yaml', text, {}), ('changed.yaml', changed, {'evaluations': 7, 'mass': 0.25})):
        (tmp_path / name).write_text(content, encoding='utf-8')
        context = Context()
        rclpy.init(args=['--ros-args', '--params-file', str(tmp_path / name)], context=context,
                   signal_handler_options=SignalHandlerOptions.NO)
        try:
            node = CalibratorNode(context=context)
            assert node.options() == CalibratorOptions.of({'output_directory': str(tmp_path), **expected})
            node.close()
        finally:
            context.try_shutdown()
