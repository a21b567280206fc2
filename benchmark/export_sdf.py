# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Simulate exported SDF files with the physics of Gazebo.

    python benchmark/export_sdf.py [FOLDER]

It compiles gazebo.cc, which needs a C++ compiler and the Debian packages libignition-physics-dev and
libsdformat-dev (Gazebo Fortress).  FOLDER keeps the calibrations of the reference objects (DLO_DATA) for the
next time.  The tables are printed, and written to benchmark/results/export_sdf.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
import subprocess
import sys
import tempfile
from typing import Any

import numpy as np
from replays import cantilevers, compared, Floats, Grip, LENGTH, MASS

from dlo_calibration import Chain, Options, Trial
from dlo_calibration.export import export_sdf, ExportedRope
from dlo_calibration.model.parameters import BY_NAME, PAPER_PARAMETERS, ParameterSpace
from dlo_calibration.model.pose import Pose

HERE = Path(__file__).resolve().parent
PACKAGES = ('ignition-physics5', 'ignition-physics5-sdf', 'sdformat12', 'ignition-plugin1-loader')
PLUGIN = 'ign-physics-5/engine-plugins/libignition-physics-dartsim-plugin.so'
STEP = 0.001  # s, of gazebo.cc
NODES, TRIALS = 21, 1  # a simulated second takes 4 s
DRAG = 5.0  # 1/s, of cantilevers: without it a limp one swings for minutes
HOLD = 0.2, 0.2  # stiffness and damping of a hand, relative to what one step of a free segment allows
TABLE = """<model name="table"><static>true</static><link name="top"><collision name="top">
<pose>0 0 {height:.9g} 0 0 0</pose><geometry><box><size>10 10 0.2</size></box></geometry>
<surface><friction><ode><mu>1</mu><mu2>1</mu2></ode></friction></surface></collision></link></model>"""
CLAMP = '<joint name="clamp" type="fixed"><parent>world</parent><child>dlo_0</child></joint>'


@dataclass(frozen=True)
class MadeUp:
    """A DLO whose parameters are given; nothing of it was calibrated."""

    space: ParameterSpace
    length: float = LENGTH
    parameters = {}
    correlations = None


class Gazebo:
    """The compiled program, in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._program = folder, folder / 'gazebo'
        asked = ['--variable=libdir', PACKAGES[0]], ['--cflags', '--libs', *PACKAGES]
        libraries, flags = (subprocess.run(['pkg-config', *words], check=True, text=True,
                                           stdout=subprocess.PIPE).stdout.split() for words in asked)
        subprocess.run(['g++', '-O2', '-std=c++17', f'-DDARTSIM="{libraries[0]}/{PLUGIN}"', '-w',
                        str(HERE / 'gazebo.cc'), '-o', str(self._program), *flags], check=True)

    def simulate(self, model: str, in_world: str, in_model: str, seconds: float, drag: float,
                 hands: str = '', hold: tuple[float, float] = (0, 0)) -> list[Pose]:
        """Return the poses of the links after some seconds."""
        world = self._folder / 'world.sdf'
        inside = model[model.index('<model'):model.rindex('</model>')]
        world.write_text(f'<?xml version="1.0"?><sdf version="1.9"><world name="around"><gravity>0 0 -9.81'
                         f'</gravity>{in_world}{inside}{in_model}</model></world></sdf>')
        done = subprocess.run([str(self._program), str(world), f'{seconds}', f'{seconds}', f'{drag}',
                               *(f'{value:.9g}' for value in hold)], input=hands, text=True, check=True,
                              stdout=subprocess.PIPE)
        rows = np.array(done.stdout.splitlines()[-1].split()[1:], dtype=float).reshape(-1, 7)
        return [Pose(row[:3], row[[4, 5, 6, 3]]) for row in rows]

    def tip(self, stiffness: float, segments: int) -> Floats:
        """Return the tip of a cantilever at rest, (3,) [m]."""
        fixed = {'flexibility': BY_NAME['flexibility'].value(stiffness), 'internal_damping': 100.0}
        x = np.linspace(0, LENGTH, segments + 1)
        chain = Chain(np.stack([x, 0 * x, 0 * x], axis=1))
        text = export_sdf(MadeUp(ParameterSpace(PAPER_PARAMETERS[1:], fixed, MASS)), chain,  # type: ignore[arg-type]
                          options=Options(table=False, nodes=segments + 1))
        last = self.simulate(text, '', CLAMP, 12.0, DRAG)[-1]
        return last.points(np.array([LENGTH / segments, 0, 0]))

    def replay(self, dlo: Any, trial: Trial, grips: list[Grip], end: float) -> Floats:
        """Return the points of a trial, (n, 3) [m]."""
        options = Options(nodes=NODES)
        rope = ExportedRope.of(dlo, trial.initial, options)
        text = export_sdf(dlo, trial.initial, options=options)
        assert rope.table is not None
        table = TABLE.format(height=rope.table - 0.1)
        rows = []
        for grip in grips:
            segment, along = rope.place_of(float(rope.point_places[grip.point]))
            knots = np.column_stack([grip.times, grip.positions]).ravel()
            numbers = ' '.join(f'{value:.9g}' for value in knots)
            rows.append(f'{segment} {along:.9g} {len(grip.times)} {numbers}')
        mass = float(rope.masses[0])
        poses = self.simulate(text, table, '', end, rope.drag, '\n'.join(rows), (
            HOLD[0] * mass / STEP**2, HOLD[1] * mass / STEP))
        return np.array([poses[segment].points(np.array([along, 0, 0])) for segment, along in map(
            rope.place_of, rope.point_places.tolist())])


def main() -> None:
    """Make the tables."""
    with tempfile.TemporaryDirectory() as temporary:
        gazebo = Gazebo(Path(temporary))
        first = cantilevers(gazebo.tip, product((2e-2, 1e-3, 1e-4, 1e-5), (20, 40)), 0.5)
        second = compared(Path(sys.argv[1] if len(sys.argv) > 1 else temporary), gazebo.replay,
                          TRIALS)
    text = f"""# export_sdf

`python benchmark/export_sdf.py`

Exported SDF files in the physics of Gazebo Fortress (gz-physics 5, DART), steps of 1 ms.

A horizontal cantilever of {LENGTH:g} m and {MASS:g} kg comes to rest, its first link fixed. The elastica
begins in the middle of that link.

{first}

The reference objects, fitted on four trials each, in one other trial each on the table, with
{NODES - 1} links. The hands are springs. The found drag is applied as a force, which SDF does not have.

{second}
"""
    print(text)
    (HERE / 'results' / 'export_sdf.md').write_text(text)


if __name__ == '__main__':
    main()
