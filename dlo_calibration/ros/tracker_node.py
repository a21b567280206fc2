# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The node `tracker`: subscriptions, publishers, services and a timer around a `TrackerSession`."""

from __future__ import annotations

import functools
from typing import Any, Sequence

from std_srvs.srv import Trigger

from dlo_calibration.ros.graph_node import GraphNode
from dlo_calibration.ros.tracker_session import INPUT_TYPES, OUTPUT_TYPES, TrackerOptions, TrackerSession


class TrackerNode(GraphNode[TrackerOptions]):
    """
    The node `tracker`; it is the `NodeInterface` of its session.

    :param arguments: of `rclpy.node.Node`, e.g. `parameter_overrides`.
    :raises InputError: for a parameter with an unknown name or a bad value.
    """

    queue = 2  # images that wait; older ones are of no use

    def __init__(self, **arguments: Any) -> None:
        super().__init__('tracker', TrackerOptions, INPUT_TYPES, **arguments)
        self.session: TrackerSession | None = None
        try:
            for name, kind in OUTPUT_TYPES.items():
                self.offer(name, kind, latched=name == 'status')
            self.session = TrackerSession(self, self.types)
            self.subscribe(*INPUT_TYPES)
            for name in self.session.requests:
                self.create_service(Trigger, f'~/{name}', functools.partial(self.serve, name))
            self.serve_parameters()
        except BaseException:
            self.close()
            raise

    def changed(self, names: Sequence[str], options: TrackerOptions) -> None:
        """Find the DLO anew with other parameters, from the next image on."""
        if self.session is not None:
            self.session.begin(options)
