# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""USD: the stiffnesses of both forms, the shape at the start and at rest, and what the file says."""

from dataclasses import replace
import re
import warnings

from exported_scene import write_scene
from made_up_dlo import arc, LENGTH, MadeUpDlo, straight
import numpy as np
import pytest

from dlo_calibration import Chain, InputError, Options
from dlo_calibration.export import export_usd, ExportedRope
from dlo_calibration.model.parameters import PAPER_PARAMETERS, ParameterSpace, rest_shape

OPTIONS = Options(nodes=13)


def with_values(**fixed):
    """Return a DLO with other values of fixed parameters, on the 0..100 scale."""
    return MadeUpDlo(space=ParameterSpace(PAPER_PARAMETERS, fixed, mass=0.03))


def text_of(dlo, chain, form='newton-1.6', options=OPTIONS):
    """Return the text of a file."""
    return export_usd(dlo, chain, form=form, options=options)


def value(text, name):
    """Return the number of an attribute."""
    return float(re.search(rf'^ *float {name} = (.*)$', text, re.MULTILINE)[1])


def vectors(text, name):
    """Return the vectors of an attribute, (n, 3)."""
    row = re.search(rf'^ *\w+\[\] {name} = \[(.*)\]$', text, re.MULTILINE)[1]
    return np.array([float(word) for word in re.findall(r'[^(), ]+', row)]).reshape(-1, 3)


def test_the_curve_lies_as_the_chain():
    text, chain = text_of(MadeUpDlo(), arc()), arc()
    assert vectors(text, 'points') == pytest.approx(
        chain.resample(np.linspace(0, chain.length, 13)), abs=5e-4)


def test_the_stiffnesses_are_the_calibrated_ones():
    text = text_of(with_values(torsion=50.0, internal_damping=50.0), arc())
    rope = ExportedRope.of(with_values(torsion=50.0, internal_damping=50.0), arc(), OPTIONS)
    assert value(text, 'physics:curvesStretchStiffness') == pytest.approx(rope.stretching_stiffness)
    assert value(text, 'physics:curvesBendStiffness') == pytest.approx(rope.bending_stiffness[0])
    assert value(text, 'physics:curvesTwistStiffness') == pytest.approx(rope.twisting_stiffness[0])
    assert value(text, 'newton:curvesBendDamping') == pytest.approx(rope.bending_stiffness[0] * 0.01)
    assert value(text, 'physics:dynamicFriction') == pytest.approx(rope.friction)


def test_the_other_form_has_moduli_of_a_round_cross_section():
    text, rope = text_of(MadeUpDlo(), arc(), 'newton-1.4'), ExportedRope.of(MadeUpDlo(), arc(), OPTIONS)
    area = np.pi * value(text, 'physics:thickness')**2 / 4
    assert value(text, 'physics:stretchStiffness') * area == pytest.approx(rope.stretching_stiffness)
    assert value(text, 'physics:bendStiffness') * area**2 / 4 / np.pi == pytest.approx(
        rope.bending_stiffness[0])
    assert 'Newton 1.4 and 1.5' in text and 'Newton 1.6' not in text


@pytest.mark.parametrize('form', ['newton-1.6', 'newton-1.4'])
def test_the_density_gives_the_mass(form):
    text, rope = text_of(MadeUpDlo(), straight(), form), ExportedRope.of(MadeUpDlo(), straight(), OPTIONS)
    assert value(text, 'physics:density') * np.pi * rope.radius**2 * LENGTH == pytest.approx(0.03)


def test_markers_are_masses_at_points():
    chain = Chain(straight().points, features=np.isin(np.arange(21), [0, 10]))
    text = text_of(with_values(marker_mass=60.0), chain)
    masses = np.array(re.search(r'physics:masses = \[(.*)\]', text)[1].split(', '), dtype=float)
    assert masses.sum() == pytest.approx(0.03 + 2e-3)
    assert masses[[0, 6]] == pytest.approx([1e-3 + 0.03 / 24, 1e-3 + 0.03 / 12])


def test_a_dlo_without_natural_curvature_is_straight_at_rest():
    text = text_of(MadeUpDlo(), arc(2.0))
    points = vectors(text, 'physics:restShapePoints')
    assert points[0] == pytest.approx(vectors(text, 'points')[0])
    whole = points[-1] - points[0]
    assert points - points[0] == pytest.approx(np.outer(np.linspace(0, 1, 13), whole), abs=1e-6)
    assert np.linalg.norm(whole) == pytest.approx(LENGTH, rel=1e-3)
    assert 'normals' not in text  # they would make the curve a ribbon


