# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""SDF: where the links stand, how stiff the joints are, and where they are free of stress."""

from dataclasses import replace

from exported_scene import write_scene
from lxml import etree
from made_up_dlo import arc, MadeUpDlo, straight
import numpy as np
import pytest

from dlo_calibration import Chain, Options
from dlo_calibration.export import export_sdf, ExportedRope, sdf_meshes
from dlo_calibration.model.parameters import PAPER_PARAMETERS, ParameterSpace, rest_shape
from dlo_calibration.model.pose import Pose
from dlo_calibration.simulation.scene import read_mesh

OPTIONS = Options(nodes=13)


def with_values(**fixed):
    """Return a DLO with other values of fixed parameters, on the 0..100 scale."""
    return MadeUpDlo(space=ParameterSpace(PAPER_PARAMETERS, fixed, mass=0.03))


def model_of(dlo, chain, options=OPTIONS):
    """Return the model in the file."""
    return etree.fromstring(export_sdf(dlo, chain, options=options).encode()).find('model')


def numbers(element, path):
    """Return the numbers in an element."""
    return np.array([float(word) for word in element.findtext(path).split()])


def poses(model):
    """Return the poses of the links."""
    return [Pose(values[:3], values[3:]) for values in (
        numbers(link, 'pose') for link in model.findall('link'))]


def turned(axis, angle):
    """Return the (3, 3) rotation about an axis, (3,)."""
    half = axis * np.sin(angle / 2)
    return Pose(np.zeros(3), np.array([*half, np.cos(angle / 2)])).rotation


def at_rest(model):
    """Return the nodes, (n, 3), where all springs are free of stress."""
    start, joints = poses(model), model.findall('joint')[::-1]
    rotation, points = start[0].rotation, [np.zeros(3)]
    for pose, following, joint in zip(start[:-1], start[1:], joints, strict=True):
        points.append(points[-1] + rotation @ [np.linalg.norm(following.position - pose.position), 0, 0])
        first, second = (turned(numbers(axis, 'xyz'), numbers(axis, 'dynamics/spring_reference')[0])
                         for axis in (joint.find('axis'), joint.find('axis2')))
        rotation = rotation @ pose.rotation.T @ following.rotation @ first @ second
    return np.array([*points, points[-1] + rotation @ [np.linalg.norm(points[1]), 0, 0]])


def test_the_links_stand_as_the_chain():
    model, chain = model_of(MadeUpDlo(), arc()), arc()
    assert [link.get('name') for link in model.findall('link')] == [f'dlo_{k}' for k in range(12)]
    starts = np.array([pose.position for pose in poses(model)])
    assert starts == pytest.approx(chain.resample(np.linspace(0, chain.length, 13))[:-1], abs=5e-4)
    for pose, following in zip(poses(model)[:-1], poses(model)[1:], strict=True):
        assert pose.points(np.array([numbers(model, 'link/collision/geometry/box/size')[0], 0, 0])
                          ) == pytest.approx(following.position)


@pytest.mark.parametrize('axis', ['axis', 'axis2'])
def test_the_springs_have_the_calibrated_stiffness_and_damping(axis):
    rope = ExportedRope.of(with_values(stiffness_2=70.0, internal_damping=50.0), arc(), OPTIONS)
    joints = model_of(with_values(stiffness_2=70.0, internal_damping=50.0), arc()).findall('joint')[::-1]
    stiffness = [numbers(joint, f'{axis}/dynamics/spring_stiffness')[0] for joint in joints]
    assert stiffness * rope.cells == pytest.approx(rope.bending_stiffness)
    assert [numbers(joint, f'{axis}/dynamics/damping')[0] for joint in joints] == pytest.approx(
        rope.internal_damping * np.array(stiffness))


@pytest.mark.parametrize('angle', [1.0, -4.0])
def test_a_bent_start_is_under_stress_until_it_is_straight(angle):
    points = at_rest(model_of(MadeUpDlo(), arc(angle)))
    assert points - points[0] == pytest.approx(np.outer(np.linspace(0, 1, 13), points[-1]), abs=1e-9)


def test_a_curved_rest_shape_is_where_the_springs_are_free_of_stress():
    dlo = with_values(natural_curvature=30.0)
    points = at_rest(model_of(dlo, arc(2.0)))
    expected = rest_shape(ExportedRope.of(dlo, arc(2.0), OPTIONS).natural_curvature, 0.6)
    between = [np.linalg.norm(shape[:, None] - shape, axis=-1) for shape in (points, expected)]
    assert between[0] == pytest.approx(between[1], abs=1e-4)


def test_both_axes_are_across_the_dlo_where_it_is_at_rest():
    for joint in model_of(MadeUpDlo(), Chain(np.random.default_rng(2).normal(size=(9, 3)))).findall('joint'):
        first, second = numbers(joint, 'axis/xyz'), numbers(joint, 'axis2/xyz')
        turn = turned(first, numbers(joint, 'axis/dynamics/spring_reference')[0])
        along = turn @ [1, 0, 0]  # of the second link at rest
        assert [first @ second, first @ along, (turn @ second) @ along] == pytest.approx([0, 0, 0], abs=1e-9)


