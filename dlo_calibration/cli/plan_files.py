# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The files of a plan: what `plan --output` writes into a folder."""

from __future__ import annotations

from contextlib import closing, suppress
from itertools import count
import json
from pathlib import Path

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import unwritable
from dlo_calibration.files.chain_file import write_chain
from dlo_calibration.files.request import Request, TrialRequest, write_request
from dlo_calibration.files.result import Description
from dlo_calibration.model.chain import Chain
from dlo_calibration.planning.dlo import Posterior
from dlo_calibration.planning.plain import plain_plan
from dlo_calibration.planning.plan import Plan
from dlo_calibration.planning.rehearsal import in_turn, Step
from dlo_calibration.writing import Attempts, whole

PLAN = 'plan'  # begins the names of files
OF_PLACE = ('table', 'table_height')  # options that say where the DLO lies


def write_plan_files(folder: Path, plan: Plan, found: Description, simulation: Options,
                     make_simulator: SimulatorFactory) -> None:
    """
    Write a plan to a folder, as far as possible, instead of an older one.

    :raises DloCalibrationError: if files cannot be written; the others are.
    """
    from dlo_calibration.report.plan_drawing import write_plan_animation, write_plan_picture

    _remove_older(folder)
    attempts = Attempts(folder)
    path = folder / PLAN
    with attempts.attempt(f'{PLAN}.json'), whole(path.with_suffix('.json')) as new:
        new.write_text(f'{json.dumps(plain_plan(plan), indent=2, allow_nan=False)}\n', encoding='utf-8')
    for k, one in enumerate(plan.actions, start=1):
        with attempts.attempt(f'after_{k}.csv'):
            write_chain(folder / f'after_{k}.csv', Chain(one.predicted))
    if plan.actions:
        with attempts.attempt(f'{PLAN}.xml'):
            write_request(path.with_suffix('.xml'), plan_request(plan, found, simulation))
    with attempts.attempt(f'{PLAN}.png'):
        write_plan_picture(plan, path.with_suffix('.png'))
    if plan.actions:
        with attempts.attempt(f'{PLAN}.gif'), closing(make_simulator(simulation)) as simulator:
            write_plan_animation(plan, simulator, Posterior.of(found).best, path.with_suffix('.gif'))
    attempts.require()


def plan_request(plan: Plan, found: Description, simulation: Options) -> Request:
    """Return the request to simulate the actions of a plan, at least one."""
    steps = in_turn([Step(one.action) for one in plan.actions])
    options = {name: value for name, value in simulation.flat().items() if name in OF_PLACE}
    return Request((TrialRequest(PLAN, plan.start, tuple(step.action for step in steps), ()),),
                   {**options, 'mass': found.mass})


def _remove_older(folder: Path) -> None:
    """Remove the files of an older plan, which may have more actions."""
    if not (folder / f'{PLAN}.json').is_file():
        return
    chains = []
    for k in count(1):
        chains.append(folder / f'after_{k}.csv')
        if not chains[-1].is_file():
            break
    for path in (*(folder / f'{PLAN}{suffix}' for suffix in ('.xml', '.gif')), *chains):
        try:
            with suppress(FileNotFoundError):
                path.unlink()
        except OSError as error:
            raise unwritable(path, error) from error
