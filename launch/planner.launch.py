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


def planner(context):
    """Describe the node; its parameter for the description can only be left out where its value is known."""
    path = LaunchConfiguration('description').perform(context)
    return [Node(package='dlo_calibration', executable='planner', name='planner', output='screen',
                 # `parameters` would only warn if the file is missing; this ends the node with an error
                 ros_arguments=['--params-file', LaunchConfiguration('params_file'),
                                *(['-p', f'description:={path}'] if path else [])])]


def generate_launch_description():
    """Describe what to start."""
    config = Path(get_package_share_directory('dlo_calibration')) / 'config'
    return LaunchDescription([
        DeclareLaunchArgument(
            'params_file', default_value=str(config / 'planner.yaml'),
            description='parameters of the node; copy the default and change the copy'),
        DeclareLaunchArgument(
            'description', default_value='',
            description='path of a result.xml; empty: as the parameter file says'),
        DeclareLaunchArgument('rviz', default_value='false', choices=['true', 'false'],
                              description='start RViz too (the package rviz2)'),
        DeclareLaunchArgument('frame', default_value='world',
                              description='frame_id of the chains, which RViz shows'),
        OpaqueFunction(function=planner),
        Node(package='rviz2', executable='rviz2', name='rviz2',
             arguments=['-d', str(config / 'planner.rviz'), '-f', LaunchConfiguration('frame')],
             condition=IfCondition(LaunchConfiguration('rviz'))),
    ])
