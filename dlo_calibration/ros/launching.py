# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Launching: what both launch files check before they start anything; it imports neither ROS nor launch."""

from __future__ import annotations

from pathlib import Path
import sys
from typing import Iterable, Mapping, Sequence

from dlo_calibration.errors import InputError, meant


def check_arguments(file: str, known: Sequence[str], words: Sequence[str] | None = None) -> None:
    """
    Check the arguments of ``ros2 launch``, which itself ignores those that it does not know.

    :param file: the launch file; where another one includes it, the arguments are that one's.
    :param words: of the command line; None: of this process.
    :raises InputError: for an unknown name.
    """
    words = sys.argv if words is None else words
    if not any(Path(word).name == Path(file).name for word in words):
        return
    for word in words:
        name, given, _ = word.partition(':=')
        if given and name not in known:
            raise InputError(f'{Path(file).name}', f'the argument {name}', f'one of {", ".join(known)}',
                             meant(name, known, 'for another parameter, change a copy of the parameter '
                                   'file, and give it as params_file'))


def check_rviz(wanted: str) -> None:
    """
    Check, before a node is started that would be left alone, that RViz is there.

    :param wanted: the argument `rviz`.
    :raises InputError: if it is wanted and not installed.
    """
    if wanted == 'true':
        from ament_index_python.packages import get_package_share_directory

        try:
            get_package_share_directory('rviz2')
        except LookupError:
            raise InputError('rviz:=true', 'no package rviz2', 'it installed',
                             'install it (sudo apt install ros-jazzy-rviz2), or leave rviz out') from None


def flags(parameters: Mapping[str, str], topics: Mapping[str, str]) -> list[str]:
    """Return the ROS arguments for those parameters, and topics of a node, that are given."""
    return [*(word for name, value in parameters.items() if value for word in ('-p', f'{name}:={value}')),
            *(word for name, value in topics.items() if value for word in ('-r', f'~/{name}:={value}'))]


def shown(node: str, namespace: str, names: Iterable[str],
          topics: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the remappings with which RViz shows what a node in a namespace sends and hears."""
    place = f'/{namespace.strip("/")}/{node}' if namespace.strip('/') else f'/{node}'
    pairs = [(f'/{node}/{name}', topics.get(name) or f'{place}/{name}') for name in names]
    return [(old, new) for old, new in pairs if old != new]
