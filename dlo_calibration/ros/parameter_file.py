# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Parameter file: ``config/calibrator.yaml`` or that of another node, every parameter with a comment.

The files are generated from the declarations of the options. When one of them changes, generate them again:

    python -m dlo_calibration.ros.parameter_file calibrator > config/calibrator.yaml
    python -m dlo_calibration.ros.parameter_file planner > config/planner.yaml
    python -m dlo_calibration.ros.parameter_file tracker > config/tracker.yaml
"""

from __future__ import annotations

import json
import sys
import textwrap
from typing import Mapping

from dlo_calibration.calibration.options import Declaration, DeclaredOptions
from dlo_calibration.ros.calibrator_options import CalibratorOptions
from dlo_calibration.ros.node_session import NO_TEXTS
from dlo_calibration.ros.planner_session import PlannerOptions
from dlo_calibration.ros.tracker_session import TrackerOptions

#: name of a node -> its options
NODES: Mapping[str, type[DeclaredOptions]] = {
    'calibrator': CalibratorOptions, 'planner': PlannerOptions, 'tracker': TrackerOptions}

HEAD = """\
All parameters of the node {node}, with their defaults.  To change some, copy this file, edit the copy
(a parameter that you leave out keeps its default), and start the node with it:

    ros2 run dlo_calibration {node} --ros-args --params-file my_{node}.yaml
    ros2 launch dlo_calibration {node}.launch.py params_file:=my_{node}.yaml

The node does not start with an unknown name or a value out of range.

This file is generated:

    python -m dlo_calibration.ros.parameter_file {node} > config/{node}.yaml
"""


def parameter_file(node: str) -> str:
    """Return the text of the file of a node in NODES."""
    head = ''.join(f'# {line}'.rstrip() + '\n' for line in HEAD.format(node=node).splitlines())
    return f'{head}\n/**:\n  ros__parameters:\n' + '\n'.join(
        _entry(declaration) for declaration in NODES[node].declarations())


def _entry(declaration: Declaration) -> str:
    """Return the lines of one option: what it is, its unit and range, its default."""
    text = declaration.description[0].upper() + declaration.description[1:] + '.'
    width = 100 - len('    # ')  # of a line without its indent
    lines = textwrap.wrap(text, width, break_on_hyphens=False)
    if allowed := _allowed(declaration):
        lines += textwrap.wrap(allowed, width, subsequent_indent='  ')
    value = list(declaration.default) if isinstance(declaration.default, tuple) else declaration.default
    if value == []:
        value = NO_TEXTS
        lines.append('An empty list is written [""].')
    # JSON is valid YAML, and its types are unambiguous.
    return ''.join(f'    # {line}\n' for line in lines) + f'    {declaration.name}: {json.dumps(value)}\n'


def _allowed(declaration: Declaration) -> str:
    """Say in words which values an option may have."""
    if declaration.choices:
        some = 'Any of' if isinstance(declaration.default, tuple) else 'One of'
        return f'{some}: {", ".join(declaration.choices)}.'
    if declaration.minimum is None or declaration.maximum is None:
        return ''
    low, high = ((f'{bound:g}' if isinstance(declaration.default, float) else f'{bound:.0f}')
                 for bound in (declaration.minimum, declaration.maximum))
    return f'From {low} to {high} {declaration.unit}'.rstrip() + '.'


if __name__ == '__main__':
    sys.stdout.write(parameter_file(*sys.argv[1:]))
