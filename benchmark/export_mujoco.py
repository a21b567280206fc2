# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Compare an exported DLO in MuJoCo with the elastica, with this package's engine and with the measured chains.

    python benchmark/export_mujoco.py [cantilever] [hanging] [trials] [--other] [--minute]

Each part is printed, and written to benchmark/results/export_mujoco_V_PART.md, where V is 3 or 4, the
version of the MuJoCo that is installed:

- cantilever: a horizontal one, whose first body is fixed, against the elastica from the middle of that body;
- hanging: a DLO that hangs from its first body, against what EA and the weight make it longer;
- trials: each sample is calibrated, and its trials are replayed. Hands are mocap bodies, and a `connect`
  constraint between a hand and the site of a gripped point is active while the hand is closed. The DLO counts
  as stable as in this package's engines. With `--other`, so are the five other actions with the same objects,
  which need DLO_DATA. With `--minute`, each sample lies on the table for a minute, too.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
import subprocess
import sys
import tempfile
import time
from typing import Any, Iterator

import figures
from lxml import etree
import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_bvp

from dlo_calibration import calibrate, Chain, export_mjcf, Options, read_result, read_session, Trial
from dlo_calibration.files.result import Description
from dlo_calibration.model.parameters import BY_NAME, GRAVITY
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.rollout import Settling

Floats = NDArray[np.float64]

LENGTH, POINTS = 0.6, 21  # m
MASS = 0.03  # kg
SEGMENTS = (20, 40)
STIFFNESSES = {1e-5: 'sample 3', 1e-4: 'sample 1', 1e-3: '', 2e-2: 'sample 5'}  # N m^2
MASSES = {1e-5: 0.008, 2e-2: 0.35}  # kg, of the samples
FALL = 6.0  # s, in which a cantilever comes to rest; then its tip may move by STILL in 0.1 s
STILL = 1e-5  # m
STRETCHES = (4.0, 90.0)  # EA, N
DRAG = 4.0  # 1/s, so that what hangs comes to rest soon
LONGEST = 6.0  # s, to wait for a stable DLO
MINUTE = 60.0  # s
#: Part -> what its table is, and the columns.
PARTS = {
    'cantilever': ('Distance of the tip of a cantilever from the elastica, mm.', [
        'EI, N m^2', 'mass, g', *(f'{one} segments' for one in SEGMENTS), '% of the length', 'EI, mass of']),
    'hanging': ('By how much a hanging DLO becomes longer.', ['EA, N', 'MuJoCo, mm', 'EA and weight, mm']),
    'trials': ('Mean distance of the points, mm.', [
        'sample', 'trials', 'number', 'MuJoCo to measured', 'ours to measured', 'ratio',
        'MuJoCo to ours', 'MuJoCo to measured in the worst trial', 'processor time of a second, s',
        'moved in a minute at rest']),
}


def made_up(bending: float, stretching: float, mass: float) -> Description:
    """Return a DLO with given EI [N m^2], EA [N] and mass [kg]."""
    sample = read_result(figures.SAMPLES / 'xml/dlo.xml')
    values = {'flexibility': bending, 'elasticity': stretching}
    found = {name: replace(one, value=BY_NAME[name].value(values[name])) if name in values else one
             for name, one in sample.parameters.items()}
    return replace(sample, parameters=found, mass=mass,
                   fixed={**sample.fixed, 'damping': BY_NAME['damping'].value(DRAG)})


def fixed(text: str) -> str:
    """Return a file whose first body is fixed to the world, at the pose of the start."""
    root = etree.fromstring(text.encode())
    body = root.find('worldbody/body')
    body.remove(body.find('freejoint'))
    key = root.find('keyframe/key')
    key.set('qpos', ' '.join(key.get('qpos').split()[7:]))
    return etree.tostring(root, encoding='unicode')


def started(text: str) -> tuple[Any, Any]:
    """Return MuJoCo's model and state of a file, at its start."""
    model = mujoco.MjModel.from_xml_string(text)
    state = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, state, model.key('start').id)
    mujoco.mj_forward(model, state)
    return model, state


def at_rest(found: Description, direction: Floats, segments: int) -> Floats:
    """Return the points, (POINTS, 3) [m], of a DLO that was fixed straight in a direction and let fall."""
    chain = Chain(np.linspace(0, LENGTH, POINTS)[:, None] * direction)
    options = Options(nodes=segments + 1, table=False)
    model, state = started(fixed(export_mjcf(found, chain, options=options)))
    mujoco.mj_step(model, state, round(FALL / model.opt.timestep))
    before = points_of(model, state)
    mujoco.mj_step(model, state, round(0.1 / model.opt.timestep))
    now = points_of(model, state)
    assert not state.warning.number.any(), 'MuJoCo warns that it is unstable'
    assert np.abs(now - before).max() < STILL, 'it still moves'
    return now


