# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""ExportedRope: where its nodes lie, how stiff its joints are, and what it says that was not found."""

from made_up_dlo import arc, LENGTH, LEVEL, MadeUpDlo, straight
import numpy as np
import pytest

from dlo_calibration import Chain, Options, read_result
from dlo_calibration.export import ExportedRope
from dlo_calibration.files.session import samples
from dlo_calibration.model.parameters import PAPER_PARAMETERS, ParameterSpace


def with_values(**fixed):
    """Return a DLO with other values of fixed parameters, on the 0..100 scale."""
    return MadeUpDlo(space=ParameterSpace(PAPER_PARAMETERS, fixed, mass=0.03))


def test_its_segments_have_the_length_and_the_mass_of_the_dlo():
    rope = ExportedRope.of(MadeUpDlo(), arc(), Options(nodes=13))
    assert rope.points.shape == (13, 3)
    assert rope.length == pytest.approx(LENGTH, rel=1e-3)
    assert rope.masses.sum() == pytest.approx(0.03)
    assert rope.bending_stiffness == pytest.approx(np.full(11, 10**(1 - 6.5 * 0.765)))
    assert rope.twisting_stiffness is None


def test_a_longer_rest_length_makes_it_longer():
    longer = ExportedRope.of(with_values(length_scale=75.0), straight())
    assert longer.length == pytest.approx(LENGTH / 0.9**0.5)
    assert longer.place_of(longer.point_places[-1]) == pytest.approx((39, longer.rest_lengths[-1]))


def test_parts_have_stiffnesses_of_their_own():
    rope = ExportedRope.of(with_values(stiffness_2=75.0), straight(), Options(nodes=12))
    relative = rope.bending_stiffness / rope.bending_stiffness[0]
    stiffer = 50**0.5
    assert relative[:4] == pytest.approx(np.ones(4))
    assert relative[-4:] == pytest.approx(np.full(4, stiffer))
    assert (1 < relative[4:-4]).any() and (relative[4:-4] < stiffer).any()


def test_a_stiffness_that_varies_smoothly_does_so_in_it():
    knots = {f'stiffness_knot_{knot}': 75.0 for knot in range(2, 6)}
    rope = ExportedRope.of(with_values(**knots), straight(), Options(nodes=42))
    relative, stiffer = rope.bending_stiffness / rope.bending_stiffness[-1], 50**-0.5
    assert relative[10:] == pytest.approx(np.ones(30))
    assert relative[:10] == pytest.approx(np.interp(np.arange(1, 11) / 41, [0, 0.25], [stiffer, 1]), rel=0.03)


def test_it_rests_on_the_table_where_it_was_seen():
    seen = straight().points + np.random.default_rng(1).normal(0, 1e-3, (21, 3))
    rope = ExportedRope.of(MadeUpDlo(), Chain(seen))
    assert np.ptp(rope.points[:, 2]) < 1e-9
    assert rope.points[0, 2] - rope.table == pytest.approx(rope.radius)
    assert ExportedRope.of(MadeUpDlo(), straight(), Options(table=False)).table is None


def test_it_says_that_it_lies_higher_than_its_radius():
    raised = Chain(straight().points + (0, 0, 0.02))
    assert any('above the table' in warning for warning in ExportedRope.of(MadeUpDlo(), raised).warnings)
    hanging = Chain(straight().points + (0, 0, 0.2))
    assert ExportedRope.of(MadeUpDlo(), hanging).table == 0.0


@pytest.mark.parametrize('angle', [2.0, -2.0])
def test_a_curved_rest_shape_is_turned_to_where_the_dlo_is_bent(angle):
    rope = ExportedRope.of(with_values(natural_curvature=30.0), arc(angle))
    inner = (rope.frames[:-1] + rope.frames[1:]) / 2
    natural = np.einsum('jik,jk->ji', inner[:, :, 1:], rope.natural_curvature)
    change = np.diff(rope.frames[:, :, 0], axis=0)
    assert ((natural * change).sum(axis=1) > 0.99 * np.linalg.norm(natural, axis=1)
            * np.linalg.norm(change, axis=1)).all()
    assert np.linalg.norm(natural, axis=1) == pytest.approx(np.full(39, 3.0), rel=1e-3)


def test_its_frames_are_not_twisted():
    frames = ExportedRope.of(MadeUpDlo(), Chain(np.random.default_rng(2).normal(size=(9, 3)))).frames
    turns = np.einsum('nji,njk->nik', frames[:-1], frames[1:])
    assert np.linalg.det(frames) == pytest.approx(np.ones(len(frames)))
    assert turns[:, 2, 1] == pytest.approx(turns[:, 1, 2])  # no rotation about the first axis


def test_it_names_what_the_trials_do_not_determine_with_its_interval():
    rope = ExportedRope.of(read_result(samples() / 'xml/dlo.xml'), straight())
    assert [warning.split()[0] for warning in rope.warnings if 'not identifiable' in warning] == [
        'elasticity', 'self_collision']
    assert any('at least 5.46 N' in warning for warning in rope.warnings)


def test_an_unknown_mass_gives_a_warning():
    unknown = MadeUpDlo(space=ParameterSpace(PAPER_PARAMETERS))
    assert any('30 g are assumed' in warning for warning in ExportedRope.of(unknown, straight()).warnings)


def test_a_chain_of_another_length_gives_a_warning():
    warnings = ExportedRope.of(MadeUpDlo(), straight(length=0.9)).warnings
    assert any('same DLO, in metres' in warning for warning in warnings)


def test_the_level_is_that_of_the_table():
    assert ExportedRope.of(MadeUpDlo(), straight()).table == pytest.approx(LEVEL - 2e-3 * 15**0.25)
