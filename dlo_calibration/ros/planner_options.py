# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""PlannerOptions: the parameters of the node `planner`, which are the options of a plan and its own."""

from __future__ import annotations

from dataclasses import dataclass

from dlo_calibration.calibration.declaration import declared, MACHINE
from dlo_calibration.errors import InputError
from dlo_calibration.planning.options import PlanOptions

PLAN, PUBLISH = 'plan', 'publish'  # modes


@dataclass(frozen=True)
class PlannerOptions(PlanOptions):
    """Everything that a user of the node can set; `description` and `mode` are its own."""

    description: str = declared(
        '', 'path of the result.xml of the DLO, relative to the working directory, which the node then '
        'publishes on ~/dlo_description; empty: the document that comes there', of=MACHINE)
    mode: str = declared(
        PLAN, 'plan: make plans; publish: only serve the description on ~/dlo_description, latched, as '
        'robot_description is served', choices=(PLAN, PUBLISH), of=MACHINE)

    def check_together(self) -> None:
        """
        Check options that depend on one another.

        :raises InputError: if there is nothing to publish.
        """
        if self.mode == PUBLISH and not self.description:
            raise InputError('parameter description', 'an empty text', 'a path, in the mode publish',
                             'name the result.xml to publish')
