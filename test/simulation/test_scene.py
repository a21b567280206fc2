# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Scenes: what stands where, and what is refused."""

import os

import numpy as np
import pytest

from dlo_calibration.errors import InputError
from dlo_calibration.simulation.scene import read_scene

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
    obstacles = scene(f'<link name="a">{BOX}</link><link name="b">{other}{BOX}{BOX}</link>')
    assert [obstacle.friction for obstacle in obstacles] == [1.0, 0.25, 0.25]


MESH = '<link name="a"><collision><geometry><mesh filename="{}"/></geometry></collision></link>'
OBJ = b'v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0.1\n'
SQUARE = [[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0.1]]]


def test_meshes_are_found_beside_the_scene_and_in_packages(scene, tmp_path, monkeypatch):
    (tmp_path / 'share/cell').mkdir(parents=True)
    (tmp_path / 'm.obj').write_bytes(OBJ + b'f 1 2 3')
    (tmp_path / 'share/cell/m.obj').write_bytes(OBJ + b'f 1 2 3\nf 1 3 4')
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/nowhere:{tmp_path}')
    for name, count in (('m.obj', 1), (f'file://{tmp_path}/m.obj', 1), ('package://cell/m.obj', 2)):
        obstacle, = scene(MESH.format(name))
        assert len(obstacle.triangles) == count
        assert obstacle.sizes.tolist() == [1, 1, 1]
    (tmp_path / 'loop.stl').symlink_to('loop.stl')
    for name in ('other.stl', 'loop.stl', 'package://other/m.stl', 'package://cell/../m.obj',
                 'package:///m.obj', ''):
        with pytest.raises(InputError, match='the mesh .*, which is not there'):
            scene(MESH.format(name))


def test_a_mesh_outside_the_folder_of_the_scene_is_refused(scene, tmp_path, tmp_path_factory):
    secret = tmp_path_factory.mktemp('elsewhere') / 'secret.obj'
    secret.write_bytes(OBJ + b'f 1 2 3')
    (tmp_path / 'link.obj').symlink_to(secret)
    for name in (secret, f'file://{secret}', f'../{secret.parent.name}/secret.obj', 'link.obj'):
        with pytest.raises(InputError, match='outside the folder of the scene.*; move it there, or name it'):
            scene(MESH.format(name))


def binary_stl(triangles):
    """Return an .stl file with triangles."""
    facets = np.zeros(len(triangles), [('normal', '<f4', 3), ('corners', '<f4', (3, 3)), ('colour', '<u2')])
    facets['corners'] = triangles
    return bytes(80) + len(triangles).to_bytes(4, 'little') + facets.tobytes()


FACET = b'facet normal 0 0 1\n outer loop\n vertex 0 0 0\n vertex 1 0 0\n%s endloop\nendfacet\n'
ASCII = b'solid s\n' + FACET % b'vertex 1 1 0\n' + b'%s'


@pytest.mark.parametrize(('name', 'octets'), [
    ('m.obj', b'# a square\nmtllib ../../secret.mtl\n' + OBJ + b'vn 0 0 1\ng a\nf 1/1/1 2//1 3/5 4\n'),
    ('m.OBJ', OBJ + b'f -4 -3 -2 -1'),
    ('m.stl', binary_stl(SQUARE)),
    ('m.stl', ASCII % FACET.replace(b'1 0 0', b'1 1 0') % b'vertex 0 1 1e-1\n' + b'endsolid s\n'),
])
def test_the_triangles_of_a_mesh_are_read(scene, tmp_path, name, octets):
    (tmp_path / name).write_bytes(octets)
    assert scene(MESH.format(name))[0].triangles == pytest.approx(np.array(SQUARE))


@pytest.mark.parametrize(('name', 'octets', 'came'), [
    ('m.obj', OBJ, 'no triangle'),
    ('m.obj', OBJ + b'f 1 2 99', 'a face with vertex 99 of 4'),
    ('m.obj', OBJ + b'f 1 2 -5', 'line 5: a face with vertex -5 after 4 vertices'),
    ('m.obj', OBJ + b'f 0 1 2', 'line 5: a face with vertex 0'),
    ('m.obj', OBJ + b'f 1 2 99999999999999999999999', 'line 5: a face with vertex 9999'),
    ('m.obj', OBJ + b'f 1 2 x', 'line 5: invalid literal'),
    ('m.obj', OBJ + b'v 1 2\n', 'line 5: not enough values'),
    ('m.obj', OBJ + b'v 1 2 nan\nf 1 2 5', 'a coordinate that is no number up to 1e+06'),
    ('m.obj', OBJ + b'v 1 2 1e300\nf 1 2 5', 'a coordinate that is no number up to 1e+06'),
    ('m.obj', b'f ' + b'1 ' * 10000, 'line 1: more than 10000 bytes'),
    ('m.stl', binary_stl(SQUARE)[:-1], '183 bytes with the number 2 of triangles'),
    ('m.stl', bytes(80) + b'\xff' * 4, '84 bytes with the number 4294967295'),
    ('m.stl', b'', '0 bytes'),
    ('m.stl', ASCII % b'', 'an end that is missing'),
    ('m.stl', ASCII % FACET % b'', 'facets that do not have three corners'),
    ('m.stl', ASCII % b'vertex 1 2\n', 'line 9: not enough values'),
    ('m.dae', b'<COLLADA/>', 'a file .dae, which is not read'),
    ('m', b'', 'a file without a suffix, which is not read'),
])
def test_a_mesh_that_is_not_valid_is_refused(scene, tmp_path, name, octets, came):
    (tmp_path / name).write_bytes(octets)
    with pytest.raises(InputError, match='export the mesh again, as a simpler .obj or .stl') as refusal:
        scene(MESH.format(name))
    assert came in refusal.value.came
    assert f"the mesh '{name}': " in refusal.value.came


