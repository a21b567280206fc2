# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Compare an exported DLO in MuJoCo with the elastica, with this package's engine and with the measured chains.

    python benchmark/export_mujoco.py [PART ...] [--other]

Each part is printed, and written to benchmark/results/export_mujoco_V_PART.md, where V is 3 or 4, the
version of the MuJoCo that is installed:

- cantilever: a horizontal one, whose first body is fixed, against the elastica from the middle of that body;
  beside it our engine, whose first segment is clamped, against the elastica from the end of that segment;
- hanging: a DLO that hangs from its first body, against what EA and the weight make it longer;
- pin: a DLO that hangs from a hand by a `connect` constraint, and how far below the hand it is;
- speed: simulated seconds in a second of processor time, of a DLO on a table, in the air, and coiled;
- flexcomp: the same two, of MuJoCo's own deformable, which export does not write;
- trials: each sample is calibrated, and its trials are replayed. Hands are mocap bodies, and a `connect`
  constraint between a hand and the site of a gripped point is active while the hand is closed. The DLO counts
  as stable as in this package's engines. With `--other`, so are the five other actions with the same objects,
  which need DLO_DATA;
- minute: each sample lies on the table for a minute of simulated time.  It takes half an hour.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
import tempfile
import time
from typing import Any, Iterator

from accuracy import convert
import figures
from lxml import etree
import mujoco
import numpy as np
from replays import distance, elastica, Floats, Grip, grips, LENGTH, MASS, OBJECTS

from dlo_calibration import (
    Action,
    calibrate,
    Chain,
    export_mjcf,
    Goal,
    Hand,
    Options,
    read_result,
    read_session,
    Trial,
)
from dlo_calibration.files.result import Description
from dlo_calibration.model.parameters import BY_NAME, GRAVITY
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.simulation.script import Settling

POINTS = 21
SEGMENTS = (20, 40, 60)
STIFFNESSES = {1e-5: 'sample 3', 1e-4: 'sample 1', 1e-3: '', 2e-2: 'sample 5'}  # N m^2
MASSES = {1e-5: 0.008, 2e-2: 0.35}  # kg, of the samples
FALL = 6.0  # s, in which a cantilever comes to rest; then its tip may move by STILL in 0.1 s
STILL = 1e-5  # m
STRETCHES = (4.0, 90.0)  # EA, N
DRAG = 4.0  # 1/s, so that what hangs comes to rest soon
RADIUS, FLEX_SEGMENTS, FLEX_STIFFNESSES = 0.004, 40, (1e-3, 2e-2)  # m, -, N m^2, of flexcomps
EDGES = {'': 'as documented', 'solref="0.004 1" solimp="0.99 0.9999 0.001"': 'stiff'}
SOLREFS = ('0.02 1', '0.01 1', '0.004 1')  # of a pin; the first is MuJoCo's default, the last as trials have
COIL, PITCH = 0.04, 2.2  # m, radii of the DLO; of a coil that falls on the table
LONGEST = 6.0  # s, to wait for a stable DLO
#: Part -> what its table is, and the columns.
PARTS = {
    'cantilever': ('Distance of the tip of a cantilever from the elastica, mm.', [
        'EI, N m^2', 'mass, g', *(f'{count} segments' for count in SEGMENTS), '% of the length, 40',
        'ours, 40 segments', 'EI, mass of']),
    'hanging': ('By how much a hanging DLO becomes longer.', ['EA, N', 'MuJoCo, mm', 'EA and weight, mm']),
    'pin': ('How far a DLO of 0.6 m that hangs from a `connect` constraint is below its hand, 40 segments.', [
        'solref', 'mass, g', 'EA, N', 'below the hand, mm']),
    'speed': ('Simulated seconds in a second of processor time, sample 1, in its second second.', [
        'nodes', 'where', 'contacts', 'extensible', 'inextensible']),
    'flexcomp': ("A flexcomp of one dimension instead, 40 edges, Young's modulus from EI: it has no EA.", [
        'EI, N m^2', 'edges', 'tip of a cantilever from the elastica, mm', 'longer by its weight, mm']),
    'trials': ('Mean distance of the points, mm.', [
        'sample', 'trials', 'number', 'MuJoCo to measured', 'ours to measured', 'ratio',
        'MuJoCo to ours', 'MuJoCo to measured in the worst trial', 'processor time of a second, s']),
    'minute': ('How far the points of a DLO on the table move in a minute at rest, after its first second.', [
        'sample', 'mean, mm', 'largest, mm']),
}