def test_the_links_weigh_what_the_dlo_and_its_markers_weigh():
    chain = Chain(straight().points, features=np.isin(np.arange(21), [0, 10, 20]))
    model = model_of(with_values(marker_mass=60.0), chain)
    marker = 1e-6 * 10**3.0
    masses = [numbers(link, 'inertial/mass')[0] for link in model.findall('link')]
    assert sum(masses) == pytest.approx(0.03 + 3 * marker)
    assert masses[0] == pytest.approx(0.03 / 12 + marker)
    centre = sum(mass * (pose.position[0] + numbers(link, 'inertial/pose')[0]) for mass, pose, link in zip(
        masses, poses(model), model.findall('link'), strict=True))
    assert centre == pytest.approx(0.3 * sum(masses))


def test_frames_are_at_the_points_of_the_chain():
    model, chain = model_of(MadeUpDlo(), arc()), arc()
    links = dict(zip([link.get('name') for link in model.findall('link')], poses(model), strict=True))
    for point, frame in zip(chain.points, model.findall('frame'), strict=True):
        link = links[frame.get('attached_to')]
        assert link.points(numbers(frame, 'pose')[:3]) == pytest.approx(point, abs=2e-3)


@pytest.mark.parametrize(('nodes', 'touches'), [(13, 'true'), (121, 'false')])
def test_links_that_overlap_their_neighbours_do_not_collide(nodes, touches):
    model = model_of(MadeUpDlo(), straight(), Options(nodes=nodes))
    assert model.findtext('self_collide') == touches
    assert ('self_collide is false' in etree.tostring(model, encoding='unicode')) == (touches == 'false')


def test_a_verdict_of_a_stranger_cannot_end_the_comment():
    class Hostile(MadeUpDlo):
        @property
        def parameters(self):
            return {name: replace(estimate, verdict='--><link name="x"/>\0')
                    for name, estimate in super().parameters.items()}

    model = model_of(Hostile(), straight())
    assert model.find("link[@name='x']") is None
    assert 'stiffness EI: ' in model.find('.').getchildren()[0].text


def test_drake_reads_it(tmp_path):
    parsing = pytest.importorskip('pydrake.multibody.parsing', reason='needs Drake')
    from pydrake.multibody.plant import MultibodyPlant

    options = Options(nodes=13, scene=write_scene(tmp_path))
    (tmp_path / 'model.sdf').write_text(export_sdf(MadeUpDlo(), arc(), options=options))
    for name, content in sdf_meshes(options).items():
        (tmp_path / name).write_bytes(content)
    plant = MultibodyPlant(1e-3)
    parsing.Parser(plant).AddModels(str(tmp_path / 'model.sdf'))
    plant.Finalize()
    assert plant.num_positions() == 7 + 2 * 11  # the obstacles do not move
    context = plant.CreateDefaultContext()
    for number, obstacle in enumerate(ExportedRope.of(MadeUpDlo(), arc(), options).obstacles):
        pose = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(f'obstacle_{number}'))
        assert pose.translation() == pytest.approx(obstacle.position)


def test_the_obstacles_of_the_scene_are_a_static_model(tmp_path):
    options = Options(nodes=13, scene=write_scene(tmp_path))
    model = model_of(MadeUpDlo(), straight(), options)
    rope = ExportedRope.of(MadeUpDlo(), straight(), options)
    obstacles = model.find('model')
    assert obstacles.get('name') == 'obstacles' and obstacles.findtext('static') == 'true'
    links = obstacles.findall('link')
    for link, obstacle in zip(links, rope.obstacles, strict=True):
        assert numbers(link, 'pose') == pytest.approx([*obstacle.position, *obstacle.turn])
        assert link.find('pose').get('rotation_format') == 'quat_xyzw'
        assert link.find('collision/geometry')[0].tag == obstacle.shape
        assert numbers(link, 'collision/surface/friction/ode/mu') == pytest.approx(
            [rope.friction * obstacle.friction])
    assert numbers(links[0], 'collision/geometry/box/size') == pytest.approx([0.2, 0.4, 0.1])
    assert numbers(links[1], 'collision/geometry/sphere/radius') == pytest.approx([0.05])
    assert [numbers(links[2], f'collision/geometry/cylinder/{name}')[0] for name in ('length', 'radius')] == [
        0.2, 0.01]
    assert numbers(links[3], 'visual/geometry/capsule/length') == pytest.approx([0.1])


def test_the_meshes_of_the_scene_are_files_beside_the_model(tmp_path):
    options = Options(nodes=13, scene=write_scene(tmp_path))
    (name, content), = sdf_meshes(options).items()
    assert {uri.text for uri in model_of(MadeUpDlo(), straight(), options).iter('uri')} == {name}
    (tmp_path / name).write_bytes(content)
    triangles = read_mesh(str(tmp_path / name))
    assert triangles.min(axis=(0, 1)) == pytest.approx([-0.1, 0, 0])  # mirrored
    assert triangles.max(axis=(0, 1)) == pytest.approx([0, 0.1, 0.2])
    volume = np.linalg.det(triangles).sum() / 6  # positive: the faces are seen from outside
    assert volume == pytest.approx(0.1 * 0.1 * 0.2 / 6)
    assert sdf_meshes(OPTIONS) == {}


def test_without_a_scene_there_is_no_other_model():
    assert model_of(MadeUpDlo(), straight()).find('model') is None
