# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Compare with MuJoCo's cable: the same cantilever falls and comes to rest in both engines: `make bench`."""

import math
import time

from figures import side_by_side, table, write
import numpy as np
import pytest
from scipy.integrate import solve_bvp

from dlo_calibration import Action, Chain, Goal, Hand, Trial
from dlo_calibration.model.parameters import GRAVITY, PARAMETERS
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator

mujoco = pytest.importorskip('mujoco', reason='needs MuJoCo: the extra "bench" of setup.py has it')

LENGTH, MASS, RADIUS = 0.6, 0.03, 0.004  # m, kg, m
STIFFNESS = 0.02  # EI, N m^2
DAMPING = 0.1  # s, proportional to the stiffness
SECONDS = 5.0
ELEMENTS = (30, 60)
STEP = 0.004  # s, of all; MuJoCo's rest changes by less than 0.001 mm down to 0.25 ms
ROUNDS = 5
MODEL = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" gravity="0 0 -{gravity}"/>
  <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
  <worldbody>
    <composite type="cable" curve="s" count="{nodes} 1 1" size="{length}" initial="none">
      <plugin plugin="mujoco.elasticity.cable">
        <config key="twist" value="{shear}"/>
        <config key="bend" value="{young}"/>
      </plugin>
      <joint kind="main" damping="{damping}"/>
      <geom type="capsule" size="{radius}" mass="{mass}"/>
    </composite>
  </worldbody>
</mujoco>
"""


class Cable:
    """The cable in MuJoCo: as many capsules as we have segments, the first one fixed."""

    def __init__(self, elements):
        young = STIFFNESS / (math.pi / 4 * RADIUS**4)
        self.model = mujoco.MjModel.from_xml_string(MODEL.format(
            step=STEP, gravity=GRAVITY, nodes=elements + 1, length=LENGTH, young=young, shear=young / 3,
            radius=RADIUS, mass=MASS / elements, damping=DAMPING * STIFFNESS / (LENGTH / elements)))
        self.state = mujoco.MjData(self.model)
        self.steps = round(SECONDS / STEP)

    def simulate(self):
        """Return the ends of the elements, (elements + 1, 3) [m], after SECONDS."""
        mujoco.mj_resetData(self.model, self.state)
        mujoco.mj_step(self.model, self.state, self.steps)
        assert not self.state.warning.number.any(), 'MuJoCo warns that it is unstable'
        last = self.model.nbody - 1
        turn = self.state.xmat[last].reshape(3, 3)
        tip = self.state.xpos[last] + turn[:, 0] * LENGTH / (self.model.nbody - 1)
        return np.vstack([self.state.xpos[1:], tip])


def cantilever(elements):
    """Return our trial, whose hand clamps the first segment, and its physical parameters."""
    start = np.zeros((elements + 1, 3))
    start[:, 0] = np.linspace(0, LENGTH, elements + 1)
    hand = Hand('clamp', (0, 1), [0.0, 0.01], [[0, 0, 0], [0, 0, 0]])
    trial = Trial('falls', Chain(start), (Action((hand,)),),
                  (Goal(Chain(start), SECONDS, stable=False, held_by=('clamp',)),))
    physical = {p.name: p.physical(p.default) for p in PARAMETERS}
    return trial, {**physical, 'flexibility': STIFFNESS, 'mass': MASS, 'self_collision': RADIUS,
                   'damping': 1e-9, 'internal_damping': DAMPING, 'elasticity': 1e4}


def elastica(clamp):
    """Return the tip [m] of a cantilever at rest under its weight, relative to the clamp, by the elastica."""
    load = MASS / LENGTH * GRAVITY
    free = LENGTH - clamp

    def change(s, y):
        return np.stack([y[1], load * (free - s) * np.cos(y[0]) / STIFFNESS, np.cos(y[0]), np.sin(y[0])])

    s = np.linspace(0, free, 200)
    guess = np.stack([-s / free, -1 / free + 0 * s, clamp + s, -s / 2])
    solution = solve_bvp(change, lambda a, b: np.array([a[0], b[1], a[2] - clamp, a[3]]), s, guess,
                         tol=1e-6, max_nodes=20000)
    assert solution.success
    return np.array([solution.y[2, -1], 0.0, solution.y[3, -1]])


@pytest.fixture(scope='module')
def rows():
    """Collect the rows, and write the table when it is complete."""
    found = []
    yield found
    if len(found) == 3 * len(ELEMENTS):
        write('mujoco', 'make bench', f'MuJoCo {mujoco.__version__}, composite cable with the plugin '
              'mujoco.elasticity.cable, integrator implicitfast, ball joints damped like our '
              'internal damping, '
              'contacts on. A straight '
              f'horizontal cantilever of {LENGTH:g} m, {MASS:g} kg, EI {STIFFNESS:g} N m², '
              f'radius {RADIUS:g} m, '
              f'damping {DAMPING:g} s, clamped at its first element, falls for {SECONDS:g} s, after '
              'which it '
              f'rests. All with steps of {1e3 * STEP:g} ms. Shortest of {ROUNDS} repetitions, taken in '
              'turns; '
              'processor time. The elastica begins at the end of the clamped segment; for MuJoCo at '
              'its middle, '
              'since its first joint is at that end, and as stiff as all.',
              table(['elements', 'engine', 'ms per simulated second', 'µs per step', 'times compiled',
                     'tip to elastica, mm'], found))


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize('elements', ELEMENTS)
def test_cantilever(benchmark, elements, rows):
    trial, physical = cantilever(elements)
    cable = Cable(elements)
    bullet, compiled = (make(table=False, nodes=elements + 1, time_step=STEP)
                        for make in (BulletSimulator, CompiledSimulator))
    shapes = {'mujoco': cable.simulate(), 'bullet': bullet.simulate(trial, physical).chains[0],
              'compiled': compiled.simulate(trial, physical).chains[0]}
    seconds = side_by_side(benchmark, {
        'mujoco': cable.simulate, 'bullet': lambda: bullet.simulate(trial, physical),
        'compiled': lambda: compiled.simulate(trial, physical)}, ROUNDS)
    bullet.close()
    for name, shape in shapes.items():
        expected = elastica(LENGTH / elements * (0.5 if name == 'mujoco' else 1))
        rows.append([elements, name, f'{1e3 * seconds[name] / SECONDS:.2f}',
                     f'{1e6 * seconds[name] * STEP / SECONDS:.1f}',
                     f'{seconds[name] / seconds["compiled"]:.1f}',
                     f'{1e3 * np.linalg.norm(shape[-1] - expected):.2f}'])
