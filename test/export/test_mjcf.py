# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""export_mjcf: a file that MuJoCo reads, with the stiffness, the shapes and the remarks of the DLO."""

from lxml import etree
from made_up_dlo import arc, MadeUpDlo, straight
import numpy as np
import pytest

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
