# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
A real cable whose robot feels force: its mass and stiffness, from shapes at rest and one force.

    python benchmark/felt_cable.py FOLDER

FOLDER is a copy of the public repository sebtiburzio/PAC_model_matlab, which is not part of this one: cables
that a robot holds at their upper end, in a vertical plane.  For each it has shapes at rest for 23 angles of
the gripper (three points of each were measured), and a recording with the forces on the wrist.  The sensor
was never tared, so the other cables, whose masses are told, tare it: each recording of them is one
measurement of the offset.  Its own mass is not told: that of cable and 30 g of a tip together, which count as
cable.  Its owners found its stiffness from the same shapes, with its mass.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
import sys
from typing import Iterator

import numpy as np

from dlo_calibration import Action, calibrate, Chain, Force, Goal, Hand, Options, Trial
from dlo_calibration.model.parameters import GRAVITY

SHAPES = 'fixed_base/data_in/0802-equilibrium_data/{}_equilibria/theta_equilibria.csv'
FORCES = 'floating_base/data_in/0913-dyn_evs/{}/state_and_input.csv'
PLACES = np.array([0, 0.01, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])  # of the length
AT_REST = 15  # frames at the end of a recording, half a second
NAMES = ('flexibility', 'mass', *(f'rest_curvature_x{k}' for k in (1, 2, 3)))


@dataclass(frozen=True)
class Cable:
    """
    A cable, with what its owners say of it.

    :param mass: [kg] of the cable; `end` [kg] of what hangs at its end; `length` [m].
    :param stiffness: their bending stiffness, per length [N m].
    """

    name: str
    mass: float
    end: float
    length: float
    stiffness: float

    @property
    def kind(self) -> str:
        """The cable, without what hangs at its end."""
        return self.name.rpartition('_')[0]


#: From the files in `object_parameters`, the two-stage identification.
CABLES = (
    Cable('black_unweighted', 0.6, 0.03, 0.6, 0.2259),
    Cable('black_short_unweighted', 0.42, 0.03, 0.4, 0.3599),
    Cable('orange_short_unweighted', 0.25, 0.03, 0.45, 0.269))
#: They tare the sensor, too.
WEIGHTED = (
    Cable('black_weighted', 0.6, 0.23, 0.6, 0.1965), Cable('black_short_weighted', 0.42, 0.23, 0.4, 0.2534),
    Cable('orange_weighted', 0.4, 0.23, 0.75, 0.0761))


def upward(folder: Path, cable: Cable) -> float:
    """Return the vertical force [N] on the sensor while the cable hangs at rest."""
    recorded = np.genfromtxt(folder / FORCES.format(cable.name), delimiter=',', names=True)
    return float(recorded['Fz'][-AT_REST:].mean())


def offsets(folder: Path, cable: Cable) -> list[float]:
    """Return the offset of the sensor [N] by each recording of another cable."""
    return [upward(folder, other) + (other.mass + other.end) * GRAVITY
            for other in (*CABLES, *WEIGHTED) if other.kind != cable.kind]


def shape(cable: Cable, row: np.void) -> Chain:
    """Return a shape at rest: their curve through the three measured points."""
    fine = np.linspace(0, 1, 401)
    angles = row['Gamma'] + row['Theta0'] * fine + row['Theta1'] * fine**2 / 2  # from down, clockwise
    steps = np.stack([-np.sin(angles), 0 * angles, -np.cos(angles)], axis=1)
    curve = np.concatenate([np.zeros((1, 3)), np.cumsum((steps[1:] + steps[:-1]) / 2, axis=0)])
    points = curve[np.searchsorted(fine, PLACES - 1e-9)] * (cable.length / (len(fine) - 1))
    return Chain(points)


def trials(folder: Path, cable: Cable) -> Iterator[Trial]:
    """
    Yield the trials of a cable; of the first, each has its weight by another measurement of the offset.

    The weight at rest does not depend on the angle, so that it is felt at one as at another.
    """
    table = np.genfromtxt(folder / SHAPES.format(cable.name), delimiter=',', names=True)
    felt = [(Force('gripper', np.array([0, 0, upward(folder, cable) - offset])),)
            for offset in offsets(folder, cable)]
    for row, forces in zip_longest(table, felt, fillvalue=()):
        chain, half = shape(cable, row), row['Gamma'] / 2
        hand = Hand('gripper', (0, 1), (0.0,), chain.points[:1], [[0, np.sin(half), 0, np.cos(half)]])
        goal = Goal(chain, 1.0, held_by=('gripper',), forces=forces)
        yield Trial(f'angle {row["Gamma"]:.2f}', chain, (Action((hand,)),), (goal,))


def main() -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('folder', nargs='?', type=Path, help='copy of sebtiburzio/PAC_model_matlab')
    folder = parser.parse_args().folder
    if folder is None or not (folder / SHAPES.format(CABLES[0].name)).is_file():
        print('felt_cable: skipped, as the folder has no data of sebtiburzio/PAC_model_matlab')
        return 0
    print('| cable | told mass [kg] | found | off | their EI [N m^2] | found | points off |')
    print('|---|---|---|---|---|---|---|')
    for cable in CABLES:
        result = calibrate(tuple(trials(folder, cable)), Options.of({
            'calibrate': NAMES, 'table': False, 'parts': 1, 'seed': 1, 'elasticity': 0.0, 'torsion': 60.8}))
        mass, stiffness = (result.parameters[name] for name in ('mass', 'flexibility'))
        told = cable.mass + cable.end
        held = mass.physical_lower <= told <= mass.physical_upper
        off = 100 * (mass.physical_value / told - 1)
        print(f'| {cable.name} | {told:g} | {mass.physical_value:.3f} ({mass.physical_lower:.3f} to '
              f'{mass.physical_upper:.3f}{"" if held else ", misses it"}) | '
              f'{off:+.1f} % | {cable.stiffness * cable.length:.3f} | '
              f'{stiffness.physical_value:.3f} ({stiffness.physical_lower:.3f} to '
              f'{stiffness.physical_upper:.3f}) | {1e3 * result.errors.mean:.1f} mm |', flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
