# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Scene: fixed obstacles that the DLO touches, described by a URDF file.

Only links, the origins of joints (movable joints are at position 0), collision shapes
and their friction are read.  The importer of an engine would make one articulated body,
whose links move when they are touched.

The file may come from a stranger.  Document types and entities are refused, all sizes are
limited, and meshes are read only from the folder of the file and from packages.  No other
parser reads its .obj and .stl files, as PyBullet's ends the process at an index out of range.
PyBullet gets a file that is written here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
import os
from pathlib import Path
import re
import stat
from typing import BinaryIO, Iterator, Mapping, Sequence, TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from dlo_calibration.errors import InputError, shortened
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.simulation import core
from dlo_calibration.simulation.distance_grid import DistanceGrid, MOST_MESHES

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

KINDS = ('.obj', '.stl')
MOST_TRIANGLES = 200_000  # of all meshes of a scene: about 250 MB in Bullet
LARGEST_FILE = 64 * 2**20  # bytes; that many triangles need less
LONGEST_LINE = 10_000  # bytes; a face of a thousand corners fits
FURTHEST = 1e6  # m; Bullet computes meshes with 7 digits, so that the error there is already 10 cm

#: One triangle of a binary .stl file: its normal, which is not used, its corners and a colour.
_FACET = np.dtype([('normal', '<f4', 3), ('corners', '<f4', (3, 3)), ('colour', '<u2')])

# About ten times what a robot cell needs; reading takes at most seconds and some 100 MB.
MOST_BYTES = 8 * 2**20  # of the URDF file
MOST_ELEMENTS = 100_000
MOST_LINKS = 10_000
MOST_SHAPES = 2000
MOST_TEXT = 100  # characters of an attribute with numbers
excerpt = partial(shortened, most=60)  # of a text of the file, for errors
SMALLEST, LARGEST = 1e-6, FURTHEST  # m; sizes of shapes, and the scale of a mesh

AROUND = 64  # corners of a circle

NO_TRIANGLES = frozen_array(np.zeros((0, 3, 3)))

#: shape -> its attributes that are sizes [m]
SIZES: Mapping[str, tuple[str, ...]] = {
    'box': ('size',), 'sphere': ('radius',), 'cylinder': ('length', 'radius'),
    'capsule': ('length', 'radius'), 'mesh': ('scale',)}


@dataclass(frozen=True)
class Obstacle:
    """
    A collision shape that does not move.

    :param shape: one of `SIZES`.
    :param sizes: (3,) [m] edges of a box; (1,) radius of a sphere; (2,) length and
        radius of a cylinder or capsule along z; (3,) scale of a mesh.
    :param position: (3,) [m] of its centre.
    :param turn: (4,) orientation, quaternion x y z w.
    :param friction: Coulomb coefficient; 1, that of the table, if the link has none.
    :param triangles: (t, 3, 3) [m] corners of the triangles of a mesh, before it is scaled; else empty.
    """

    shape: str
    sizes: Floats
    position: Floats
    turn: Floats
    friction: float
    triangles: Floats

    def __post_init__(self) -> None:
        for name in ('sizes', 'position', 'turn', 'triangles'):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))


def read_scene(path: str) -> tuple[Obstacle, ...]:
    """
    Return every collision shape of a URDF file, in the order of the file.

    :raises InputError: if the file cannot be used; the text names the element.
    """
    try:
        with open_regular(path) as stream:
            octets = stream.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise unusable(path, str(error), 'check the path; it is relative to the working directory') from error
    try:
        robot = _parsed(octets)
    except (ElementTree.ParseError, ValueError) as error:
        raise unusable(path, f'no XML document ({shortened(str(error), 150)})') from error
    if robot.tag != 'robot':
        raise unusable(path, f'the root element <{excerpt(robot.tag)}>', 'name a <robot> file')
    obstacles = tuple(_Reader(path, robot).obstacles())
    if not obstacles:
        raise unusable(path, 'no collision shape', 'add <collision> elements')
    return obstacles