def points_of(model: Any, state: Any) -> Floats:
    """Return the sites at the points of the chain, (n, 3) [m]."""
    names = (f'dlo_point_{k}' for k in range(model.nsite))
    found = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name) for name in names]
    return np.array(state.site_xpos[[one for one in found if one >= 0]])


def elastica(bending: float, mass: float, clamp: float) -> Floats:
    """Return the tip, (3,) [m], of a cantilever that leaves its clamp at `clamp` [m] along x."""
    load, free = mass / LENGTH * GRAVITY, LENGTH - clamp
    s = np.linspace(0, free, 400)
    shape = np.stack([0 * s, 0 * s, clamp + s, 0 * s])

    def slope(share: float, s: Floats, y: Floats) -> Floats:
        moment = share * load * (free - s) * np.cos(y[0])
        return np.stack([y[1], moment / bending, np.cos(y[0]), np.sin(y[0])])

    def ends(first: Floats, last: Floats) -> Floats:
        return np.array([first[0], last[1], first[2] - clamp, first[3]])

    for share in np.geomspace(min(1.0, bending / load / free**3), 1, 14):  # each begins with the one before
        solved = solve_bvp(partial(slope, share), ends, s, shape, tol=1e-6, max_nodes=50000)
        assert solved.success, solved.message
        s, shape = solved.x, solved.y
    return np.array([shape[2, -1], 0.0, -abs(shape[3, -1])])


def cantilevers() -> Iterator[list[str]]:
    """Yield the rows of the table of cantilevers."""
    for bending, name in STIFFNESSES.items():
        for mass in dict.fromkeys((MASS, MASSES.get(bending, MASS))):
            away = []
            for segments in SEGMENTS:
                tip = at_rest(made_up(bending, 1e4, mass), np.array([1.0, 0, 0]), segments)[-1]
                away.append(np.linalg.norm(tip - elastica(bending, mass, LENGTH / segments / 2)))
            yield [f'{bending:g}', f'{1e3 * mass:g}', *(f'{1e3 * one:.2f}' for one in away),
                   f'{100 * away[-1] / LENGTH:.2f}', name]


def stretches() -> Iterator[list[str]]:
    """Yield the rows of the table of hanging DLOs."""
    for stretching in STRETCHES:
        points = at_rest(made_up(1e-4, stretching, MASS), np.array([0, 0, -1.0]), SEGMENTS[-1])
        expected = MASS * GRAVITY * LENGTH / (2 * stretching)
        longer = float(points[0, 2] - points[-1, 2]) - LENGTH
        yield [f'{stretching:g}', f'{1e3 * longer:.2f}', f'{1e3 * expected:.2f}']


def with_hands(text: str, trial: Trial) -> str:
    """Return a file with the hands of a trial, which are open."""
    root = etree.fromstring(text.encode())
    equality = etree.SubElement(root, 'equality')
    for hand, point in gripped(trial):
        name = f'{hand.name}_{point}'
        body = etree.SubElement(root.find('worldbody'), 'body', name=name, mocap='true')
        etree.SubElement(body, 'site', name=name)
        etree.SubElement(equality, 'connect', name=name, site1=name, site2=f'dlo_point_{point}',
                         active='false', solref='0.004 1')
    return etree.tostring(root, encoding='unicode')


def gripped(trial: Trial) -> list[tuple[Any, int]]:
    """Return each point that a hand grips, with the hand."""
    return [(hand, point) for hand in trial.hands for point in hand.grips]


def replayed(found: Any, trial: Trial, options: Options) -> tuple[Floats, float]:
    """Return the simulated points at the goal of a trial, (n, 3) [m], and the processor time of a second."""
    model, state = started(with_hands(export_mjcf(found, trial.initial, options=options), trial))
    goal, step, offsets = trial.goals[0], model.opt.timestep, {}
    kept, since, begun = points_of(model, state), 0.0, time.process_time()
    while True:
        for hand, point in gripped(trial):
            name = f'{hand.name}_{point}'
            if name not in offsets and hand.start <= state.time + step / 2:
                offsets[name] = state.site(f'dlo_point_{point}').xpos - hand.positions_at(hand.start)[0]
                state.eq_active[model.equality(name).id] = 1
            if name in offsets:
                state.mocap_pos[model.body(name).mocapid[0]] = \
                    hand.positions_at(state.time + step)[0] + offsets[name]
                if hand.end <= state.time + step / 2 and not trial.holds(hand, goal):
                    state.eq_active[model.equality(name).id] = 0
        mujoco.mj_step(model, state)
        assert not state.warning.number.any(), f'{trial.name}: MuJoCo warns that it is unstable'
        if state.time > goal.time and state.time - since >= Settling.time:
            now = points_of(model, state)
            if np.linalg.norm(now - kept, axis=1).max() < Settling.distance or \
                    state.time > goal.time + LONGEST:
                return now, (time.process_time() - begun) / state.time
            kept, since = now, state.time


