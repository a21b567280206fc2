# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Start the planner with its parameter file, and RViz if wanted.

    ros2 launch dlo_calibration planner.launch.py description:=result.xml rviz:=true
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from dlo_calibration.ros.launching import check_arguments, check_rviz, flags, shown

CONFIG = Path(get_package_share_directory('dlo_calibration')) / 'config'
ARGUMENTS = {
    'params_file': (str(CONFIG / 'planner.yaml'),
                    'parameters of the node; copy the default and change the copy'),
    'namespace': ('', 'namespace of the node'),
    'description': ('', 'path of a result.xml; empty: as the parameter file says'),
    'chain': ('', "topic of the chains, e.g. a tracker's; empty: the node's own"),
    'goal_chain': ('', "topic of the goal chain; empty: the node's own"),
    'frame': ('world', 'frame_id of the chains, which RViz shows'),
}


def start(context):
    """Describe what to start; an argument that is empty is left out, which needs its value."""
    value = {name: LaunchConfiguration(name).perform(context) for name in (*ARGUMENTS, 'rviz')}
    check_rviz(value['rviz'])
    parameters = {'description': value['description']}
    topics = {name: value[name] for name in ('chain', 'goal_chain')}
    return [
        Node(package='dlo_calibration', executable='planner', name='planner', output='screen',
             namespace=value['namespace'],
             # `parameters` would only warn if the file is missing; this ends the node with an error
             ros_arguments=['--params-file', LaunchConfiguration('params_file'), *flags(parameters, topics)]),
        Node(package='rviz2', executable='rviz2', name='rviz2',
             arguments=['-d', str(CONFIG / 'planner.rviz'), '-f', LaunchConfiguration('frame')],
             remappings=shown('planner', value['namespace'], ('markers', 'chain', 'goal_chain'), topics),
             condition=IfCondition(LaunchConfiguration('rviz'))),
    ]


def generate_launch_description():
    """Describe the arguments, and what to start."""
    check_arguments(__file__, (*ARGUMENTS, 'rviz'))
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=description)
          for name, (default, description) in ARGUMENTS.items()),
        DeclareLaunchArgument('rviz', default_value='false', choices=['true', 'false'],
                              description='start RViz too (the package rviz2)'),
        OpaqueFunction(function=start),
    ])