def test_the_rest_shape_bends_to_the_side_on_which_the_frames_are_curved():
    dlo = with_values(natural_curvature=30.0)
    text, rope = text_of(dlo, arc(2.0)), ExportedRope.of(dlo, arc(2.0), OPTIONS)
    points = vectors(text, 'physics:restShapePoints')
    expected = rope.points[0] + rest_shape(rope.natural_curvature, rope.length) @ rope.frames[0].T
    assert points == pytest.approx(expected, abs=1e-6)
    across, segments = vectors(text, 'physics:restNormals')[:-1], np.diff(points, axis=0)
    assert (across * segments).sum(axis=1) == pytest.approx(np.zeros(12), abs=1e-6)
    assert vectors(text, 'normals')[0] == pytest.approx(across[0])


def test_parts_of_different_stiffness_have_their_mean_and_the_file_says_so():
    text = text_of(with_values(stiffness_2=75.0), straight())
    first = MadeUpDlo().parameters['flexibility'].physical_value
    assert value(text, 'physics:curvesBendStiffness') == pytest.approx(2 * first / (1 + 50**-0.5), rel=0.1)
    assert 'EI varies along the DLO' in text and 'EI varies' not in text_of(MadeUpDlo(), straight())


def test_a_verdict_of_a_stranger_cannot_end_the_text():
    class Hostile(MadeUpDlo):
        @property
        def parameters(self):
            return {name: replace(estimate, verdict='\\"""\n)\ndef Xform "x" {}\0')
                    for name, estimate in super().parameters.items()}

    text = text_of(Hostile(), straight())
    assert '\0' not in text
    doc = re.match(r'#usda 1.0\n\(\n    doc = """((?:[^"\\]|\\.)*)"""\n    defaultPrim', text)
    assert doc and '\\\\\\"\\"\\"' in doc[1]


def test_another_form_is_refused():
    with pytest.raises(InputError, match="form: 'newton-1.5'"):
        text_of(MadeUpDlo(), straight(), 'newton-1.5')


def everything(form, options=OPTIONS):
    """Return the text of a DLO that has all there can be in a file."""
    chain = Chain(arc().points, features=np.isin(np.arange(21), [0, 10]))
    return text_of(with_values(natural_curvature=30.0, marker_mass=60.0, self_collision=100.0), chain, form,
                   options)


@pytest.mark.parametrize('form', ['newton-1.6', 'newton-1.4'])
def test_usd_core_finds_no_fault_in_it(form, tmp_path):
    usd = pytest.importorskip('pxr.Usd', reason='needs usd-core')
    validation = pytest.importorskip('pxr.UsdValidation', reason='needs usd-core 25.11 or later')
    (tmp_path / 'dlo.usda').write_text(everything(form))
    stage = usd.Stage.Open(str(tmp_path / 'dlo.usda'))
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    faults = validation.ValidationContext(validators).Validate(stage)
    assert [fault.GetMessage() for fault in faults] == []
    curve = stage.GetDefaultPrim().GetChild('curve')
    assert len(curve.GetAttribute('points').Get()) == 13
    material = stage.GetPrimAtPath(curve.GetRelationship('material:binding:physics').GetTargets()[0])
    assert 'PhysicsCurvesDeformableMaterialAPI' in str(material.GetMetadata('apiSchemas'))
    of_proposal = set()
    for prim in stage.Traverse():
        for attribute in prim.GetAuthoredAttributes():
            name, definition = attribute.GetName(), prim.GetPrimDefinition()
            declared = definition.GetAttributeDefinition(name)
            assert attribute.Get() is not None, name
            if declared:
                assert attribute.GetTypeName() == declared.GetTypeName(), name
            else:
                of_proposal.add(name.split(':')[0])
    assert of_proposal <= {'physics', 'newton'}


