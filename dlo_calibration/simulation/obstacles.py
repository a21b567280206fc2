# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Scene: fixed obstacles that the DLO touches, described by a URDF file.

Only links, the origins of joints (movable joints are at position 0), collision shapes
and their friction are read.  The importer of an engine would make one articulated body,
whose links move when they are touched.

The file may come from a stranger.  Its XML has no document type and no entities, all sizes
are limited, and meshes are read only from the folder of the file, and from packages.
"""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path
from typing import Iterator, Mapping, TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats, frozen_array
from dlo_calibration.simulation.mesh import (
    FURTHEST,
    LARGEST_FILE,
    MOST_TRIANGLES,
    open_regular,
    read_mesh,
)

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

# Each is about ten times what a robot cell needs; then reading takes seconds and some 100 MB at most.
MOST_BYTES = 8 * 2**20  # of the URDF file
MOST_ELEMENTS = 100_000
MOST_LINKS = 10_000
MOST_SHAPES = 2000
MOST_TEXT = 100  # characters of an attribute with numbers
SMALLEST, LARGEST = 1e-6, FURTHEST  # m; sizes of shapes, and the scale of a mesh

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
    :param friction: Coulomb coefficient; 1, as of the table, if the link has none.
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
        raise unusable(path, f'no XML document ({shown(str(error), 150)})') from error
    if robot.tag != 'robot':
        raise unusable(path, f'the root element <{shown(robot.tag)}>', 'name a <robot> file')
    found = tuple(_Reader(path, robot).obstacles())
    if not found:
        raise unusable(path, 'no collision shape', 'add <collision> elements')
    return found


def unusable(path: str, came: str, remedy: str = 'correct the file') -> InputError:
    """Return the error for a scene that cannot be used."""
    return InputError(f'scene {path}', came, 'a URDF file with collision shapes', remedy)


def _parsed(octets: bytes) -> ElementTree.Element:
    """
    Return the root element of a document.

    :raises ValueError: if it has a document type, whose entities could fill the memory, or is too large.
    """
    if len(octets) > MOST_BYTES:
        raise ValueError(f'more than {MOST_BYTES} bytes')
    text = octets.decode('utf-8-sig')
    if '<!DOCTYPE' in text or '<!ENTITY' in text:
        raise ValueError('a document type or an entity, which is not allowed')
    if text.count('<') > 2 * MOST_ELEMENTS:
        raise ValueError(f'more than {MOST_ELEMENTS} elements')
    return ElementTree.fromstring(text)  # of a text, so that no declaration changes how it is decoded


def shown(text: str, most: int = 60) -> str:
    """Return a text of the file as an error shows it: its beginning, if it is long."""
    return text if len(text) <= most else f'{text[:most]}...'


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
                raise unusable(path, f'the joint {shown(joint.get("name", ""))!r} from and to '
                               f'{shown(str(ends))}',
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
                raise unusable(self._path, f'the shape <{shown(geometry.tag)}> of link {shown(name)!r}',
                               f'use one of {", ".join(SIZES)}')
            position, turn = _after(self._frame(name), self._origin(collision))
            if np.abs(position).max() > FURTHEST:
                raise unusable(self._path, f'a {geometry.tag} of link {shown(name)!r} at '
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
                raise unusable(self._path, f'joints that form a loop at link {shown(name)!r}')
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
        said = f'the mesh {shown(name)!r}'
        try:
            file = self._file(name)
            if file is None:
                raise unusable(self._path, f'{said}, which is not there', 'name an .obj or .stl file in the '
                               'folder of the scene, relative to it, or package://...')
            if file not in self._meshes:
                if sum(one.stat().st_size for one in (*self._meshes, file)) > LARGEST_FILE:
                    raise ValueError(f'more than {LARGEST_FILE} bytes with the meshes before')
                self._meshes[file] = read_mesh(str(file))
        except (OSError, ValueError) as error:
            raise unusable(self._path, f'{said}: {shown(str(error), 150)}',
                           'export the mesh again, as a simpler .obj or .stl') from error
        return self._meshes[file]

    def _file(self, name: str) -> Path | None:
        """
        Return the path of a mesh in the folder of the scene or in a package; None if there is none.

        :raises InputError: if it is outside of them.
        """
        kind, _, rest = name.partition('://')
        if kind == 'package':
            package, _, inside = rest.partition('/')
            if not inside or {package, *Path(inside).parts} & {'', '.', '..', '/'}:
                return None
            # Links inside a package are followed: colcon's --symlink-install makes them.
            prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(':')
            found = (Path(prefix) / 'share' / rest for prefix in prefixes if prefix)
            return next((file for file in found if file.exists()), None)
        # Unlike `Path.resolve`, this does not fail at links that form a loop.
        folder = Path(os.path.realpath(self._path)).parent
        file = Path(os.path.realpath(folder / (rest or name)))
        if not file.is_relative_to(folder):
            raise unusable(self._path, f'the mesh {shown(name)!r}, which is outside the folder of the scene',
                           'move it there, or name it package://...')
        return file if name and file.exists() else None

    def _friction(self, link: ElementTree.Element) -> float:
        element = link.find('contact/lateral_friction')
        friction = 1.0 if element is None else float(self._numbers(element, 'value', 1)[0])
        if friction < 0:
            name = shown(link.get('name', ''))
            raise unusable(self._path, f'lateral_friction {friction:g} of link {name!r}', 'make it 0 or more')
        return friction

    def _numbers(self, element: ElementTree.Element, name: str, count: int, default: str = '') -> Floats:
        text = element.get(name, default)
        try:
            numbers = np.array([float(word) for word in text.split()] if len(text) <= MOST_TEXT else [])
        except ValueError:
            numbers = np.zeros(0)
        if len(numbers) != count or not (np.abs(numbers) <= LARGEST).all():  # NaN is not
            raise unusable(self._path, f'{name}={shown(text)!r} in <{element.tag}>',
                           f'write {count} number{"s" if count > 1 else ""} up to {LARGEST:g}')
        return numbers


def _after(first: tuple[Floats, Rotation], second: tuple[Floats, Rotation]) -> tuple[Floats, Rotation]:
    """Return the frame `second`, given relative to the frame `first`, in the frame of `first`'s parent."""
    return first[0] + first[1].apply(second[0]), first[1] * second[1]
