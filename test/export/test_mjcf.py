# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""export_mjcf: a file that MuJoCo reads, with the stiffness, the shapes and the remarks of the DLO."""

from exported_scene import write_scene
from lxml import etree
from made_up_dlo import arc, MadeUpDlo, straight
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dlo_calibration import export_mjcf, InputError, Options, read_result
from dlo_calibration.export import ExportedRope
from dlo_calibration.files.session import samples
from dlo_calibration.model.parameters import PAPER_PARAMETERS, ParameterSpace

NODES = Options(nodes=13)
FORMS = ('extensible', 'inextensible')


def exported(dlo=None, chain=None, options=NODES, **rest):
    """Return the root element of an exported file."""
    text = export_mjcf(dlo or MadeUpDlo(), chain or arc(), options=options, **rest)
    return etree.fromstring(text.encode())


def curved():
    """Return a DLO whose rest shape is curved, with parts of different stiffness and twist."""
    fixed = {'natural_curvature': 30.0, 'stiffness_2': 75.0, 'torsion': 50.0, 'bending_friction': 50.0}
    return MadeUpDlo(space=ParameterSpace(PAPER_PARAMETERS, fixed, mass=0.03))


@pytest.fixture
def loaded():
    """Give a function that returns MuJoCo's model and state of an exported file, at the keyframe `start`."""
    mujoco = pytest.importorskip('mujoco', reason='needs MuJoCo: the extra "bench" of setup.py has it')

    def loaded(text):
        model = mujoco.MjModel.from_xml_string(text)
        state = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, state, model.key('start').id)
        mujoco.mj_forward(model, state)
        return model, state

    return loaded


@pytest.mark.parametrize('form', FORMS)
def test_bodies_are_nested_with_joints_of_the_calibrated_stiffness(form):
    root, rope = exported(curved(), form=form), ExportedRope.of(curved(), arc(), NODES)
    bodies = list(root.iter('body'))
    assert [body.get('name') for body in bodies] == [f'dlo_{k}' for k in range(12)]
    assert [body.getparent().get('name') for body in bodies[1:]] == [f'dlo_{k}' for k in range(11)]
    assert bodies[0].find('freejoint').get('name') == 'dlo_root'
    bends = [joint for joint in root.iter('joint') if joint.get('type') == 'ball']
    assert [float(joint.get('stiffness')) for joint in bends] == pytest.approx(
        rope.bending_stiffness / rope.cells, rel=1e-6)
    slides = [joint for joint in root.iter('joint') if joint.get('type') == 'slide']
    stretches = [1 / float(joint.get('stiffness')) for joint in slides]
    if form == 'extensible':
        assert sum(stretches) == pytest.approx(rope.length / rope.stretching_stiffness, rel=1e-6)
    else:
        assert stretches == []


def test_each_point_of_the_chain_is_a_site():
    assert [site.get('name') for site in exported().iter('site') if site.get('name')] == [
        f'dlo_point_{k}' for k in range(21)]


def test_it_stands_on_its_table_or_on_none():
    assert exported().find('worldbody/geom[@name="table"]').get('type') == 'plane'
    assert exported(options=Options(nodes=13, table=False)).find('worldbody/geom[@name="table"]') is None


def test_neighbours_do_not_touch():
    pairs = {(element.get('body1'), element.get('body2')) for element in exported().iter('exclude')}
    assert pairs >= {(f'dlo_{k}', f'dlo_{k + 1}') for k in range(11)}
    assert ('dlo_0', 'dlo_11') not in pairs


def test_its_comment_says_what_is_not_identifiable_and_what_is_lost():
    text = export_mjcf(read_result(samples() / 'xml/dlo.xml'), straight())
    assert 'elasticity is not identifiable: the trials allow 90 %: at least 5.46 N' in text
    assert 'without resistance to twist' in text
    lost = export_mjcf(curved(), straight())
    assert 'GJ ' in lost and 'friction between strands' in lost


def test_a_form_that_does_not_exist_and_too_many_nodes_are_refused():
    with pytest.raises(InputError, match="form: 'extendible'.*extensible"):
        export_mjcf(MadeUpDlo(), straight(), form='extendible')
    with pytest.raises(InputError, match='401.*at most 400'):
        export_mjcf(MadeUpDlo(), straight(), options=Options(nodes=401))


