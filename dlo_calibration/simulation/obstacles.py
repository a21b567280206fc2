# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Scene: fixed obstacles that the DLO touches, described by a URDF file.

Only links, the origins of joints (movable joints are at position 0), collision shapes
and their friction are read.  The importer of an engine would make one articulated body,
whose links move when they are touched.
"""

from __future__ import annotations

from dataclasses import dataclass
import os
from pathlib import Path
from typing import Iterator, Mapping
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_calibration.errors import InputError
from dlo_calibration.model.chain import Floats, frozen_array

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
    :param file: path of a mesh; else empty.
    """

    shape: str
    sizes: Floats
    position: Floats
    turn: Floats
    friction: float
    file: str = ''

    def __post_init__(self) -> None:
        for name in ('sizes', 'position', 'turn'):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))


def read_scene(path: str) -> tuple[Obstacle, ...]:
    """
    Return every collision shape of a URDF file, in the order of the file.

    :raises InputError: if the file cannot be used; the text names the element.
    """
    try:
        octets = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise unusable(path, str(error), 'check the path; it is relative to the working directory') from error
    try:
        robot = ElementTree.fromstring(octets)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise unusable(path, f'no XML document ({error})') from error
    if robot.tag != 'robot':
        raise unusable(path, f'the root element <{robot.tag}>', 'name a <robot> file')
    found = tuple(_Reader(path, robot).obstacles())
    if not found:
        raise unusable(path, 'no collision shape', 'add <collision> elements')
    return found


def unusable(path: str, came: str, remedy: str = 'correct the file') -> InputError:
    """Return the error for a scene that cannot be used."""
    return InputError(f'scene {path}', came, 'a URDF file with collision shapes', remedy)


class _Reader:
    def __init__(self, path: str, robot: ElementTree.Element) -> None:
        self._path = path
        self._links = {link.get('name', ''): link for link in robot.findall('link')}
        self._joints: dict[str, tuple[str, ElementTree.Element]] = {}  # child -> parent, joint
        for joint in robot.findall('joint'):
            ends = [end.get('link', '') for tag in ('parent', 'child') for end in joint.findall(tag)]
            if len(ends) != 2 or ends[1] in self._joints or not set(ends) <= set(self._links):
                raise unusable(path, f'the joint {joint.get("name")!r} from and to {ends}',
                               'give each joint a parent link and a child link of its own')
            self._joints[ends[1]] = ends[0], joint

    def obstacles(self) -> Iterator[Obstacle]:
        """Yield the obstacles of all links."""
        for name, link in self._links.items():
            frame = self._frame(name)
            friction = self._friction(link)
            for collision in link.findall('collision'):
                for geometry in collision.findall('geometry/*'):
                    position, turn = _after(frame, self._origin(collision))
                    if geometry.tag not in SIZES:
                        raise unusable(self._path, f'the shape <{geometry.tag}> of link {name!r}',
                                       f'use one of {", ".join(SIZES)}')
                    yield Obstacle(geometry.tag, self._sizes(geometry), position, turn.as_quat(), friction,
                                   self._mesh(geometry) if geometry.tag == 'mesh' else '')

    def _frame(self, name: str) -> tuple[Floats, Rotation]:
        """Return the position (3,) [m] and the rotation of a link."""
        frame = np.zeros(3), Rotation.identity()
        for _ in self._links:
            if name not in self._joints:
                return frame
            name, joint = self._joints[name]
            frame = _after(self._origin(joint), frame)
        raise unusable(self._path, f'joints that form a loop at link {name!r}')

    def _origin(self, element: ElementTree.Element) -> tuple[Floats, Rotation]:
        """Return the position (3,) [m] and the rotation in the <origin> of an element."""
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
        if geometry.tag != 'mesh' and not (sizes > 0).all():
            raise unusable(self._path, f'sizes {sizes.tolist()} of a {geometry.tag}',
                           'make them larger than 0')
        return sizes

    def _mesh(self, geometry: ElementTree.Element) -> str:
        name = geometry.get('filename', '')
        kind, _, rest = name.partition('://')
        folders = [Path(self._path).resolve().parent]
        if kind == 'package' and rest:
            prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(':')
            folders = [Path(prefix) / 'share' for prefix in prefixes]
        for folder in folders:
            file = folder / (rest or name)
            if file.is_file():
                return str(file)
        raise unusable(self._path, f'the mesh {name!r}, which is not there',
                       'name an .obj or .stl file relative to the folder of the scene, or package://...')

    def _friction(self, link: ElementTree.Element) -> float:
        element = link.find('contact/lateral_friction')
        friction = 1.0 if element is None else float(self._numbers(element, 'value', 1)[0])
        if friction < 0:
            raise unusable(self._path, f'lateral_friction {friction:g} of link {link.get("name")!r}',
                           'make it 0 or more')
        return friction

    def _numbers(self, element: ElementTree.Element, name: str, count: int, default: str = '') -> Floats:
        text = element.get(name, default)
        try:
            numbers = np.array([float(word) for word in text.split()])
        except ValueError:
            numbers = np.zeros(0)
        if len(numbers) != count or not np.isfinite(numbers).all():
            raise unusable(self._path, f'{name}={text!r} in <{element.tag}>',
                           f'write {count} number{"s" if count > 1 else ""}')
        return numbers


def _after(first: tuple[Floats, Rotation], second: tuple[Floats, Rotation]) -> tuple[Floats, Rotation]:
    """Return the frame `second`, given relative to the frame `first`, in the frame of `first`'s parent."""
    return first[0] + first[1].apply(second[0]), first[1] * second[1]
