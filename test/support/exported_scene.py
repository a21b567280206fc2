# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A scene with every kind of obstacle, as a URDF file."""

#: Corners of a tetrahedron [m], and its faces seen from outside.
CORNERS = ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1))
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))


def write_scene(folder):
    """
    Write a scene into a folder; return its path.

    A box that is turned by 30 degrees, with a friction of 0.5; a sphere, a cylinder, and a capsule that lies
    along y; and a mesh, mirrored in x and twice as high.
    """
    (folder / 'wedge.obj').write_text('\n'.join(
        [*('v {} {} {}'.format(*corner) for corner in CORNERS),
         *('f {} {} {}'.format(*(index + 1 for index in face)) for face in FACES)]))
    shapes = (('0.3 0 0.05', '0 0 0.5235987755982988', '<box size="0.2 0.4 0.1"/>', 0.5),
              ('0 0.3 0.05', '0 0 0', '<sphere radius="0.05"/>', None),
              ('0 0.5 0.1', '0 0 0', '<cylinder length="0.2" radius="0.01"/>', None),
              ('0.5 0.5 0.02', '-1.5707963267948966 0 0', '<capsule length="0.1" radius="0.02"/>', None),
              ('-0.2 0 0', '0 0 0', '<mesh filename="wedge.obj" scale="-1 1 2"/>', None))
    links = ''.join(
        f'<link name="link_{k}"><collision><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{geometry}</geometry>'
        '</collision>' + (f'<contact><lateral_friction value="{friction}"/></contact>' if friction else '')
        + '</link>' for k, (xyz, rpy, geometry, friction) in enumerate(shapes))
    path = folder / 'scene.urdf'
    path.write_text(f'<robot name="scene">{links}</robot>')
    return str(path)