def test_meshes_that_are_too_large_together_are_refused(scene, tmp_path, monkeypatch):
    (tmp_path / 'm.stl').write_bytes(binary_stl(SQUARE))
    (tmp_path / 'n.stl').write_bytes(binary_stl(SQUARE))
    monkeypatch.setattr('dlo_calibration.simulation.scene.MOST_TRIANGLES', 5)
    with pytest.raises(InputError, match='meshes of more than 5 triangles.*simplify the meshes'):
        scene(''.join(MESH.format('m.stl').replace('"a"', f'"{k}"') for k in range(3)))
    monkeypatch.setattr('dlo_calibration.simulation.scene.LARGEST_FILE', 250)
    with pytest.raises(InputError, match="the mesh 'n.stl': more than 250 bytes with the meshes before"):
        scene(MESH.format('m.stl') + MESH.format('n.stl').replace('"a"', '"b"'))


@pytest.mark.parametrize('name', ['m.stl', 'm.obj', 'peg.urdf'])
def test_a_pipe_is_no_file(tmp_path, name):
    """Reading a pipe that nobody writes to would never end."""
    (tmp_path / 'peg.urdf').write_text(f'<robot>{MESH.format(name)}</robot>', encoding='utf-8')
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match='a directory, a pipe or a device, not a file'):
        read_scene(str(tmp_path / 'peg.urdf'))


def test_a_document_type_is_refused(tmp_path):
    """Its entities would fill the memory."""
    entities = '<!ENTITY a0 "a">' + ''.join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))
    for encoding in ('utf-8', 'utf-16'):
        text = f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE r [{entities}]><robot>&a9;</robot>'
        (tmp_path / 'bomb.urdf').write_text(text, encoding=encoding)
        with pytest.raises(InputError, match='no XML document'):
            read_scene(str(tmp_path / 'bomb.urdf'))


@pytest.mark.parametrize(('limit', 'inside'), [
    ('MOST_BYTES', f'<link name="a">{BOX}</link>'),
    ('MOST_ELEMENTS', f'<link name="a">{BOX}</link>'),
    ('MOST_LINKS', f'<link name="a">{BOX}</link><link name="b"/><link name="c"/><link name="d"/>'),
    ('MOST_SHAPES', f'<link name="a">{BOX}{BOX}{BOX}{BOX}</link>'),
])
def test_a_scene_that_is_too_large_is_refused(scene, monkeypatch, limit, inside):
    assert scene(inside)
    monkeypatch.setattr(f'dlo_calibration.simulation.scene.{limit}', 3)
    with pytest.raises(InputError, match='more than 3|4 links|4 collision shapes'):
        scene(inside)


def test_a_long_chain_of_links_is_read_at_once(scene):
    links = [f'<link name="{k}"/>' for k in range(2000)]
    links[-1] = f'<link name="1999">{BOX}</link>'
    joints = [f'<joint name="j"><parent link="{k}"/><child link="{k + 1}"/><origin xyz="0 0 0.5"/></joint>'
              for k in range(1999)]
    assert scene(''.join(links + joints))[0].position == pytest.approx((1, 0, 0.5 * 1999))


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
    (SHAPE.format('<sphere radius="1e9"/>'), "radius='1e9' in <sphere>"),
    (SHAPE.format('<sphere radius="1e-9"/>'), 'of a sphere'),
    (SHAPE.format('<mesh filename="m.stl" scale="1 0 1"/>'), 'of a mesh'),
    (SHAPE.format(f'<box size="{"1 " * 10000}"/>'), "size='1 1 1 1"),
    (SHAPE.format('<heightmap/>'), 'the shape <heightmap>'),
    ('<link name="a"><contact><lateral_friction value="-1"/></contact></link>', 'lateral_friction -1'),
    (f'<link name="a">{BOX}</link>' + JOINT.format('a', 'b'), "the joint 'ab'"),
    (f'<link name="a">{BOX}</link>{B}' + JOINT.format('a', 'b') + JOINT.format('b', 'a'), 'loop'),
    (f'<link name="a">{BOX}</link>{B}' + 2 * JOINT.format('a', 'b'), "the joint 'ab'"),
])
def test_an_unusable_element_is_refused_with_its_place(scene, inside, came):
    with pytest.raises(InputError) as refusal:
        scene(inside)
    assert 'peg.urdf: ' in str(refusal.value)
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