def made_up(bending: float, stretching: float, mass: float) -> Description:
    """Return a DLO with given EI [N m^2], EA [N] and mass [kg]."""
    sample = read_result(figures.SAMPLES / 'xml/dlo.xml')
    values = {'flexibility': bending, 'elasticity': stretching}
    parameters = {
        name: replace(parameter, value=BY_NAME[name].value(values[name])) if name in values else parameter
        for name, parameter in sample.parameters.items()}
    return replace(sample, parameters=parameters, mass=mass,
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


def at_rest(dlo: Description, direction: Floats, segments: int) -> Floats:
    """Return the points, (POINTS, 3) [m], of a DLO that was fixed straight in a direction and let fall."""
    chain = Chain(np.linspace(0, LENGTH, POINTS)[:, None] * direction)
    options = Options(nodes=segments + 1, table=False)
    model, state = started(fixed(export_mjcf(dlo, chain, options=options)))
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
    sites = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name) for name in names]
    return np.array(state.site_xpos[[site for site in sites if site >= 0]])


def cantilevers() -> Iterator[list[str]]:
    """Yield the rows of the table of cantilevers."""
    for bending, name in STIFFNESSES.items():
        for mass in dict.fromkeys((MASS, MASSES.get(bending, MASS))):
            away = []
            for segments in SEGMENTS:
                tip = at_rest(made_up(bending, 1e4, mass), np.array([1.0, 0, 0]), segments)[-1]
                away.append(np.linalg.norm(tip - elastica(bending, LENGTH / segments / 2, mass)))
            ours = ours_away(bending, mass, 40)
            yield [f'{bending:g}', f'{1e3 * mass:g}', *(f'{1e3 * each:.2f}' for each in away),
                   f'{100 * away[SEGMENTS.index(40)] / LENGTH:.2f}', f'{1e3 * ours:.2f}', name]


def ours_away(bending: float, mass: float, segments: int) -> float:
    """Return the distance of the tip from the elastica in our engine [m]; a hand clamps the first segment."""
    chain = Chain(np.linspace(0, LENGTH, segments + 1)[:, None] * [1.0, 0, 0])
    hand = Hand('clamp', (0, 1), [0.0, 0.01], np.zeros((2, 3)))
    trial = Trial('falls', chain, (Action((hand,)),), (Goal(chain, FALL, stable=False, held_by=('clamp',)),))
    engine = CompiledSimulator(table=False, nodes=segments + 1)
    tip = engine.simulate(trial, made_up(bending, 1e4, mass).physical()).chains[0][-1]
    return float(np.linalg.norm(tip - elastica(bending, LENGTH / segments, mass)))


def flexcomps() -> Iterator[list[str]]:
    """Yield the rows of the table of MuJoCo's own DLO, a `flexcomp` of one dimension."""
    for edges, bending in product(EDGES, FLEX_STIFFNESSES):
        expected = elastica(bending, LENGTH / FLEX_SEGMENTS / 2)
        fallen, hanging = (flexcomp(edges, bending, turn) for turn in ('0 0 0', '0 90 0'))
        longer = np.linalg.norm(np.diff(hanging, axis=0), axis=1).sum() - LENGTH
        away = np.linalg.norm(fallen[-1] - fallen[0] - expected)
        yield [f'{bending:g}', EDGES[edges], *(
            'unstable' if not value < LENGTH else f'{1e3 * value:.1f}' for value in (away, longer))]


def flexcomp(edges: str, bending: float, turn: str) -> Floats:
    """Return the points, (FLEX_SEGMENTS + 1, 3) [m], of a flexcomp at rest; its first two are fixed."""
    spacing, young = LENGTH / FLEX_SEGMENTS, bending / (np.pi / 4 * RADIUS**4)
    # MuJoCo 4 takes the elasticity of flexcomps implicitly only with this integrator, which 3 has not.
    integrator = 'discrete' if mujoco.__version__ >= '4' else 'implicitfast'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="0.002" integrator="{integrator}"/><worldbody><flexcomp name="dlo" '
        f'type="grid" dim="1" count="{FLEX_SEGMENTS + 1} 1 1" spacing="{spacing} {spacing} {spacing}" '
        f'euler="{turn}" radius="{RADIUS}" mass="{MASS}"><edge equality="true" {edges}/><elasticity '
        f'young="{young}" poisson="0" damping="0.002"/><pin id="0 1"/><contact selfcollide="none"/>'
        '</flexcomp></worldbody></mujoco>')
    model.dof_damping[:] = DRAG * MASS / FLEX_SEGMENTS
    state = mujoco.MjData(model)
    mujoco.mj_step(model, state, round(FALL / model.opt.timestep))
    points = np.array(state.flexvert_xpos)
    return np.full_like(points, np.nan) if state.warning.number.any() else points


