# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""TableFrame: where the frame of the chains is in a named frame, as the transforms of tf2 tell."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.time import Time

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.model.pose import NUMBERS, Pose


class TableFrame:
    """
    The pose for an option `frame_pose` that is the name of the table's frame.

    It is looked up once, for the frame of the first message: the camera does not move.

    :param node: listens to ``/tf`` and ``/tf_static`` from the first name on.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._buffer: Any = None
        self._listener: Any = None
        self._name: str | None = None
        self.pose: Pose | None = None

    @property
    def missing(self) -> bool:
        """Whether a pose is wanted and not known yet."""
        return self._name is not None and self.pose is None

    def choose(self, options: Options) -> None:
        """
        Take note of the options.

        :raises InputError: if they name a frame, and tf2_ros is not installed.
        """
        if options.table_frame is not None and self._buffer is None:
            try:
                from tf2_ros import Buffer, TransformListener
            except ImportError:
                raise InputError('parameter frame_pose', f'the name {options.table_frame!r}',
                                 f'the numbers {NUMBERS}, as tf2_ros is not installed',
                                 'give the pose, or install tf2_ros (ros-jazzy-tf2-ros-py)') from None
            self._buffer = Buffer()
            self._listener = TransformListener(self._buffer, self._node)
        self._name, self.pose = options.table_frame, None

    def applied(self, options: Options) -> Options:
        """Return the options with the pose in place of the name; empty as long as it is missing."""
        if options.table_frame is None:
            return options
        return replace(options, frame_pose='' if self.pose is None else str(self.pose))

    def look_up(self, frame: str) -> str:
        """Look up where the `frame` of the chains is in the table's; return a sentence about it."""
        from tf2_ros import TransformException

        try:
            found = self._buffer.lookup_transform(self._name, frame, Time()).transform
        except TransformException as error:
            return (f'parameter frame_pose: got no transform from {frame!r} to {self._name!r}, expected one '
                    f'on /tf or /tf_static; messages wait for it: publish it, or set the pose ({error})')
        self.pose = Pose(np.array([found.translation.x, found.translation.y, found.translation.z]),
                         np.array([found.rotation.x, found.rotation.y, found.rotation.z, found.rotation.w]))
        return f'{frame!r} is at {self.pose} in {self._name!r}, as tf2 tells: that is frame_pose'
