# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Scenes of a stranger: damaged and hostile URDF, .obj and .stl files, each refused or simulated.

Most are loaded and simulated for some steps by a process that takes one after the other; some by `fit`.
"""

from __future__ import annotations

from contextlib import closing, suppress
import os
from pathlib import Path
import shutil
import sys
import time

import numpy as np
from tally import finish, Tally, verb

FULL = 1200
EACH_FIT = 120  # scenes for each one that `fit` gets, too
LIMIT = 120.0  # s for one scene; one that takes longer hangs

PLATE = '<collision><origin xyz="0.2 0 -0.1"/><geometry>{}</geometry></collision>'
BOX = PLATE.format('<box size="0.6 0.4 0.1"/>')
NUMBERS = ('nan', '-inf', '1e309', '1e300', '-1e12', '1e-300', '0', '-1', '', 'x', '1 1', '9' * 5000)


def wrong(generator: np.random.Generator) -> str:
    """Return a number that is none, or has no use."""
    return NUMBERS[generator.integers(len(NUMBERS))]


def robot(*inside: str) -> bytes:
    """Return a URDF file."""
    return f'<robot name="r">{"".join(inside)}</robot>'.encode()


def link(inside: str = BOX, name: object = 'a') -> str:
    """Return a link."""
    return f'<link name="{name}">{inside}</link>'


def joint(parent: object, child: object, xyz: str = '0 0 0') -> str:
    """Return a joint."""
    return f'<joint name="j"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/></joint>'


def mesh(name: str) -> bytes:
    """Return a URDF file with one mesh."""
    return robot(link(PLATE.format(f'<mesh filename="{name}"/>')))


def sheet(count: int) -> np.ndarray:
    """Return (2 count**2, 3, 3) [m] triangles of a wavy sheet."""
    x, y = np.meshgrid(*[np.linspace(-0.5, 0.5, count + 1)] * 2)
    points = np.stack([x, y, 0.01 * np.sin(20 * x)], axis=-1)
    first, second, third, fourth = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    return np.concatenate([np.stack(corners, axis=2).reshape(-1, 3, 3)
                           for corners in ((first, second, third), (first, third, fourth))])


def obj(triangles: np.ndarray) -> bytes:
    """Return an .obj file."""
    corners = ''.join('v {:.5g} {:.5g} {:.5g}\n'.format(*point) for point in triangles.reshape(-1, 3))
    faces = ''.join(f'f {3 * k + 1} {3 * k + 2} {3 * k + 3}\n' for k in range(len(triangles)))
    return (corners + faces).encode()


def stl(triangles: np.ndarray, count: int | None = None) -> bytes:
    """Return a binary .stl file, which may lie about its count."""
    facets = np.zeros(len(triangles), [('normal', '<f4', 3), ('corners', '<f4', (3, 3)), ('colour', '<u2')])
    facets['corners'] = triangles
    return bytes(80) + (len(triangles) if count is None else count).to_bytes(4, 'little') + facets.tobytes()


def ascii_stl(triangles: np.ndarray) -> bytes:
    """Return a text .stl file."""
    facets = ''.join('facet normal 0 0 1\nouter loop\n' + ''.join(
        'vertex {:g} {:g} {:g}\n'.format(*point) for point in corners) + 'endloop\nendfacet\n'
        for corners in triangles)
    return f'solid s\n{facets}endsolid s\n'.encode()


def damaged(octets: bytes, generator: np.random.Generator) -> bytes:
    """Return a file cut, with bytes changed, or with a piece repeated."""
    piece = bytearray(octets)
    kind, place = generator.integers(3), int(generator.integers(len(piece)))
    if kind == 0:
        return bytes(piece[:place])
    if kind == 1:
        for where in generator.integers(len(piece), size=generator.integers(1, 8)):
            piece[where] = generator.integers(256)
        return bytes(piece)
    return bytes(piece[:place] + piece[place // 2:])


def write_scene(folder: Path, number: int, seed: int) -> Path:
    """Write the scene of a number into an empty folder, and return its path."""
    generator = np.random.default_rng((seed, number))
    kinds = (_mesh_damaged, _mesh_wrong, _document_damaged, _document_wrong, _numbers_wrong, _place_wrong,
             _large)
    path = folder / 'scene.urdf'
    kinds[number % len(kinds)](path, generator)
    return path


def _mesh_damaged(path: Path, generator: np.random.Generator) -> None:
    name, make = (('m.obj', obj), ('m.stl', stl), ('m.stl', ascii_stl))[generator.integers(3)]
    path.write_bytes(mesh(name))
    (path.parent / name).write_bytes(damaged(make(sheet(4)), generator))


def _mesh_wrong(path: Path, generator: np.random.Generator) -> None:
    index = int(generator.choice([0, -1, -97, 97, 10**6, 2**31, 2**63, -2**63, 10**20]))
    flat = sheet(4) * (1, 1, 0)
    name, octets = (
        ('m.obj', obj(sheet(4)) + f'f 1 2 {index}\n'.encode()),
        ('m.obj', obj(sheet(4)) + f'f {index}/1/1 {index}/1/1 {index}/1/1\n'.encode()),
        ('m.obj', obj(sheet(4)) + f'v {wrong(generator)} 0 0\nf 1 2 97\n'.encode()),
        ('m.obj', obj(sheet(4)) + b'f ' + b'1 2 ' * int(generator.integers(4000))),
        ('m.obj', obj(np.repeat(flat[:, :1], 3, axis=1))),  # triangles that are points
        ('m.obj', obj(flat.repeat(3, axis=0))),
        ('m.stl', stl(sheet(4), index % 2**32)),
        ('m.stl', stl(np.full((4, 3, 3), float(generator.choice([np.nan, np.inf, 3e38, 1e-40]))))),
        ('m.stl', ascii_stl(sheet(2)).replace(b'-0.5', wrong(generator).encode(), 1)),
        ('m.dae', b'<COLLADA/>'), ('m.cdf', b'x'),
    )[generator.integers(11)]
    path.write_bytes(mesh(name))
    (path.parent / name).write_bytes(octets)


def _document_damaged(path: Path, generator: np.random.Generator) -> None:
    path.write_bytes(damaged(robot(link(), link('', 'b'), joint('a', 'b')), generator))


def _document_wrong(path: Path, generator: np.random.Generator) -> None:
    entities = '<!ENTITY a0 "aaaaaaaaaa">' + ''.join(
        f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))
    bomb = f'<!DOCTYPE r [{entities}]><robot name="&a9;">{link()}</robot>'
    count = int(generator.choice([100, 9000, 20_000]))
    chain = [link('', k) for k in range(count)], [joint(k, k + 1, '0 0 0.001') for k in range(count - 1)]
    deep = int(generator.choice([1000, 100_000, 1_000_000]))
    path.write_bytes((
        bomb.encode(), bomb.encode('utf-16'), f'<?xml version="1.0" encoding="utf-7"?>{bomb}'.encode(),
        robot(*chain[0], link(BOX, 'z'), *chain[1], joint(count - 1, 'z')),
        robot(*chain[0], link(BOX, 'z'), *chain[1], joint(count - 1, 0), joint(0, 'z')),
        robot(link(), joint('a', 'a')),
        b'<robot>' + b'<a>' * deep + b'</a>' * deep + b'</robot>',
        robot(link() + '<a/>' * deep),
        robot(link(BOX * int(generator.choice([1999, 2001, 50_000])))),
        robot(link(BOX.replace('0.6 0.4 0.1', '1 ' * deep))),
        robot(link(BOX, 'a' * deep)),
        b'', b'\0' * 1000, b'<robot/>',
    )[generator.integers(14)])


def _numbers_wrong(path: Path, generator: np.random.Generator) -> None:
    one, other = wrong(generator), wrong(generator)
    path.write_bytes((
        robot(link(PLATE.format(f'<box size="{one} 0.1 {other}"/>'))),
        robot(link(PLATE.format(f'<sphere radius="{one}"/>'))),
        robot(link(PLATE.format(f'<cylinder radius="{one}" length="{other}"/>'))),
        robot(link(PLATE.format('<capsule radius="1e6" length="1e-6"/>'))),
        robot(link(BOX.replace('0.2 0 -0.1', f'{one} {other} 0'))),
        robot(link(BOX.replace('xyz=', f'rpy="{one} 1e6 0" xyz='))),
        robot(link(f'<contact><lateral_friction value="{one}"/></contact>{BOX}')),
        robot(link('', 'a'), link(BOX, 'b'), joint('a', 'b', f'{one} 0 1e6')),
        mesh('m.obj').replace(b'/></geometry', f' scale="{one} 1 -1"/></geometry'.encode()),
    )[generator.integers(9)])
    (path.parent / 'm.obj').write_bytes(obj(sheet(2)))


def _place_wrong(path: Path, generator: np.random.Generator) -> None:
    folder = path.parent
    names = ('pipe.obj', 'folder.obj', 'zero.stl', 'outside.obj', 'loop.obj', '../../../../etc/passwd',
             'a' * 5000, '/etc/passwd', 'file:///dev/zero', 'package://a/../../m.obj', 'package://m.obj',
             'm.obj\0.stl')
    os.mkfifo(folder / 'pipe.obj')
    (folder / 'folder.obj').mkdir()
    for name, target in (('zero.stl', '/dev/zero'), ('outside.obj', '/etc/passwd'),
                         ('loop.obj', 'loop.obj')):
        (folder / name).symlink_to(target)
    path.write_bytes(mesh(names[generator.integers(len(names))]))
    if generator.integers(8) == 0:  # the scene itself is none
        path.unlink()
        (os.mkfifo, Path.mkdir, lambda one: one.symlink_to('/dev/zero'))[generator.integers(3)](path)


def _large(path: Path, generator: np.random.Generator) -> None:
    """Write what is at or above a limit now and then, and small valid scenes else."""
    many = int(generator.integers(20))
    path.write_bytes(mesh('m.obj' if many == 1 else 'm.stl'))
    if many == 0:
        (path.parent / 'm.stl').write_bytes(stl(sheet(316)))  # 199,712 triangles
    elif many == 1:
        line = (b'\n', b'v 0 0 0\n', b'f 1 2 3\n')[generator.integers(3)]
        (path.parent / 'm.obj').write_bytes(line * 6_000_000)
    elif many == 2:
        with (path.parent / 'm.stl').open('wb') as stream:
            stream.truncate(2**40)  # a hole of a terabyte
    elif many == 3:
        path.write_bytes(robot(link(PLATE.format('<mesh filename="m.stl"/>') * 1500)))
        (path.parent / 'm.stl').write_bytes(stl(sheet(12)))
    else:
        (path.parent / 'm.stl').write_bytes(stl(sheet(many)))


def simulate(folder: Path, first: int, end: int, seed: int) -> None:
    """Load and simulate scenes; print the number of each, what became of it, and how long it took [s]."""
    from dlo_calibration import Action, Chain, DloCalibrationError, Goal, Hand, Trial
    from dlo_calibration.model.parameters import ParameterSpace
    from dlo_calibration.simulation.bullet import BulletSimulator
    from dlo_calibration.simulation.compiled import CompiledSimulator
    from dlo_calibration.simulation.scene import read_scene

    points = np.linspace((0.0, 0.0, 0.02), (0.4, 0.0, 0.02), 9)
    trial = Trial('drop', Chain(points), (Action((Hand('hand', (0,), [0.0, 0.02], points[[0, 0]]),)),),
                  (Goal(Chain(points), 0.1, stable=False),))
    physical = ParameterSpace().physical({}, 0.4)
    for number in range(first, end):
        place = folder / f'{number}'
        place.mkdir()
        scene = write_scene(place, number, seed)
        begun = time.monotonic()
        print(number, 'begun', flush=True)
        try:
            with closing(BulletSimulator(scene=str(scene), nodes=9, time_step=0.01)) as engine:
                engine.simulate(trial, physical)
            CompiledSimulator(obstacles=read_scene(str(scene)), nodes=9, time_step=0.01).simulate(
                trial, physical)
            outcome = 'simulated'
        except DloCalibrationError as error:
            outcome = 'refused' if len(str(error)) < 1000 else 'died of a refusal that is too long'
        print(number, outcome.replace(' ', '_'), time.monotonic() - begun, flush=True)
        shutil.rmtree(place)


def conduct(amount: int, seed: int, folder: Path) -> Tally:
    """Try `amount` scenes; `died` counts processes that ended or hung, and errors that are no refusal."""
    tally, number = Tally(), 0
    while number < amount:
        ended = finish(sys.executable, __file__, folder, number, amount, seed, folder=folder,
                       limit=LIMIT + 2.0 * (amount - number))
        rows = [line.split() for line in ended.out.splitlines() if line[:1].isdigit()]
        done = [row for row in rows if len(row) == 3]
        tally.tried += len(done)
        tally.refused += sum(row[1] == 'refused' for row in done)
        tally.died += sum(row[1].startswith('died') for row in done)
        tally.remember(peak=ended.peak, silence=max((float(row[2]) for row in done), default=0.0))
        if ended.code != 0:
            begun = int(rows[-1][0]) if rows else number
            print(f'scene {begun} of seed {seed}: exit code {ended.code}\n{ended.err[-2000:]}',
                  file=sys.stderr)
            tally.tried, tally.died = tally.tried + 1, tally.died + 1
            if not rows:
                break
            number = begun + 1
        else:
            number = amount
    for number in range(EACH_FIT - 1, amount, EACH_FIT):
        _fit(folder, number, seed, tally)
    return tally


def _fit(folder: Path, number: int, seed: int, tally: Tally) -> None:
    """Let `fit` use a scene for one evaluation."""
    place = folder / f'fit {number}'
    place.mkdir()
    scene = write_scene(place, number, seed)
    session = Path(__file__).resolve().parents[2] / 'msg_samples' / 'object1'
    ended = verb('fit', session, '--scene', scene, '--evaluations', 1, '--workers', 1, '--nodes', 9,
                 '--time-step', 0.01, '--settle-limit', 0.1, '--search', 'random', '--output', place / 'out',
                 folder=folder, limit=LIMIT)
    tally.tried += 1
    tally.refused += ended.code == 2
    if ended.code not in (0, 1, 2) or 'Traceback' in ended.err:
        print(f'fit with scene {number} of seed {seed}: exit code {ended.code}\n{ended.err[-2000:]}',
              file=sys.stderr)
        tally.died += 1
    tally.remember(peak=ended.peak, silence=ended.seconds)
    with suppress(OSError):
        shutil.rmtree(place)


if __name__ == '__main__':
    simulate(Path(sys.argv[1]), *map(int, sys.argv[2:5]))
