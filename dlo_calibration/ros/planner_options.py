# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""PlannerOptions: the parameters of the node `planner`, which are the options of a plan and its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping

from dlo_calibration.calibration.declaration import Declaration, declared, MACHINE
from dlo_calibration.calibration.options import declarations, Options
from dlo_calibration.errors import InputError
from dlo_calibration.model.pose import Pose
from dlo_calibration.planning.options import PlanOptions

PLAN, PUBLISH = 'plan', 'publish'  # modes
#: Options of the simulation that may replace those of the description.
SIMULATION = ('table', 'table_height', 'scene', 'engine', 'nodes', 'time_step', 'stable_distance',
              'stable_time', 'settle_limit', 'answer_limit')
WORDS = {'true': True, 'false': False}


@dataclass(frozen=True)
class PlannerOptions(PlanOptions):
    """Everything that a user of the node can set, with what a plan alone does not have."""

    description: str = declared(
        '', 'path of the result.xml of the DLO, relative to the working directory, which the node then '
        'publishes on ~/dlo_description; empty: the document that comes there', of=MACHINE)
    mode: str = declared(
        PLAN, 'what the node does: plan makes plans; publish only serves the description on '
        '~/dlo_description, latched, as robot_description is served', choices=(PLAN, PUBLISH), of=MACHINE)
    frame_pose: str = declared(
        '', "pose of the chains' frame in the table's frame, whose z is up: x y z [m] and a quaternion qx qy "
        'qz qw; plans are in the frame of the chains, too, while reach and no_go are in that of the table; '
        'empty: that of the description, with which the calibrator read the chains', of=MACHINE)
    simulation: tuple[str, ...] = declared(
        (), "options of the simulation that replace those of the description, each 'name=value', e.g. "
        f"'table_height=0.72'; the names are {', '.join(SIMULATION)}", of=MACHINE)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.frame_pose:
            Pose.of(self.frame_pose)
        self.replacing()

    def replacing(self) -> Mapping[str, Any]:
        """
        Return the options that replace those of the description, by name.

        :raises InputError: for an unknown name or a bad value.
        """
        known = {one.name: one for one in declarations() if one.name in SIMULATION}
        found: dict[str, Any] = {}
        for text in self.simulation:
            name, equals, value = text.partition('=')
            if not equals or name not in known:
                raise InputError('parameter simulation', repr(text), "'name=value' with a name out of "
                                 f'{", ".join(SIMULATION)}', 'correct it')
            found[name] = _read(known[name], value)
        Options.of(found)
        return {**found, 'frame_pose': self.frame_pose} if self.frame_pose else found

    def check_together(self) -> None:
        """
        Check options that depend on one another.

        :raises InputError: if there is nothing to publish.
        """
        if self.mode == PUBLISH and not self.description:
            raise InputError('parameter description', 'an empty text', 'a path, in the mode publish',
                             'name the result.xml to publish')


def _read(declaration: Declaration, text: str) -> Any:
    """Return the value of an option that a text gives; as it stands, where it has not the option's type."""
    kind = type(declaration.default)
    try:
        return WORDS[text] if kind is bool else kind(text)
    except (KeyError, ValueError):
        return text