def trials_of(name: str, folder: Path, other: bool) -> Iterator[tuple[str, Trial]]:
    """Yield the trials of a sample, and other actions with the same object."""
    for trial in read_session(figures.SAMPLES / name).trials:
        yield 'fitted', trial
    if not other:
        return
    subprocess.run([sys.executable, str(figures.HERE / 'convert.py'), 'reference', name, str(folder / name),
                    '--actions', 'other'], check=True, stdout=subprocess.DEVNULL)
    for trial in read_session(folder / name).trials:
        yield 'other', trial


def mean(one: Floats, other: Floats) -> float:
    """Return the mean distance of points [mm]."""
    return 1e3 * float(np.linalg.norm(one - other, axis=1).mean())


def samples(folder: Path, other: bool, minute: bool) -> Iterator[list[str]]:
    """Yield a row for each sample and kind of trial: mean distances, MuJoCo's and ours."""
    for name in (f'object{k}' for k in range(1, 6)):
        session = read_session(figures.SAMPLES / name)
        found = calibrate(session.trials, replace(session.options, engine='compiled'))
        engine, rows = CompiledSimulator(), dict[str, list[tuple[float, ...]]]()
        for kind, trial in trials_of(name, folder, other):
            measured = trial.goals[0].chain.points
            ours = engine.simulate(trial, found.physical()).chains[0]
            theirs, share = replayed(found, trial, session.options)
            row = mean(theirs, measured), mean(ours, measured), mean(theirs, ours), share
            rows.setdefault(kind, []).append(row)
            print(name, kind, trial.name, *(f'{one:.2f}' for one in row), flush=True)
        moved = lain(found, session.trials[0].initial, session.options) if minute else None
        for kind, all_of_kind in rows.items():
            table = np.array(all_of_kind)
            to_measured, ours_to, between, share = table.mean(axis=0)
            yield [name[-1], kind, str(len(table)), f'{to_measured:.2f}', f'{ours_to:.2f}',
                   f'{to_measured / ours_to:.2f}', f'{between:.2f}', f'{table[:, 0].max():.2f}',
                   f'{share:.1f}', '-' if moved is None else f'{moved:.2f}']


def lain(found: Any, chain: Chain, options: Options) -> float:
    """Return how far the points move on average in a minute on the table, after its first second [mm]."""
    model, state = started(export_mjcf(found, chain, options=options))
    steps = round(MINUTE / model.opt.timestep)
    mujoco.mj_step(model, state, steps // 60)
    before = points_of(model, state)
    mujoco.mj_step(model, state, steps - steps // 60)
    assert not state.warning.number.any(), 'MuJoCo warns that it is unstable'
    return mean(points_of(model, state), before)


def main() -> None:
    """Make the tables that the command line names, or all."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('parts', nargs='*', choices=[[], *PARTS], help='default: all')
    parser.add_argument('--other', action='store_true', help='also other actions with the same objects')
    parser.add_argument('--minute', action='store_true', help='also a minute on the table')
    chosen = parser.parse_args()
    for part in chosen.parts or PARTS:
        flags = [f' --{name}' for name in ('other', 'minute') if part == 'trials' and getattr(chosen, name)]
        with tempfile.TemporaryDirectory() as folder:
            rows = cantilevers() if part == 'cantilever' else stretches() if part == 'hanging' else \
                samples(Path(folder), chosen.other, chosen.minute)
            text = figures.table(PARTS[part][1], rows)
        name = f'export_mujoco_{mujoco.__version__.split(".")[0]}_{part}'
        (figures.HERE / 'results' / f'{name}.md').write_text(
            f'# {name}\n\n`python benchmark/export_mujoco.py {part}{"".join(flags)}`\n\n{PARTS[part][0]} '
            f'MuJoCo {mujoco.__version__}, the form extensible, the time step of the file. '
            f'{figures.machine()}\n\n{text}\n', encoding='utf-8')
        print(text, flush=True)


if __name__ == '__main__':
    main()
