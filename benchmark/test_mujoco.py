# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Compare with MuJoCo and the file of `export`: the same cantilever falls and comes to rest: `make bench`."""

from dataclasses import replace
import time

from figures import SAMPLES, side_by_side, table, write
from lxml import etree
import numpy as np
import pytest
from replays import elastica, LENGTH, MASS

from dlo_calibration import Action, Chain, export_mjcf, Goal, Hand, Options, read_result, Trial
from dlo_calibration.model.parameters import BY_NAME
from dlo_calibration.simulation.bullet import BulletSimulator
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.protocol import DEFAULT_TIME_STEP

mujoco = pytest.importorskip('mujoco', reason='needs MuJoCo: the extra "bench" of setup.py has it')

RADIUS = 0.004  # m
STIFFNESS = 0.02  # EI, N m^2
PHYSICAL = {'flexibility': STIFFNESS, 'elasticity': 1e4, 'self_collision': RADIUS, 'damping': 0.01,
            'internal_damping': 0.1}
SECONDS = 5.0
ELEMENTS = (30, 60)
ROUNDS = 5
HOW = ('MuJoCo {} with the file that `export --format mjcf` writes: ball and slide joints, its time step. '
       'The other engines have their default step. '
       f'A straight horizontal cantilever of {LENGTH:g} m, {MASS:g} kg, EI {STIFFNESS:g} N m², radius '
       f'{RADIUS:g} m, clamped at its first element, falls for {SECONDS:g} s, after which it rests. '
       f'Shortest of {ROUNDS} repetitions, taken in turns; processor time. The elastica begins at the end of '
       'the clamped segment; for MuJoCo at its middle, since its first joint is at that end, and as stiff as '
       "all. Before, with MuJoCo 3.17's cable plugin and steps of 4 ms for all, a simulated second took "
       'MuJoCo 42 and 167 ms, 23 and 77 times compiled.')


def dlo():
    """Return the definition of the DLO."""
    sample = read_result(SAMPLES / 'xml/dlo.xml')
    values = {name: BY_NAME[name].value(value) for name, value in PHYSICAL.items()}
    parameters = {name: replace(estimate, value=values.get(name, estimate.value))
                  for name, estimate in sample.parameters.items()}
    return replace(sample, mass=MASS, length=LENGTH, fixed={**sample.fixed, **values}, parameters=parameters)


def start(elements):
    """Return the straight and horizontal chain at the start."""
    return Chain(np.linspace(0, LENGTH, elements + 1)[:, None] * [1.0, 0, 0])


class Exported:
    """The cantilever in MuJoCo: as many bodies as we have segments, the first one fixed."""

    def __init__(self, elements):
        text = export_mjcf(dlo(), start(elements), options=Options(nodes=elements + 1, table=False))
        root = etree.fromstring(text.encode())
        free = root.find('worldbody/body/freejoint')
        free.getparent().remove(free)
        root.remove(root.find('keyframe'))
        self.model = mujoco.MjModel.from_xml_string(etree.tostring(root, encoding='unicode'))
        self.state = mujoco.MjData(self.model)

    def simulate(self):
        """Return the points of the chain, (elements + 1, 3) [m], after SECONDS."""
        mujoco.mj_resetData(self.model, self.state)
        mujoco.mj_step(self.model, self.state, round(SECONDS / self.model.opt.timestep))
        assert not self.state.warning.number.any(), 'MuJoCo warns that it is unstable'
        return np.array([self.state.site(f'dlo_point_{k}').xpos for k in range(self.model.nsite)])


def cantilever(elements):
    """Return our trial, whose hand clamps the first segment, and its physical parameters."""
    chain = start(elements)
    hand = Hand('clamp', (0, 1), [0.0, 0.01], [[0, 0, 0], [0, 0, 0]])
    goal = Goal(chain, SECONDS, stable=False, held_by=('clamp',))
    description = dlo()
    physical = description.space.physical(description.values, LENGTH)
    return Trial('falls', chain, (Action((hand,)),), (goal,)), physical


@pytest.fixture(scope='module')
def rows():
    """Collect the rows, and write the table when it is complete."""
    lines = []
    yield lines
    if len(lines) == 3 * len(ELEMENTS):
        write('mujoco', 'make bench', HOW.format(mujoco.__version__),
              table(['elements', 'engine', 'step, ms', 'ms per simulated second', 'µs per step',
                     'times compiled', 'tip to elastica, mm'], lines))


@pytest.mark.benchmark(timer=time.process_time)
@pytest.mark.parametrize('elements', ELEMENTS)
def test_cantilever(benchmark, elements, rows):
    trial, physical = cantilever(elements)
    exported = Exported(elements)
    bullet, compiled = (make(table=False, nodes=elements + 1)
                        for make in (BulletSimulator, CompiledSimulator))
    calls = {'mujoco': exported.simulate, 'bullet': lambda: bullet.simulate(trial, physical).chains[0],
             'compiled': lambda: compiled.simulate(trial, physical).chains[0]}
    shapes = {name: simulate() for name, simulate in calls.items()}
    seconds = side_by_side(benchmark, calls, ROUNDS)
    bullet.close()
    for name, shape in shapes.items():
        step = exported.model.opt.timestep if name == 'mujoco' else DEFAULT_TIME_STEP
        expected = elastica(STIFFNESS, LENGTH / elements * (0.5 if name == 'mujoco' else 1))
        rows.append([elements, name, f'{1e3 * step:g}', f'{1e3 * seconds[name] / SECONDS:.2f}',
                     f'{1e6 * seconds[name] * step / SECONDS:.1f}',
                     f'{seconds[name] / seconds["compiled"]:.1f}',
                     f'{1e3 * np.linalg.norm(shape[-1] - expected):.2f}'])
