# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Launching: what the launch files describe, and what they check before they start anything."""

from __future__ import annotations

from pathlib import Path
import sys
from types import MappingProxyType
from typing import Any, Callable, Iterable, Mapping, Sequence

from dlo_calibration.capture.trials import FILM_ERRORS
from dlo_calibration.errors import InputError, suggestion


def node_and_rviz(file: str, node: str, *, parameters: Mapping[str, str], topics: Mapping[str, str],
                  shown: Sequence[str]) -> Any:
    """
    Return a LaunchDescription of a node with its parameter file, and of RViz if wanted.

    :param file: the launch file.
    :param parameters: those that are launch arguments, with their descriptions; empty: as the file says.
    :param topics: input topics that are launch arguments, likewise; empty: the node's own.
    :param shown: topics that RViz shows.
    :raises InputError: for an unknown argument, or where RViz is wanted and not installed.
    """
    from ament_index_python.packages import get_package_share_directory
    from launch.conditions import IfCondition
    from launch.substitutions import LaunchConfiguration
    from launch_ros.actions import Node

    config = Path(get_package_share_directory('dlo_calibration')) / 'config'
    arguments = {
        'params_file': (str(config / f'{node}.yaml'),
                        'parameters of the node; copy the default and change the copy'),
        'namespace': ('', 'namespace of the node'),
        **{name: ('', f'{words}; empty: as the parameter file says') for name, words in parameters.items()},
        **{name: ('', f"{words}; empty: the node's own") for name, words in topics.items()},
        'frame': ('world', 'frame_id of the chains, which RViz shows'),
    }
    def start(context: Any) -> list[Any]:
        value = {name: LaunchConfiguration(name).perform(context) for name in arguments}
        given = {name: value[name] for name in topics}
        return [
            Node(package='dlo_calibration', executable=node, name=node, output='screen',
                 namespace=value['namespace'],
                 # `parameters` would only warn if the file is missing; this ends the node with an error
                 ros_arguments=['--params-file', LaunchConfiguration('params_file'),
                                *flags({name: value[name] for name in parameters}, given)]),
            Node(package='rviz2', executable='rviz2', name='rviz2',
                 arguments=['-d', str(config / f'{node}.rviz'), '-f', LaunchConfiguration('frame')],
                 remappings=remapped(node, value['namespace'], shown, given),
                 condition=IfCondition(LaunchConfiguration('rviz'))),
        ]

    return _described(file, arguments, start)


#: Topic of the calibrator -> topic of the tracker, of what a camera sees of trials.
SEEN = {'initial_chain': 'initial_chain', 'action': 'action', 'goal_chain': 'chain'}


def tracker_and_calibrator(file: str, parameters: Mapping[str, str] = MappingProxyType({})) -> Any:
    """
    Return a LaunchDescription of the tracker, of a calibrator that hears it, and of RViz if wanted.

    :param file: the launch file.
    :param parameters: more of the calibrator's that are launch arguments, with their descriptions.
    :raises InputError: for an unknown argument, or where RViz is wanted and not installed.
    """
    from ament_index_python.packages import get_package_share_directory
    from launch.conditions import IfCondition
    from launch.substitutions import LaunchConfiguration
    from launch_ros.actions import Node

    config = Path(get_package_share_directory('dlo_calibration')) / 'config'
    arguments = {
        'params_file': (str(config / 'tracker.yaml'),
                        'parameters of the tracker; copy the default and change the copy'),
        'points': ('', 'rough clicks along the DLO in the first image; empty: as the parameter file says'),
        'image': ('', "topic of the images, uncompressed; empty: the tracker's own"),
        'compressed': ('', "topic of the images, compressed; empty: the tracker's own"),
        'camera_info': ('', "topic of the camera's calibration; empty: the tracker's own"),
        'depth': ('', "topic of the aligned depth; empty: the tracker's own"),
        'mass': ('', 'mass of the whole DLO [kg]; empty: unknown'),
        **{name: ('', f'{words}; empty: as the parameter file says') for name, words in parameters.items()},
        'frame': ('table', 'frame_id of the chains'),
    }
    def start(context: Any) -> list[Any]:
        value = {name: LaunchConfiguration(name).perform(context) for name in arguments}
        topics = {'image': value['image'], 'image/compressed': value['compressed'],
                  'camera_info': value['camera_info'], 'depth': value['depth']}
        return [
            Node(package='dlo_calibration', executable='tracker', name='tracker', output='screen',
                 ros_arguments=['--params-file', LaunchConfiguration('params_file'),
                                *flags({'points': value['points'], 'frame_id': value['frame']}, topics)]),
            Node(package='dlo_calibration', executable='calibrator', name='calibrator', output='screen',
                 ros_arguments=['--params-file', str(config / 'calibrator.yaml'), *flags(
                     {name: value[name] for name in ('mass', *parameters)} | {
                         name: str(size) for name, size in FILM_ERRORS.items()},
                     {name: f'/tracker/{of}' for name, of in SEEN.items()})]),
            Node(package='rviz2', executable='rviz2', name='rviz2',
                 arguments=['-d', str(config / 'tracker.rviz'), '-f', LaunchConfiguration('frame')],
                 condition=IfCondition(LaunchConfiguration('rviz'))),
        ]

    return _described(file, arguments, start)


def _described(file: str, arguments: Mapping[str, tuple[str, str]], start: Callable[[Any], list[Any]]) -> Any:
    """
    Return a LaunchDescription with arguments, each with its default and its words, and RViz if wanted.

    :param start: returns what to start; an argument that is empty is left out, which needs its value.
    """
    from launch import LaunchDescription
    from launch.actions import DeclareLaunchArgument, OpaqueFunction
    from launch.substitutions import LaunchConfiguration

    check_arguments(file, (*arguments, 'rviz'))

    def checked(context: Any) -> list[Any]:
        check_rviz(LaunchConfiguration('rviz').perform(context))
        return start(context)

    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=description)
          for name, (default, description) in arguments.items()),
        DeclareLaunchArgument('rviz', default_value='false', choices=['true', 'false'],
                              description='start RViz too (the package rviz2)'),
        OpaqueFunction(function=checked),
    ])


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
                             suggestion(name, known, 'for another parameter, change a copy of the parameter '
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


def remapped(node: str, namespace: str, names: Iterable[str],
             topics: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the remappings with which RViz shows what a node in a namespace sends and hears."""
    place = f'/{namespace.strip("/")}/{node}' if namespace.strip('/') else f'/{node}'
    pairs = [(f'/{node}/{name}', topics.get(name) or f'{place}/{name}') for name in names]
    return [(old, new) for old, new in pairs if old != new]