def core_scene(obstacles: Sequence[Obstacle]) -> core.Scene:
    """
    Return obstacles as bodies of the core; a mesh becomes a `DistanceGrid`.

    :raises InputError: if a mesh has no inside, or there are too many different ones.
    """
    meshes = {(obstacle.triangles.tobytes(), *obstacle.sizes)
              for obstacle in obstacles if obstacle.shape == 'mesh'}
    if len(meshes) > MOST_MESHES:
        raise InputError('scene', f'{len(meshes)} different meshes', f'at most {MOST_MESHES}',
                         'join some, or use engine bullet')
    return core.Scene([core_body(obstacle) for obstacle in obstacles])


def core_body(obstacle: Obstacle) -> core.Body:
    """Return one of the bodies of `core_scene`."""
    from scipy.spatial.transform import Rotation  # slow to load

    turn = Rotation.from_quat(obstacle.turn).as_matrix().ravel()
    if obstacle.shape != 'mesh':
        halves = {'box': (0.5, 0.5, 0.5), 'sphere': (1.0,), 'cylinder': (0.5, 1.0), 'capsule': (0.5, 1.0)}
        return core.Body(obstacle.shape, obstacle.sizes * halves[obstacle.shape], obstacle.position, turn,
                         obstacle.friction)
    try:
        grid = DistanceGrid.of(obstacle.triangles * obstacle.sizes)
    except ValueError as error:
        raise InputError('scene', f'{error}', 'closed meshes', 'close it in the program that made it, or use '
                         'engine bullet') from error
    return core.Body.of_grid(grid.shared, obstacle.position, turn, obstacle.friction)


def extremes(obstacle: Obstacle) -> tuple[Floats, float]:
    """Return points, (m, 3) [m], and a radius [m]; the hull of balls around these points is the obstacle."""
    from scipy.spatial.transform import Rotation  # slow to load

    sizes, radius = obstacle.sizes, 0.0
    if obstacle.shape == 'box':
        local = np.stack(np.meshgrid(*([-0.5, 0.5],) * 3), axis=-1).reshape(-1, 3) * sizes
    elif obstacle.shape == 'sphere':
        local, radius = np.zeros((1, 3)), float(sizes[0])
    elif obstacle.shape == 'capsule':
        local, radius = np.array([[0, 0, -0.5], [0, 0, 0.5]]) * sizes[0], float(sizes[1])
    elif obstacle.shape == 'cylinder':
        angles = 2 * np.pi * np.arange(AROUND) / (AROUND)
        circle = np.column_stack([np.cos(angles), np.sin(angles)]) * sizes[1]
        local = np.vstack([np.column_stack([circle, np.full(len(circle), z)])
                           for z in (-sizes[0] / 2, sizes[0] / 2)])
    else:
        local = obstacle.triangles.reshape(-1, 3) * sizes
    return Rotation.from_quat(obstacle.turn).apply(local) + obstacle.position, radius


def unusable(path: str, came: str, remedy: str = 'correct the file') -> InputError:
    """Return the error for a scene that cannot be used."""
    return InputError(f'scene {path}', came, 'a URDF file with collision shapes', remedy)


def _parsed(octets: bytes) -> ElementTree.Element:
    """
    Return the root element of a document.

    :raises ValueError: if it is too large, or has a document type, whose entities could fill the memory.
    """
    if len(octets) > MOST_BYTES:
        raise ValueError(f'more than {MOST_BYTES} bytes')
    text = octets.decode('utf-8-sig')
    if '<!DOCTYPE' in text or '<!ENTITY' in text:
        raise ValueError('a document type or an entity, which is not allowed')
    if text.count('<') > 2 * MOST_ELEMENTS:
        raise ValueError(f'more than {MOST_ELEMENTS} elements')
    return ElementTree.fromstring(text)  # of a text, so that no declaration changes the decoding


