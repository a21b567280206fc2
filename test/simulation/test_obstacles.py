# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Scenes: what stands where, and what is refused."""

import numpy as np
import pytest

from dlo_calibration.errors import InputError
from dlo_calibration.simulation.obstacles import read_scene

BOX = '<collision><origin xyz="1 0 0"/><geometry><box size="0.1 0.2 0.3"/></geometry></collision>'
B = '<link name="b"/>'
JOINT = ('<joint name="{0}{1}" type="fixed"><parent link="{0}"/><child link="{1}"/>'
         '<origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/></joint>')


@pytest.fixture
def scene(tmp_path):
    """Give a function that reads what is in a robot element."""
    def read(inside):
        file = tmp_path / 'peg.urdf'
        file.write_text(f'<?xml version="1.0"?>\n<robot name="peg">{inside}</robot>', encoding='utf-8')
        return read_scene(str(file))
    return read


def test_shapes_stand_where_links_and_origins_put_them(scene):
    links = f'<link name="c">{BOX}</link><link name="b"/><link name="a">{BOX}</link>'
    first, last = scene(links + JOINT.format('a', 'b') + JOINT.format('b', 'c'))
    # Two quarter turns about z, each 1 m up: what was at x = 1 is at x = -1.
    assert first.position == pytest.approx((-1, 0, 2))
    assert np.abs(first.turn) == pytest.approx((0, 0, 1, 0))
    assert last.position.tolist() == [1, 0, 0]
    assert (first.shape, first.sizes.tolist()) == ('box', [0.1, 0.2, 0.3])


def test_friction_is_one_unless_the_link_says_another(scene):
    other = '<contact><lateral_friction value="0.25"/></contact>'
    found = scene(f'<link name="a">{BOX}</link><link name="b">{other}{BOX}{BOX}</link>')
    assert [obstacle.friction for obstacle in found] == [1.0, 0.25, 0.25]


def test_meshes_are_found_beside_the_scene_and_in_packages(scene, tmp_path, monkeypatch):
    mesh = '<link name="a"><collision><geometry><mesh filename="{}"/></geometry></collision></link>'
    (tmp_path / 'share/cell').mkdir(parents=True)
    for place in (tmp_path, tmp_path / 'share/cell'):
        (place / 'm.stl').touch()
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/nowhere:{tmp_path}')
    assert scene(mesh.format('m.stl'))[0].file == str(tmp_path / 'm.stl')
    assert scene(mesh.format('package://cell/m.stl'))[0].file == str(tmp_path / 'share/cell/m.stl')
    assert scene(mesh.format('m.stl'))[0].sizes.tolist() == [1, 1, 1]
    for name in ('other.stl', 'package://other/m.stl', ''):
        with pytest.raises(InputError, match='the mesh .*, which is not there'):
            scene(mesh.format(name))


SHAPE = '<link name="a"><collision><geometry>{}</geometry></collision></link>'


@pytest.mark.parametrize(('inside', 'came'), [
    ('', 'no collision shape'),
    ('<link name="a"/>', 'no collision shape'),
    ('<link name="a">', 'no XML document'),
    (SHAPE.format('<box size="1 2"/>'), "size='1 2' in <box>"),
    (SHAPE.format('<box size="1 2 ${x}"/>'), 'in <box>'),
    (SHAPE.format('<sphere radius="nan"/>'), "radius='nan' in <sphere>"),
    (SHAPE.format('<sphere radius="0"/>'), 'of a sphere'),
    (SHAPE.format('<sphere/>'), "radius='' in <sphere>"),
    (SHAPE.format('<heightmap/>'), 'the shape <heightmap>'),
    ('<link name="a"><contact><lateral_friction value="-1"/></contact></link>', 'lateral_friction -1'),
    (f'<link name="a">{BOX}</link>' + JOINT.format('a', 'b'), "the joint 'ab'"),
    (f'<link name="a">{BOX}</link>{B}' + JOINT.format('a', 'b') + JOINT.format('b', 'a'), 'loop'),
    (f'<link name="a">{BOX}</link>{B}' + 2 * JOINT.format('a', 'b'), "the joint 'ab'"),
])
def test_what_cannot_be_used_is_refused_with_its_place(scene, inside, came):
    with pytest.raises(InputError) as refusal:
        scene(inside)
    assert 'peg.urdf: got ' in str(refusal.value)
    assert came in refusal.value.came
    assert 'expected a URDF file with collision shapes' in str(refusal.value)


def test_a_file_that_is_no_urdf_or_not_there_is_refused(tmp_path):
    (tmp_path / 'other.xml').write_text('<dlo/>', encoding='utf-8')
    (tmp_path / 'bytes').write_bytes(bytes(range(256)))
    for name, came in (('nowhere.urdf', 'No such file'), ('.', 'directory'), ('other.xml', '<dlo>'),
                       ('bytes', 'no XML'), ('a\0b', 'null')):
        with pytest.raises(InputError) as refusal:
            read_scene(str(tmp_path / name))
        assert came in refusal.value.came