def stretches() -> Iterator[list[str]]:
    """Yield the rows of the table of hanging DLOs."""
    for stretching in STRETCHES:
        points = at_rest(made_up(1e-4, stretching, MASS), np.array([0, 0, -1.0]), SEGMENTS[-1])
        expected = MASS * GRAVITY * LENGTH / (2 * stretching)
        longer = float(points[0, 2] - points[-1, 2]) - LENGTH
        yield [f'{stretching:g}', f'{1e3 * longer:.2f}', f'{1e3 * expected:.2f}']


def pins() -> Iterator[list[str]]:
    """Yield the rows of the table of pins."""
    chain = Chain(np.linspace(0, LENGTH, POINTS)[:, None] * [0, 0, -1.0])
    for solref, mass, stretching in product(SOLREFS, (MASS, 10 * MASS), (300.0,)):
        text = export_mjcf(made_up(1e-4, stretching, mass), chain, options=Options(table=False))
        held = Grip(0, np.array([0.0, 2 * FALL]), np.zeros((2, 3)))
        model, state = started(with_hands(text, [held], solref))
        state.eq_active[:] = 1
        mujoco.mj_step(model, state, round(FALL / model.opt.timestep))
        assert not state.warning.number.any(), 'MuJoCo warns that it is unstable'
        yield [solref, f'{1e3 * mass:g}', f'{stretching:g}', f'{-1e3 * points_of(model, state)[0, 2]:.2f}']


def speeds() -> Iterator[list[str]]:
    """Yield the rows of the table of speeds."""
    dlo = read_result(figures.SAMPLES / 'xml/dlo.xml')
    radius, along = dlo.physical()['self_collision'], np.linspace(0, dlo.chain.length, 101)
    angle, nothing = along / COIL, 0 * along
    chains = {'on the table': np.stack([along, nothing, nothing + radius], axis=1),
              'hangs from a hand': np.stack([nothing, nothing, dlo.chain.length + 0.2 - along], axis=1),
              'coiled on the table': np.stack([COIL * np.cos(angle), COIL * np.sin(angle), radius * (
                  2 + PITCH * angle / np.pi)], axis=1)}
    for nodes, where in product((21, 41), chains):
        held = Grip(0, np.array([0.0, FALL]), np.repeat(chains[where][:1], 2, axis=0))
        row = []
        for form in ('extensible', 'inextensible'):
            text = export_mjcf(dlo, Chain(chains[where]), form=form, options=Options(nodes=nodes))
            model, state = started(with_hands(text, [held] * ('hand' in where)))
            state.eq_active[:] = 1
            second = round(1 / model.opt.timestep)
            mujoco.mj_step(model, state, second)
            begun = time.process_time()
            mujoco.mj_step(model, state, second)
            assert not state.warning.number.any(), f'{where}: MuJoCo warns that it is unstable'
            row.append(f'{1 / (time.process_time() - begun):.2g}')
        yield [str(nodes), where, str(state.ncon), *row]


def with_hands(text: str, held: list[Grip], solref: str = SOLREFS[-1]) -> str:
    """Return a file with a hand for each grip, all open."""
    root = etree.fromstring(text.encode())
    equality = etree.SubElement(root, 'equality')
    for k, grip in enumerate(held):
        body = etree.SubElement(root.find('worldbody'), 'body', name=f'hand_{k}', mocap='true',
                                pos=' '.join(map(str, grip.positions[0])))
        etree.SubElement(body, 'site', name=f'hand_{k}')
        etree.SubElement(equality, 'connect', name=f'hand_{k}', site1=f'hand_{k}',
                         site2=f'dlo_point_{grip.point}', active='false', solref=solref)
    return etree.tostring(root, encoding='unicode')


def replayed(result: Any, trial: Trial, options: Options) -> tuple[Floats, float]:
    """Return the simulated points at the goal of a trial, (n, 3) [m], and the processor time of a second."""
    goal = trial.goals[0]
    held, offsets = grips(trial, goal.time + LONGEST), dict[int, Floats]()
    model, state = started(with_hands(export_mjcf(result, trial.initial, options=options), held))
    step, earlier, since, begun = model.opt.timestep, points_of(model, state), 0.0, time.process_time()
    while True:
        for k, grip in enumerate(held):
            constraint = model.equality(f'hand_{k}').id
            if k not in offsets and grip.times[0] <= state.time + step / 2:
                offsets[k] = state.site(f'dlo_point_{grip.point}').xpos - grip.positions[0]
                state.eq_active[constraint] = 1
            if k in offsets:
                now = [np.interp(state.time + step, grip.times, axis) for axis in grip.positions.T]
                state.mocap_pos[model.body(f'hand_{k}').mocapid[0]] = now + offsets[k]
                if grip.times[-1] <= state.time + step / 2:
                    state.eq_active[constraint] = 0
        mujoco.mj_step(model, state)
        assert not state.warning.number.any(), f'{trial.name}: MuJoCo warns that it is unstable'
        if state.time > goal.time and state.time - since >= Settling.time:
            now = points_of(model, state)
            if np.linalg.norm(now - earlier, axis=1).max() < Settling.distance or \
                    state.time > goal.time + LONGEST:
                return now, (time.process_time() - begun) / state.time
            earlier, since = now, state.time


