# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
SDF: a calibrated DLO for Gazebo, as a chain of links that universal joints connect.

Each of the two axes of a joint has the stiffness EI / l and its damping.  The links stand as the observed
chain, where all angles are 0; `spring_reference` is the angle at which the joint is free of stress.  The
first axis is that of the rotation from the start to the rest shape, so that the second one needs no
reference, and both are across the DLO where it is at rest.

Links collide as boxes: DART has no friction against rolling, so that a round DLO which lies bent would roll
until it is straight.  (And in Gazebo Fortress, a lying capsule sinks into a box by its radius.)
"""

from __future__ import annotations

from hashlib import sha256
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dlo_calibration.calibration.engines import obstacles_of
from dlo_calibration.calibration.options import Options
from dlo_calibration.export.bodies import COLOUR, corners_and_faces
from dlo_calibration.export.rope import ExportedRope
from dlo_calibration.files.xml import add, add_comment, document, new_root
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import measured
from dlo_calibration.planning.dlo import CalibratedDlo
from dlo_calibration.simulation.scene import Obstacle, SIZES

NAME = 'dlo'  # begins the names of links, joints and frames
VERSION = '1.9'  # Gazebo Fortress and later


def export_sdf(dlo: CalibratedDlo, chain: Chain, *, options: Options | None = None) -> str:
    """
    Return a calibrated DLO at an observed chain as the text of an SDF model.

    Meshes of a scene are files beside it, see `sdf_meshes`.

    :param dlo: a `CalibrationResult`, or the `Description` that `read_result` returns.
    :param options: see `ExportedRope.of`.
    :raises InputError: if the scene cannot be read.
    """
    rope = ExportedRope.of(dlo, chain, options)
    root = new_root('sdf', version=VERSION)
    model = add(root, 'model', name=NAME)
    add_comment(model, _about(rope))
    _add(model, 'self_collide', 'true' if rope.slender else 'false')
    for segment, start in enumerate(_starts(rope)):
        _add_link(model, rope, segment, start)
    # From the last joint to the first: Gazebo places the second link relative to the first one, whose
    # rotation is then still exact; else rounding errors double from link to link.
    rest = rope.rest_frames
    for joint in range(len(rest) - 1, 0, -1):
        _add_joint(model, rope, joint, rest)
    for point, place in enumerate(rope.point_places.tolist()):
        segment, along = rope.place_of(place)
        frame = add(model, 'frame', name=f'{NAME}_point_{point}', attached_to=f'{NAME}_{segment}')
        _add(frame, 'pose', [along, 0, 0, 0, 0, 0])
    if rope.obstacles:
        _add_obstacles(model, rope)
    return document(root).decode()


def sdf_meshes(options: Options) -> dict[str, bytes]:
    """
    Return the files that an SDF model with these options needs beside it: name -> content.

    They hold the meshes of the scene.  A name follows from the content.

    :raises InputError: if the scene cannot be read.
    """
    return dict(_mesh_file(obstacle) for obstacle in obstacles_of(options)
                if obstacle.shape == 'mesh')


def _mesh_file(obstacle: Obstacle) -> tuple[str, bytes]:
    """Return the name and the content of the file of a mesh, which is scaled."""
    corners, faces = corners_and_faces(obstacle)
    lines = [*('v ' + ' '.join(f'{value:.9g}' for value in corner) for corner in corners.tolist()),
             *('f ' + ' '.join(map(str, face)) for face in (faces + 1).tolist()), '']
    content = '\n'.join(lines).encode()
    return f'mesh_{sha256(content).hexdigest()[:12]}.obj', content  # Drake reads .obj, but no .stl


def _add_obstacles(model: Any, rope: ExportedRope) -> None:
    """
    Add a static model with a link for each obstacle.

    A model of their own, as links of the DLO's model do not touch each other where `self_collide` is false.
    """
    obstacles = add(model, 'model', name='obstacles')
    _add(obstacles, 'static', 'true')
    for number, obstacle in enumerate(rope.obstacles):
        link = add(obstacles, 'link', name=f'obstacle_{number}')
        _add(link, 'pose', [*obstacle.position, *obstacle.turn]).set('rotation_format', 'quat_xyzw')
        collision = add(link, 'collision', name='collision')
        _add_shape(collision, obstacle)
        _add_friction(collision, rope.friction * obstacle.friction)
        visual = add(link, 'visual', name='visual')
        _add_shape(visual, obstacle)
        _add(add(visual, 'material'), 'diffuse', [*COLOUR, 1])


def _add_shape(parent: Any, obstacle: Obstacle) -> None:
    shape = add(add(parent, 'geometry'), obstacle.shape)
    if obstacle.shape == 'mesh':
        _add(shape, 'uri', _mesh_file(obstacle)[0])
        return
    for name, value in zip(SIZES[obstacle.shape], [obstacle.sizes] if obstacle.shape == 'box'
                           else obstacle.sizes.tolist(), strict=True):
        _add(shape, name, value)


def _add_friction(collision: Any, coefficient: float) -> None:
    friction = add(add(collision, 'surface'), 'friction')
    for engine, names in (('ode', ('mu', 'mu2')), ('bullet', ('friction', 'friction2'))):
        surface = add(friction, engine)
        for name in names:
            _add(surface, name, coefficient)


def _add_link(model: Any, rope: ExportedRope, segment: int, start: Floats) -> None:
    """Add a link whose frame lies at the start of the segment, (3,) [m], x along it."""
    link, length = add(model, 'link', name=f'{NAME}_{segment}'), float(rope.rest_lengths[segment])
    turn = rope.turns[segment].as_quat(canonical=True)
    pose = _add(link, 'pose', [*start, *turn])
    pose.set('rotation_format', 'quat_xyzw')
    _add_inertia(link, rope, segment)
    collision = add(link, 'collision', name='collision')
    _add(collision, 'pose', [length / 2, 0, 0, 0, 0, 0])
    _add(add(add(collision, 'geometry'), 'box'), 'size', [length, 2 * rope.radius, 2 * rope.radius])
    _add_friction(collision, rope.friction)
    visual = add(link, 'visual', name='visual')
    _add(visual, 'pose', [length / 2, 0, 0, 0, np.pi / 2, 0])
    capsule = add(add(visual, 'geometry'), 'capsule')
    _add(capsule, 'radius', rope.radius)
    _add(capsule, 'length', length)
    _add(add(visual, 'material'), 'diffuse', [0.9, 0.6, 0.2, 1])


def _add_inertia(link: Any, rope: ExportedRope, segment: int) -> None:
    """Add the inertia of a cylinder, with the markers at its ends; the two segments beside one share it."""
    length, mass = float(rope.rest_lengths[segment]), float(rope.masses[segment])
    shares = np.array([0.5, 0.5]) + 0.5 * (np.array([segment, segment + 2 - len(rope.points)]) == 0)
    ends = shares * rope.marker_masses[segment:segment + 2]
    whole = mass + float(ends.sum())
    centre = (mass / 2 + float(ends[1])) * length / whole
    across = mass * (length**2 / 12 + rope.radius**2 / 4 + (length / 2 - centre)**2) + float(
        ends[0] * centre**2 + ends[1] * (length - centre)**2)
    inertial = add(link, 'inertial')
    _add(inertial, 'pose', [centre, 0, 0, 0, 0, 0])
    _add(inertial, 'mass', whole)
    inertia = add(inertial, 'inertia')
    for name, value in (('ixx', mass * rope.radius**2 / 2), ('iyy', across), ('izz', across),
                        ('ixy', 0), ('ixz', 0), ('iyz', 0)):
        _add(inertia, name, value)


def _add_joint(model: Any, rope: ExportedRope, joint: int, rest: Floats) -> None:
    """Add the joint at the first node of a segment; `rest` are the frames in the rest shape."""
    element = add(model, 'joint', name=f'{NAME}_bend_{joint}', type='universal')
    _add(element, 'parent', f'{NAME}_{joint - 1}')
    _add(element, 'child', f'{NAME}_{joint}')
    stiffness = rope.bending_stiffness[joint - 1] / rope.cells[joint - 1]
    both = slice(joint - 1, joint + 1)
    axes, reference = _axes(rope.frames[both], rest[both])
    for tag, axis, angle in (('axis', axes[0], reference), ('axis2', axes[1], 0.0)):
        axis_element = add(element, tag)
        _add(axis_element, 'xyz', axis)
        dynamics = add(axis_element, 'dynamics')
        _add(dynamics, 'spring_reference', angle)
        _add(dynamics, 'spring_stiffness', stiffness)
        _add(dynamics, 'damping', stiffness * rope.internal_damping)


def _axes(start: Floats, rest: Floats) -> tuple[Floats, float]:
    """
    Return both axes of a joint, (2, 3) in the frame of its second link, and the reference of the first [rad].

    :param start: (2, 3, 3) frames of both links at the start.
    :param rest: (2, 3, 3) in the rest shape.
    """
    # The frame of the second link at rest, seen from where it is at the start.
    turn = Rotation.from_matrix(start[1].T @ start[0] @ rest[0].T @ rest[1]).as_rotvec()
    angle = float(np.linalg.norm(turn))
    if angle < 1e-9:
        return np.eye(3)[1:], 0.0
    first = turn / angle
    second = np.cross([1.0, 0.0, 0.0], first)
    return np.array([first, second / np.linalg.norm(second)]), angle


def _starts(rope: ExportedRope) -> Floats:
    """Return where the segments begin, (n - 1, 3) [m]: the nodes, as far as the lengths at rest allow."""
    steps = rope.frames[:, :, 0] * rope.rest_lengths[:, None]
    starts = np.concatenate([[np.zeros(3)], np.cumsum(steps, axis=0)])
    return np.asarray((starts - starts.mean(axis=0) + rope.points.mean(axis=0))[:-1])


def _about(rope: ExportedRope) -> list[str]:
    """Return the lines of the comment at the top of the file."""
    lines = [
        'A calibrated DLO, by dlo_calibration, for Gazebo with the physics engine DART. SI units.',
        *rope.values, *rope.warnings,
        'Kept: EI / l and its damping as springs of the joints, mass, friction, radius, and the rest shape '
        'as spring_reference. The frames dlo_point_i are the points of the chain.',
        f'Not kept: EA = {measured(rope.stretching_stiffness, "N")}, the links are rigid; twist, which '
        f'universal joints do not allow; drag, {measured(rope.drag, "1/s")}; the round cross-section: links '
        'collide as boxes, as the physics engine DART has no friction against rolling.']
    if rope.bending_friction > 0:
        lines.append('Not kept: friction between the strands, bending_friction.')
    if any(obstacle.friction > 1 for obstacle in rope.obstacles):
        lines.append('Not kept: obstacles with a friction above 1, as DART takes the smaller coefficient of '
                     'two bodies, here that of the DLO.')
    if rope.locking > 0:
        lines.append('Not kept: locking.')
    if not rope.slender:
        lines.append('The segments are shorter than the DLO is thick: self_collide is false, as links that '
                     'are near each other along the DLO would push each other away. Fewer nodes allow it.')
    return lines


def _add(parent: Any, tag: str, value: Any) -> Any:
    """Add an element with text: a word, or numbers."""
    element = add(parent, tag)
    element.text = value if isinstance(value, str) else ' '.join(
        repr(number) for number in np.atleast_1d(np.asarray(value, dtype=float)).tolist())
    return element
