# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
USD: a calibrated DLO for Newton and Isaac Lab, as a curve with the schemas of deformable bodies.

The schemas are those of the proposal Deformable Body Physics in USD (AOUSD, OpenUSD-proposals, pull request
111).  Its revisions differ in what the stiffness of a curve is: at first a modulus, which the thickness
turns into the stiffness of a round cross-section, later the stiffness itself.  So there are two forms, named
after the first version of Newton that reads them.
"""

from __future__ import annotations

import re

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError, one_of
from dlo_calibration.export.bodies import COLOUR, corners_and_faces
from dlo_calibration.export.rope import ExportedRope
from dlo_calibration.files.xml import text_of
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import measured
from dlo_calibration.planning.dlo import CalibratedDlo
from dlo_calibration.simulation.scene import Obstacle

NAME = 'dlo'
SCENE = 'scene'  # holds the DLO and the obstacles, if there are any
#: Of stretch and shear, relative to their stiffness [s]: with more, `SolverVBD` converges so slowly that a
#: DLO sags (benchmark/results/export_newton_cantilever.md).
MOST_DAMPING = 1e-3
FORMS = ('newton-1.6', 'newton-1.4')


def export_usd(dlo: CalibratedDlo, chain: Chain, *, form: str = FORMS[0],
               options: Options | None = None) -> str:
    """
    Return a calibrated DLO at an observed chain as the text of a USD layer.

    :param dlo: a `CalibrationResult`, or the `Description` that `read_result` returns.
    :param form: newton-1.6: stiffnesses EA, EI and GJ, for Newton 1.6 and later and Isaac Lab 3.0;
        newton-1.4: the moduli of a round cross-section that has them, for Newton 1.4 and 1.5.
    :param options: see `ExportedRope.of`.
    :raises InputError: if the form is unknown, or the scene cannot be read.
    """
    if form not in FORMS:
        raise InputError('form', repr(form), one_of(FORMS, form), 'correct it')
    rope = ExportedRope.of(dlo, chain, options)
    moduli = form == FORMS[1]
    curve = [*_shape(rope), *([] if moduli else _thickness(rope)), *_rest(rope, moduli), *_masses(rope),
             f'rel material:binding:physics = <{f"/{SCENE}" if rope.obstacles else ""}/{NAME}/material>']
    if not rope.slender:
        curve.append('bool newton:selfCollisionEnabled = 0')
    schemas = ['PhysicsMaterialAPI', 'PhysicsCurvesDeformableMaterialAPI',
               *([] if moduli else ['NewtonCurvesDeformableMaterialAPI'])]
    prims = _prim('Xform', NAME, ['PhysicsDeformableBodyAPI'], [
        *_prim('BasisCurves', 'curve', ['PhysicsCurvesDeformableSimAPI', 'PhysicsCollisionAPI',
                                        'MaterialBindingAPI'], curve),
        '', *_prim('Material', 'material', schemas, [
            *(_moduli(rope) if moduli else _stiffnesses(rope)), *_friction(rope.friction)])])
    if rope.obstacles:  # a layer that is referenced gives only one prim, so that there must be one for all
        prims = _prim('Xform', SCENE, [], [*prims, '', *_prim('Xform', 'obstacles', [], [
            line for number, obstacle in enumerate(rope.obstacles)
            for line in _obstacle(number, obstacle, rope.friction)])])
    return '\n'.join([
        '#usda 1.0', '(', f'    doc = {_quoted(_about(rope, moduli))}',
        f'    defaultPrim = "{SCENE if rope.obstacles else NAME}"', '    metersPerUnit = 1',
        '    kilogramsPerUnit = 1', '    upAxis = "Z"', ')', '', *prims, ''])


def _obstacle(number: int, obstacle: Obstacle, friction: float) -> list[str]:
    """
    Return an obstacle, which does not move, with its material.

    :param friction: of the DLO.
    """
    x, y, z, w = obstacle.turn.tolist()
    place = [f'double3 xformOp:translate = ({", ".join(map(repr, obstacle.position.tolist()))})',
             f'quatf xformOp:orient = ({", ".join(map(_number, (w, x, y, z)))})']
    operations, schemas = ['translate', 'orient'], ['PhysicsCollisionAPI', 'MaterialBindingAPI']
    sizes = obstacle.sizes.tolist()
    if obstacle.shape == 'box':
        kind, shape = 'Cube', ['double size = 1']
        place.append(f'float3 xformOp:scale = ({", ".join(map(_number, sizes))})')
        operations.append('scale')
    elif obstacle.shape == 'mesh':
        kind, (corners, faces) = 'Mesh', corners_and_faces(obstacle)
        schemas.append('PhysicsMeshCollisionAPI')
        shape = [f'point3f[] points = {_vectors(corners)}',
                 f'int[] faceVertexCounts = [{", ".join(["3"] * len(faces))}]',
                 f'int[] faceVertexIndices = [{", ".join(map(str, faces.ravel().tolist()))}]',
                 'uniform token subdivisionScheme = "none"',
                 'uniform token physics:approximation = "none"']
    elif obstacle.shape == 'sphere':
        kind, shape = 'Sphere', [f'double radius = {sizes[0]!r}']
    else:
        kind, shape = obstacle.shape.capitalize(), [
            'uniform token axis = "Z"', f'double height = {sizes[0]!r}', f'double radius = {sizes[1]!r}']
    order = ', '.join(f'"xformOp:{name}"' for name in operations)
    # The geometric mean with the friction of the DLO is the product of both.
    material = _friction(friction * obstacle.friction**2)
    name = f'obstacle_{number}'
    return [*_prim(kind, name, schemas, [
        *shape, *place, f'uniform token[] xformOpOrder = [{order}]',
        f'color3f[] primvars:displayColor = [({", ".join(map(_number, COLOUR))})]',
        f'rel material:binding:physics = </{SCENE}/obstacles/{name}_material>']),
        '', *_prim('Material', f'{name}_material', ['PhysicsMaterialAPI'], material), '']


def _friction(coefficient: float) -> list[str]:
    return [f'float physics:{name}Friction = {_number(coefficient)}' for name in ('static', 'dynamic')]


def _shape(rope: ExportedRope) -> list[str]:
    """Return the geometry of the curve, without normals, which would make it a ribbon."""
    return ['uniform token type = "linear"', f'int[] curveVertexCounts = [{len(rope.points)}]',
            f'point3f[] points = {_vectors(rope.points)}',
            f'float[] widths = [{_number(2 * rope.radius)}] (', '    interpolation = "constant"', ')',
            'color3f[] primvars:displayColor = [(0.9, 0.6, 0.2)]']


def _thickness(rope: ExportedRope) -> list[str]:
    return [f'float[] physics:thicknesses = [{_number(2 * rope.radius)}]',
            'uniform token physics:thicknesses:elementType = "constant"']


def _rest(rope: ExportedRope, moduli: bool) -> list[str]:
    """Return the rest shape: it begins where the DLO does, and leads in the same direction."""
    frames = rope.rest_frames
    steps = frames[:, :, 0] * rope.rest_lengths[:, None]
    points = rope.points[0] + np.concatenate([[np.zeros(3)], np.cumsum(steps, axis=0)])
    lines = [f'point3f[] physics:restShapePoints = {_vectors(points)}']
    if rope.natural_curvature.any() and not moduli:  # which side of the DLO bends
        for name, across in (('normals', rope.frames[:, :, 1]), ('physics:restNormals', frames[:, :, 1])):
            lines.append(f'normal3f[] {name} = {_vectors(np.concatenate([across, across[-1:]]))}')
    return lines


def _masses(rope: ExportedRope) -> list[str]:
    """Return the masses at the points if there are markers; else the density suffices."""
    if not rope.marker_masses.any():
        return []
    points = np.array(rope.marker_masses)
    points[:-1] += rope.masses / 2
    points[1:] += rope.masses / 2
    return [f'float[] physics:masses = [{", ".join(map(_number, points))}]',
            'uniform token physics:masses:elementType = "point"']


def _stiffnesses(rope: ExportedRope) -> list[str]:
    """Return the stiffnesses of the DLO, and their damping."""
    stretch, shear, bend, twist = _values(rope)
    lines = [f'float physics:density = {_number(rope.masses.sum() / _section(rope) / rope.length)}']
    for name, value in (('Stretch', stretch), ('Shear', shear), ('Bend', bend), ('Twist', twist)):
        damping = min(rope.internal_damping, MOST_DAMPING) if name in ('Stretch', 'Shear') else \
            rope.internal_damping
        lines += [f'float physics:curves{name}Stiffness = {_number(value)}',
                  f'float newton:curves{name}Damping = {_number(value * damping)}']
    return lines


def _moduli(rope: ExportedRope) -> list[str]:
    """Return the moduli that give a round cross-section the stiffnesses of the DLO."""
    stretch, shear, bend, twist = _values(rope)
    area, moment = _section(rope), np.pi * rope.radius**4 / 4
    return [f'float physics:{name} = {_number(value)}' for name, value in (
        ('density', rope.masses.sum() / area / rope.length), ('thickness', 2 * rope.radius),
        ('stretchStiffness', stretch / area), ('shearStiffness', shear / area),
        ('bendStiffness', bend / moment), ('twistStiffness', twist / (2 * moment)))]


def _section(rope: ExportedRope) -> float:
    """Return the area [m^2] of a round cross-section."""
    return float(np.pi * rope.radius**2)


def _values(rope: ExportedRope) -> tuple[float, float, float, float]:
    """
    Return EA [N], the stiffness against shear [N], EI and GJ [N m^2].

    Where EI varies, it is the mean of those that bend one after the other.  Shear does not exist in the model
    of this package: it is as stiff as stretching.  Where the trials say nothing about twist, GJ is EI.
    """
    bend = _mean(rope, rope.bending_stiffness)
    twist = bend if rope.twisting_stiffness is None else _mean(rope, rope.twisting_stiffness)
    return rope.stretching_stiffness, rope.stretching_stiffness, bend, twist


def _mean(rope: ExportedRope, stiffnesses: Floats) -> float:
    return float(rope.cells.sum() / (rope.cells / stiffnesses).sum())


def _about(rope: ExportedRope, moduli: bool) -> list[str]:
    """Return the lines of the documentation of the file."""
    stretch, _, bend, twist = _values(rope)
    version = 'Newton 1.4 and 1.5: its stiffnesses are moduli [Pa] of a round cross-section' if moduli else \
        'Newton 1.6 and later, and Isaac Lab 3.0: its stiffnesses are EA [N], EI and GJ [N m^2]'
    twisting = '' if moduli else f'GJ = {measured(twist, "N m^2")}, '
    lines = [f'A calibrated DLO, by dlo_calibration, for {version}. SI units.', *rope.values, *rope.warnings,
             f'Kept: EA = {measured(stretch, "N")}, EI = {measured(bend, "N m^2")}, {twisting}mass, '
             'friction, radius. Newton takes the geometric mean of the friction of two bodies: give the '
             'table that of the DLO, too.']
    if rope.twisting_stiffness is None and not moduli:
        lines.append('The trials say nothing about twist: GJ = EI is assumed.')
    if np.ptp(rope.bending_stiffness) > 0:
        lines.append(f'EI varies along the DLO from {measured(rope.bending_stiffness.min(), "N m^2")} to '
                     f'{measured(rope.bending_stiffness.max(), "N m^2")}, which one material cannot say: it '
                     'has the mean of pieces that bend one after the other.')
    lines.append('Newton before 1.8 does not simulate the rest shape: the DLO is free of stress as it lies '
                 'at the start. So start there with a chain that nothing bends.')
    lines.append('SolverVBD needs short steps and many iterations, and has no friction against rolling: see '
                 'doc/export.md.')
    lost = [f'drag, {measured(rope.drag, "1/s")}']
    if moduli:
        lost.append(f'internal damping, {measured(rope.internal_damping, "s")}; twist')
    elif rope.internal_damping > MOST_DAMPING:
        lost.append(f'damping of stretch and shear above {measured(MOST_DAMPING, "s")}, with which the DLO '
                    'would sag')
    if rope.bending_friction > 0:
        lost.append('friction between strands, bending_friction')
    if rope.locking > 0:
        lost.append('locking')
    lines.append(f'Not kept: {"; ".join(lost)}.')
    if not rope.slender:
        lines.append('The segments are shorter than the DLO is thick: collisions with itself are off, as '
                     'segments that are near each other along it would push each other away.')
    return lines


def _prim(kind: str, name: str, schemas: list[str], content: list[str]) -> list[str]:
    """Return the lines of a prim with applied schemas."""
    names = ', '.join(f'"{schema}"' for schema in schemas)
    applied = [f'def {kind} "{name}" (', f'    prepend apiSchemas = [{names}]', ')'] if schemas else [
        f'def {kind} "{name}"']
    return [*applied, '{',
            *(f'    {line}' if line else '' for line in content), '}']


def _quoted(lines: list[str]) -> str:
    """Return text as a USD string of several lines."""
    text = text_of('\n'.join(lines))
    text = re.sub('[\x7f-\x9f\u2028-\u202e\u2066-\u2069]', '\ufffd', text)
    return '"""' + text.replace('\\', '\\\\').replace('"', '\\"') + '"""'


def _vectors(values: Floats) -> str:
    rows = (f'({", ".join(map(_number, row))})' for row in values.tolist())
    return f'[{", ".join(rows)}]'


def _number(value: float) -> str:
    """Return a number with nine digits, more than the single precision of USD has."""
    return f'{float(value):.9g}'