class _Reader:
    def __init__(self, path: str, robot: ElementTree.Element) -> None:
        self._path = path
        self._frames: dict[str, tuple[Floats, Rotation]] = {}
        self._meshes: dict[Path, Floats] = {}
        self._links = {link.get('name', ''): link for link in robot.findall('link')}
        self._joints: dict[str, tuple[str, ElementTree.Element]] = {}  # child -> parent, joint
        if len(self._links) > MOST_LINKS:
            raise unusable(path, f'{len(self._links)} links', f'name {MOST_LINKS} at most')
        for joint in robot.findall('joint'):
            ends = [end.get('link', '') for tag in ('parent', 'child') for end in joint.findall(tag)]
            if len(ends) != 2 or ends[1] in self._joints or not set(ends) <= set(self._links):
                raise unusable(path, f'the joint {excerpt(joint.get("name", ""))!r} from and to '
                               f'{excerpt(str(ends))}',
                               'give each joint a parent link and a child link of its own')
            self._joints[ends[1]] = ends[0], joint

    def obstacles(self) -> Iterator[Obstacle]:
        """Yield the obstacles of all links."""
        shapes = [(name, collision, geometry) for name, link in self._links.items()
                  for collision in link.findall('collision') for geometry in collision.findall('geometry/*')]
        if len(shapes) > MOST_SHAPES:
            raise unusable(self._path, f'{len(shapes)} collision shapes', f'name {MOST_SHAPES} at most')
        triangles = 0
        frictions = {name: self._friction(link) for name, link in self._links.items()}
        for name, collision, geometry in shapes:
            if geometry.tag not in SIZES:
                raise unusable(self._path, f'the shape <{excerpt(geometry.tag)}> of link {excerpt(name)!r}',
                               f'use one of {", ".join(SIZES)}')
            position, turn = _after(self._frame(name), self._origin(collision))
            if np.abs(position).max() > FURTHEST:
                raise unusable(self._path, f'a {geometry.tag} of link {excerpt(name)!r} at '
                               f'{position.tolist()} m', f'place it within {FURTHEST:g} m')
            sizes = self._sizes(geometry)
            mesh = self._mesh(geometry) if geometry.tag == 'mesh' else NO_TRIANGLES
            obstacle = Obstacle(geometry.tag, sizes, position, turn.as_quat(), frictions[name], mesh)
            triangles += len(obstacle.triangles)
            if triangles > MOST_TRIANGLES:
                raise unusable(self._path, f'meshes of more than {MOST_TRIANGLES} triangles',
                               'simplify the meshes')
            yield obstacle

    def _frame(self, name: str) -> tuple[Floats, Rotation]:
        """Return the position (3,) [m] and the rotation of a link."""
        from scipy.spatial.transform import Rotation  # slow to load

        waiting: list[str] = []  # links from this one towards the root
        while name not in self._frames and name in self._joints:
            waiting.append(name)
            name = self._joints[name][0]
            if len(waiting) > len(self._links):
                raise unusable(self._path, f'joints that form a loop at link {excerpt(name)!r}')
        frame = self._frames.setdefault(name, (np.zeros(3), Rotation.identity()))
        for link in reversed(waiting):
            frame = self._frames[link] = _after(frame, self._origin(self._joints[link][1]))
        return frame

    def _origin(self, element: ElementTree.Element) -> tuple[Floats, Rotation]:
        """Return the position (3,) [m] and the rotation in the <origin> of an element."""
        from scipy.spatial.transform import Rotation

        origin = element.find('origin')
        if origin is None:
            return np.zeros(3), Rotation.identity()
        # rpy are angles about fixed axes: https://wiki.ros.org/urdf/XML/joint
        return self._numbers(origin, 'xyz', 3, '0 0 0'), \
            Rotation.from_euler('xyz', self._numbers(origin, 'rpy', 3, '0 0 0'))

    def _sizes(self, geometry: ElementTree.Element) -> Floats:
        names = SIZES[geometry.tag]
        count = 3 if geometry.tag in ('box', 'mesh') else 1
        sizes = np.concatenate([self._numbers(geometry, name, count, '1 1 1' if name == 'scale' else '')
                                for name in names])
        signless = np.abs(sizes) if geometry.tag == 'mesh' else sizes  # a negative scale mirrors the mesh
        if not (signless >= SMALLEST).all():
            raise unusable(self._path, f'sizes {sizes.tolist()} of a {geometry.tag}',
                           f'make them {SMALLEST:g} or more')
        return sizes

    def _mesh(self, geometry: ElementTree.Element) -> Floats:
        """Return the triangles of a mesh, as `read_mesh` does; each file is read once."""
        name = geometry.get('filename', '')
        mesh = f'the mesh {excerpt(name)!r}'
        try:
            file = self._file(name)
            if file is None:
                raise unusable(self._path, f'{mesh}, which is not there', 'name an .obj or .stl file in the '
                               'folder of the scene, relative to it, or package://...')
            if file not in self._meshes:
                if sum(path.stat().st_size for path in (*self._meshes, file)) > LARGEST_FILE:
                    raise ValueError(f'more than {LARGEST_FILE} bytes with the meshes before')
                self._meshes[file] = read_mesh(str(file))
        except (OSError, ValueError) as error:
            raise unusable(self._path, f'{mesh}: {shortened(str(error), 150)}',
                           'export the mesh again, as a simpler .obj or .stl') from error
        return self._meshes[file]

    def _file(self, name: str) -> Path | None:
        """
        Return the path of a mesh in the folder of the scene or in a package; None if there is none.

        :raises InputError: if it is elsewhere.
        """
        kind, _, rest = name.partition('://')
        if kind == 'package':
            package, _, inside = rest.partition('/')
            if not inside or {package, *Path(inside).parts} & {'', '.', '..', '/'}:
                return None
            # Links inside a package are followed: colcon's --symlink-install makes them.
            prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(':')
            files = (Path(prefix) / 'share' / rest for prefix in prefixes if prefix)
            return next((file for file in files if file.exists()), None)
        # Unlike `Path.resolve`, this does not fail at links that form a loop.
        folder = Path(os.path.realpath(self._path)).parent
        file = Path(os.path.realpath(folder / (rest or name)))
        if not file.is_relative_to(folder):
            raise unusable(self._path, f'the mesh {excerpt(name)!r}, which is outside the folder of the '
                           'scene', 'move it there, or name it package://...')
        return file if name and file.exists() else None

    def _friction(self, link: ElementTree.Element) -> float:
        element = link.find('contact/lateral_friction')
        friction = 1.0 if element is None else float(self._numbers(element, 'value', 1)[0])
        if friction < 0:
            name = excerpt(link.get('name', ''))
            raise unusable(self._path, f'lateral_friction {friction:g} of link {name!r}', 'make it 0 or more')
        return friction

    def _numbers(self, element: ElementTree.Element, name: str, count: int, default: str = '') -> Floats:
        text = element.get(name, default)
        try:
            numbers = np.array([float(word) for word in text.split()] if len(text) <= MOST_TEXT else [])
        except ValueError:
            numbers = np.zeros(0)
        if len(numbers) != count or not (np.abs(numbers) <= LARGEST).all():  # NaN is not
            raise unusable(self._path, f'{name}={excerpt(text)!r} in <{element.tag}>',
                           f'write {count} number{"s" if count > 1 else ""} up to {LARGEST:g}')
        return numbers