@pytest.mark.parametrize('form', FORMS)
def test_mujoco_shows_the_chain_at_the_start(form, loaded):
    chain = arc(2.0)
    model, state = loaded(export_mjcf(curved(), chain, form=form, options=Options(nodes=61)))
    points = np.array([state.site(f'dlo_point_{k}').xpos for k in range(21)])
    assert np.abs(points - chain.points).max() < 5e-4
    assert model.body_mass.sum() == pytest.approx(0.03)


def test_mujoco_holds_the_rest_shape_without_a_force(loaded):
    fixed = {'natural_curvature': 20.0}
    dlo = MadeUpDlo(space=ParameterSpace(PAPER_PARAMETERS, fixed, mass=0.03))
    _, bent = loaded(export_mjcf(dlo, arc(2.0 * 0.6), options=Options(nodes=41)))
    _, other = loaded(export_mjcf(dlo, straight(), options=Options(nodes=41)))
    assert np.abs(bent.qfrc_spring).max() < 0.01 * np.abs(other.qfrc_spring).max()


def test_mujoco_has_the_obstacles_of_the_scene_where_they_stand(loaded, tmp_path):
    options = Options(nodes=13, scene=write_scene(tmp_path))
    model, state = loaded(export_mjcf(MadeUpDlo(), straight(), options=options))
    rope = ExportedRope.of(MadeUpDlo(), straight(), options)
    sizes = {0: [0.1, 0.2, 0.05], 1: [0.05, 0, 0], 2: [0.01, 0.1, 0], 3: [0.02, 0.05, 0]}
    for number, obstacle in enumerate(rope.obstacles):
        geom = model.geom(f'obstacle_{number}').id
        assert model.geom_bodyid[geom] == 0  # it does not move
        assert model.geom_friction[geom][0] == pytest.approx(rope.friction * obstacle.friction)
        assert model.geom_priority[geom] > model.geom('dlo_0').priority[0]
        if obstacle.shape != 'mesh':
            assert model.geom_size[geom] == pytest.approx(sizes[number])
            assert state.geom_xpos[geom] == pytest.approx(obstacle.position)
            assert state.geom_xmat[geom] == pytest.approx(
                Rotation.from_quat(obstacle.turn).as_matrix().ravel(), abs=1e-9)
    geom = model.geom('obstacle_4').id
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    corners = model.mesh_vert[first:first + model.mesh_vertnum[mesh]]
    corners = corners @ state.geom_xmat[geom].reshape(3, 3).T + state.geom_xpos[geom]
    expected = [(-0.3, 0, 0), (-0.2, 0, 0), (-0.2, 0, 0.2), (-0.2, 0.1, 0)]
    assert np.array(sorted(np.round(corners, 6).tolist())) == pytest.approx(np.array(expected), abs=1e-5)


def test_a_dlo_that_mujoco_drops_on_a_box_rests_on_it(loaded, tmp_path):
    mujoco = pytest.importorskip('mujoco')
    scene = tmp_path / 'box.urdf'
    scene.write_text('<robot name="box"><link name="box"><collision><origin xyz="0.3 0 0.05"/><geometry>'
                     '<box size="0.8 0.8 0.1"/></geometry></collision></link></robot>')
    options = Options(nodes=13, scene=str(scene))
    model, state = loaded(export_mjcf(MadeUpDlo(), arc(height=0.12), options=options))
    while state.time < 1.0:
        mujoco.mj_step(model, state)
    radius = ExportedRope.of(MadeUpDlo(), straight(), options).radius
    heights = np.array([state.site(f'dlo_point_{k}').xpos[2] for k in range(21)])
    assert heights == pytest.approx(np.full(21, 0.1 + radius), abs=5e-4)


def test_obstacles_whose_dents_are_lost_are_named(tmp_path):
    assert 'convex hull' in export_mjcf(MadeUpDlo(), straight(), options=Options(scene=write_scene(tmp_path)))
    assert 'convex hull' not in export_mjcf(MadeUpDlo(), straight())