def trials_of(name: str, folder: Path, other: bool) -> Iterator[tuple[str, Trial]]:
    """Yield the trials of a sample, and other actions with the same object."""
    for trial in read_session(figures.SAMPLES / name).trials:
        yield 'fitted', trial
    if not other:
        return
    for trial in read_session(convert('reference', name, folder / name, '--actions', 'other')).trials:
        yield 'other', trial


def replays(folder: Path, other: bool) -> Iterator[list[str]]:
    """Yield a row for each sample and kind of trial: mean distances, MuJoCo's and ours."""
    for name in OBJECTS:
        session = read_session(figures.SAMPLES / name)
        result = calibrate(session.trials, replace(session.options, engine='compiled'))
        engine, rows = CompiledSimulator(), dict[str, list[tuple[float, ...]]]()
        for kind, trial in trials_of(name, folder, other):
            measured = trial.goals[0].chain.points
            ours = engine.simulate(trial, result.physical()).chains[0]
            theirs, share = replayed(result, trial, session.options)
            row = distance(theirs, measured), distance(ours, measured), distance(theirs, ours), share
            rows.setdefault(kind, []).append(row)
            print(name, kind, trial.name, *(f'{figure:.2f}' for figure in row), flush=True)
        for kind, all_of_kind in rows.items():
            table = np.array(all_of_kind)
            to_measured, ours_to, between, share = table.mean(axis=0)
            yield [name[-1], kind, str(len(table)), f'{to_measured:.2f}', f'{ours_to:.2f}',
                   f'{to_measured / ours_to:.2f}', f'{between:.2f}', f'{table[:, 0].max():.2f}',
                   f'{share:.1f}']


def minutes() -> Iterator[list[str]]:
    """Yield a row for each sample: how far its points move in a minute."""
    for name in OBJECTS:
        session = read_session(figures.SAMPLES / name)
        result = calibrate(session.trials, replace(session.options, engine='compiled'))
        model, state = started(export_mjcf(result, session.trials[0].initial, options=session.options))
        second = round(1 / model.opt.timestep)
        mujoco.mj_step(model, state, second)
        before = points_of(model, state)
        mujoco.mj_step(model, state, 60 * second)
        assert not state.warning.number.any(), f'{name}: MuJoCo warns that it is unstable'
        now = points_of(model, state)
        yield [name[-1], f'{distance(now, before):.3f}',
               f'{1e3 * np.linalg.norm(now - before, axis=1).max():.3f}']


def main() -> None:
    """Make the tables that the command line names, or all."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('parts', nargs='*', choices=[[], *PARTS], help='default: all but minute')
    parser.add_argument('--other', action='store_true', help='also other actions with the same objects')
    chosen = parser.parse_args()
    mujoco.set_mju_user_warning(lambda message: None)  # no log file; warnings are counted in the state
    for part in chosen.parts or [name for name in PARTS if name != 'minute']:
        other = ' --other' if part == 'trials' and chosen.other else ''
        with tempfile.TemporaryDirectory() as folder:
            rows = {'cantilever': cantilevers, 'hanging': stretches, 'flexcomp': flexcomps, 'pin': pins,
                    'speed': speeds, 'minute': minutes,
                    'trials': partial(replays, Path(folder), chosen.other)}[part]()
            text = figures.table(PARTS[part][1], rows)
        name = f'export_mujoco_{mujoco.__version__.split(".")[0]}_{part}'
        (figures.HERE / 'results' / f'{name}.md').write_text(
            f'# {name}\n\n`python benchmark/export_mujoco.py {part}{other}`\n\n{PARTS[part][0]} '
            f'MuJoCo {mujoco.__version__}, steps of 2 ms. '
            f'{figures.machine()}\n\n{text}\n', encoding='utf-8')
        print(text, flush=True)


if __name__ == '__main__':
    main()