def _after(first: tuple[Floats, Rotation], second: tuple[Floats, Rotation]) -> tuple[Floats, Rotation]:
    """Return the composition of two frames, of which the second is relative to the first."""
    return first[0] + first[1].apply(second[0]), first[1] * second[1]


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """
    Open a regular file for reading; a pipe, for example, could block for ever.

    :raises OSError: if it cannot be opened, or is a directory, a pipe or a device.
    """
    number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise OSError('a directory, a pipe or a device, not a file')
    return os.fdopen(number, 'rb')


def read_mesh(path: str) -> Floats:
    """
    Return the corners of the triangles of a mesh, (t, 3, 3) [m], in the order of the file.

    Polygons are cut into triangles from their first corner.

    :raises ValueError: if it is not a valid .obj or .stl file, or too large; the text says why.
    :raises OSError: if it cannot be read.
    """
    kind = os.path.splitext(path)[1].lower()
    if kind not in KINDS:
        raise ValueError(f'a file {kind or "without a suffix"}, which is not read')
    with open_regular(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if size > LARGEST_FILE:
            raise ValueError(f'{size} bytes; at most {LARGEST_FILE} are read')
        triangles = _obj(stream) if kind == '.obj' else _stl(stream, size)
    if not len(triangles):
        raise ValueError('no triangle')
    if not (np.abs(triangles) <= FURTHEST).all():  # neither is NaN
        raise ValueError(f'a coordinate that is no number up to {FURTHEST:g}')
    return triangles.astype(float)


def stl_octets(triangles: Floats) -> bytes:
    """Return the binary .stl file of (t, 3, 3) [m] triangles as `read_mesh` returns them."""
    facets = np.zeros(len(triangles), _FACET)
    facets['corners'] = triangles
    return bytes(80) + len(triangles).to_bytes(4, 'little') + facets.tobytes()


def _obj(stream: BinaryIO) -> Floats:
    corners: list[float] = []
    faces: list[tuple[int, int, int]] = []
    for number, words in _lines(stream):
        try:
            if words[0] == b'v':
                x, y, z = words[1:4]
                corners += float(x), float(y), float(z)
            elif words[0] == b'f':
                first, *rest = (_index(word, len(corners) // 3) for word in words[1:])
                faces += ((first, *pair) for pair in zip(rest, rest[1:], strict=False))
        except ValueError as error:
            raise ValueError(f'line {number}: {str(error)[:80]}') from error
        if max(len(faces), len(corners) // 9) > MOST_TRIANGLES:
            raise ValueError(f'more than {MOST_TRIANGLES} triangles')
    indices = np.array(faces, int).reshape(-1, 3)
    count = len(corners) // 3
    if (indices >= count).any():
        raise ValueError(f'a face with vertex {indices.max() + 1} of {count}')
    triangles: Floats = _single(corners)[indices]
    return triangles


def _index(word: bytes, count: int) -> int:
    """Return the index of a vertex, from 0, in a word such as ``3/1/2``; -1 is the last vertex so far."""
    index = int(word.partition(b'/')[0])
    if not -count <= index <= 3 * MOST_TRIANGLES or index == 0:
        raise ValueError(f'a face with vertex {index} after {count} vertices')
    return index - 1 if index > 0 else count + index


def _stl(stream: BinaryIO, size: int) -> Floats:
    head = stream.read(84)
    count = int.from_bytes(head[80:84], 'little')
    if len(head) == 84 and size == 84 + _FACET.itemsize * count:
        if count > MOST_TRIANGLES:
            raise ValueError(f'{count} triangles; at most {MOST_TRIANGLES} are read')
        facets = np.frombuffer(stream.read(), _FACET)
        corners: Floats = facets['corners']
        return corners
    if not head.lstrip().startswith(b'solid'):
        raise ValueError(f'{size} bytes with the number {count} of triangles' if len(head) == 84
                         else f'{size} bytes')
    stream.seek(0)
    return _ascii_stl(stream)


def _ascii_stl(stream: BinaryIO) -> Floats:
    coordinates: list[float] = []
    kinds: list[bytes] = []
    for number, words in _lines(stream):
        kinds.append(words[0][:1] if words[0] == b'vertex' else words[0])
        if words[0] == b'vertex':
            try:
                x, y, z = words[1:]
                coordinates += float(x), float(y), float(z)
            except ValueError as error:
                raise ValueError(f'line {number}: {str(error)[:80]}') from error
        if len(kinds) > 8 * MOST_TRIANGLES:
            raise ValueError(f'more than {MOST_TRIANGLES} triangles')
    text = b' '.join(kinds)
    if not re.fullmatch(rb'(solid (facet outer v v v endloop endfacet )*endsolid ?)+', text):
        raise ValueError('facets that do not have three corners each, or an end that is missing')
    return _single(coordinates).reshape(-1, 3, 3)


def _lines(stream: BinaryIO) -> Iterator[tuple[int, list[bytes]]]:
    """Yield the number, from 1, and the words of each line that has any."""
    for number, line in enumerate(iter(lambda: stream.readline(LONGEST_LINE + 1), b''), 1):
        if len(line) > LONGEST_LINE:
            raise ValueError(f'line {number}: more than {LONGEST_LINE} bytes')
        words = line.split()
        if words:
            yield number, words


def _single(numbers: list[float]) -> Floats:
    """Return coordinates as (n, 3) points, in single precision as Bullet's own reader does."""
    with np.errstate(over='ignore'):
        return np.array(numbers, dtype=np.float32).astype(float).reshape(-1, 3)
