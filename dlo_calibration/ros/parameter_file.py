# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Parameter file: ``config/calibrator.yaml``, every parameter of the node with a comment.

The file is generated from the declarations of the options. When one of them changes, generate it again:

    python -m dlo_calibration.ros.parameter_file > config/calibrator.yaml
"""

from __future__ import annotations

import json
import sys
import textwrap

from dlo_calibration.calibration.declaration import Declaration
from dlo_calibration.calibration.options import declarations

HEAD = """\
All parameters of the node calibrator, with their defaults.  To change some, copy this file, edit the copy
(a parameter that you leave out keeps its default), and start the node with it:

    ros2 run dlo_calibration calibrator --ros-args --params-file my_calibrator.yaml
    ros2 launch dlo_calibration calibrator.launch.py params_file:=my_calibrator.yaml

The node does not start with an unknown name or a value out of range.

This file is generated:

    python -m dlo_calibration.ros.parameter_file > config/calibrator.yaml
"""


def parameter_file() -> str:
    """Return the text of the file."""
    head = ''.join(f'# {line}'.rstrip() + '\n' for line in HEAD.splitlines())
    return f'{head}\n/**:\n  ros__parameters:\n' + '\n'.join(_entry(d) for d in declarations())


def _entry(declaration: Declaration) -> str:
    """Return the lines of one option: what it is, its unit and range, its default."""
    text = declaration.description[0].upper() + declaration.description[1:] + '.'
    width = 100 - len('    # ')  # of a line without its indent
    lines = textwrap.wrap(text, width, break_on_hyphens=False)
    if allowed := _allowed(declaration):
        lines += textwrap.wrap(allowed, width, subsequent_indent='  ')
    value = list(declaration.default) if isinstance(declaration.default, tuple) else declaration.default
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
    sys.stdout.write(parameter_file())