def test_newton_reads_mass_stiffness_damping_friction_and_rest_shape(tmp_path):
    newton = pytest.importorskip('newton', minversion='1.8', reason='needs newton 1.8 and usd-core')
    (tmp_path / 'dlo.usda').write_text(everything('newton-1.6'))
    builder = newton.ModelBuilder()
    with warnings.catch_warnings():
        warnings.simplefilter('error', newton.NewtonWarning)
        builder.add_usd(str(tmp_path / 'dlo.usda'))
    dlo = with_values(natural_curvature=30.0, marker_mass=60.0, self_collision=100.0)
    chain = Chain(arc().points, features=np.isin(np.arange(21), [0, 10]))
    rope = ExportedRope.of(dlo, chain, OPTIONS)
    assert sum(builder.body_mass) == pytest.approx(0.03 + rope.marker_masses.sum(), rel=1e-5)
    stiffness = np.reshape(builder.joint_target_ke[-6 * 11:], (11, 6))
    assert stiffness[:, 2] == pytest.approx(rope.stretching_stiffness / rope.cells, rel=1e-4)
    assert stiffness[:, 3] == pytest.approx(rope.bending_stiffness / rope.cells, rel=1e-4)
    damping = np.reshape(builder.joint_target_kd[-6 * 11:], (11, 6))
    assert damping == pytest.approx(stiffness * rope.internal_damping, rel=1e-4)
    rest = 2 * np.arccos(np.abs(np.reshape(builder.joint_rest_q[-7 * 11:], (11, 7))[:, 6]))
    assert rest == pytest.approx(np.linalg.norm(rope.natural_curvature, axis=1) * rope.cells, rel=1e-2)
    assert builder.shape_material_mu[0] == pytest.approx(rope.friction, rel=1e-5)
    assert builder.shape_scale[0][0] == pytest.approx(rope.radius, rel=1e-5)


def blocks(text):
    """Return the kind and the text of each obstacle."""
    return re.findall(r'def (\w+) "obstacle_\d" \((.*?)\n {8}\}', text, re.DOTALL)


def test_the_obstacles_of_the_scene_stand_beside_the_dlo(tmp_path):
    options = Options(nodes=13, scene=write_scene(tmp_path))
    text, rope = text_of(MadeUpDlo(), straight(), options=options), ExportedRope.of(
        MadeUpDlo(), straight(), options)
    assert 'defaultPrim = "scene"' in text and '</scene/dlo/material>' in text
    assert [kind for kind, _ in blocks(text)] == ['Cube', 'Sphere', 'Cylinder', 'Capsule', 'Mesh']
    for (_, block), obstacle in zip(blocks(text), rope.obstacles, strict=True):
        place = re.search(r'xformOp:translate = \((.*)\)', block)[1].split(', ')
        turn = re.search(r'xformOp:orient = \((.*)\)', block)[1].split(', ')
        assert np.array(place, dtype=float) == pytest.approx(obstacle.position)
        assert np.array(turn, dtype=float) == pytest.approx(np.roll(obstacle.turn, 1))
    assert 'xformOp:scale = (0.2, 0.4, 0.1)' in blocks(text)[0][1]
    assert 'double height = 0.2' in blocks(text)[2][1] and 'double radius = 0.01' in blocks(text)[2][1]
    assert vectors(blocks(text)[4][1], 'points').min(axis=0) == pytest.approx([-0.1, 0, 0])
    friction = re.search(r'"obstacle_0_material" .*?staticFriction = (\S+)', text, re.DOTALL)[1]
    assert (float(friction) * rope.friction)**0.5 == pytest.approx(0.5 * rope.friction)


@pytest.mark.parametrize('form', ['newton-1.6', 'newton-1.4'])
def test_usd_core_finds_no_fault_in_the_obstacles(form, tmp_path):
    usd = pytest.importorskip('pxr.Usd', reason='needs usd-core')
    validation = pytest.importorskip('pxr.UsdValidation', reason='needs usd-core 25.11 or later')
    geometry = pytest.importorskip('pxr.UsdGeom')
    (tmp_path / 'dlo.usda').write_text(everything(form, Options(nodes=13, scene=write_scene(tmp_path))))
    stage = usd.Stage.Open(str(tmp_path / 'dlo.usda'))
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    faults = validation.ValidationContext(validators).Validate(stage)
    assert [fault.GetMessage() for fault in faults] == []
    boxes = geometry.BBoxCache(usd.TimeCode.Default(), [geometry.Tokens.default_])
    capsule, mesh = (boxes.ComputeWorldBound(stage.GetPrimAtPath(f'/scene/obstacles/obstacle_{number}')
                                             ).ComputeAlignedRange() for number in (3, 4))
    assert np.array(capsule.GetMin()) == pytest.approx([0.48, 0.43, 0.0], abs=1e-6)
    assert np.array(capsule.GetMax()) == pytest.approx([0.52, 0.57, 0.04], abs=1e-6)
    assert np.array(mesh.GetMin()) == pytest.approx([-0.3, 0.0, 0.0], abs=1e-6)
