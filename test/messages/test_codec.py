# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Messages are read to the letter of the contract, and what is written reads back."""

from dataclasses import replace
import subprocess
import sys

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from random_examples import drawing
from wire import SOURCES, wire

from dlo_calibration.errors import InputError
from dlo_calibration.messages import codec
from dlo_calibration.messages.codec import ACTION, ActionMessage, GOAL, INITIAL, read
from dlo_calibration.model.chain import Chain

STAMP = 12_500_000_000
SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 8: 8}


def curve(count=21, length=1.0):
    s = np.linspace(0, 1, count)
    return np.stack([length * s, 0.1 * np.sin(3 * s), 0.05 * s**2], axis=1)


def cloud(types, **changes):
    message = codec.chain_cloud(types, Chain(curve()), STAMP, 'world')
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def field(types, name, datatype, offset, count=1):
    return types.build('sensor_msgs/msg/PointField', name=name, datatype=datatype, offset=offset, count=count)


def action(**changes):
    return replace(ActionMessage(
        STAMP, 'world', ('left_hand', 'right_hand'), np.array([0.0, 0.5, 2.000000001]),
        np.arange(18.0).reshape(3, 2, 3) / 7, np.tile([0.0, 0.0, 0.6, 0.8], (3, 2, 1))), **changes)


def refusal(kind, message):
    """Return the refusal's text, which always names the message."""
    with pytest.raises(InputError) as caught:
        read(kind, message)
    text = str(caught.value)
    assert text.startswith(f'{kind} stamped 12.5 s: ')
    return text


# ---- reading chains

def test_written_chain_is_read_back(types):
    chain = Chain(curve(), np.arange(21) % 3, np.arange(21) == 4)
    message = read(GOAL, codec.chain_cloud(types, chain, STAMP, 'world'))
    assert (message.kind, message.stamp, message.frame_id) == (GOAL, STAMP, 'world')
    np.testing.assert_array_equal(message.chain.points, chain.points)
    np.testing.assert_array_equal(message.chain.hands, chain.hands)
    np.testing.assert_array_equal(message.chain.features, chain.features)


def test_bare_cloud_has_no_annotation(types):
    message = cloud(types)
    assert [field.name for field in message.fields] == ['x', 'y', 'z']
    content = read(INITIAL, message)
    assert content.chain.hands is None
    assert not content.chain.features.any()


def test_hand_field_of_zeros_means_that_no_hand_holds(types):
    message = codec.chain_cloud(types, Chain(curve(), np.zeros(21)), STAMP, 'world')
    np.testing.assert_array_equal(read(GOAL, message).chain.hands, np.zeros(21))


@st.composite
def layouts(draw):
    """Draw fields in any order with gaps, the point's size, byte order, and rows or a column with padding."""
    names = ['x', 'y', 'z', *draw(st.sets(st.sampled_from(['hand', 'feature', 'rgb', 'intensity'])))]
    fields, offset = [], draw(st.integers(0, 3))
    for name in draw(st.permutations(names)):
        datatype = draw(st.sampled_from(
            [7, 8] if name in 'xyz' else [2] if name in ('hand', 'feature') else list(SIZES)))
        fields.append((name, datatype, offset))
        offset += SIZES[datatype] + draw(st.integers(0, 3))
    return fields, offset + draw(st.integers(0, 5)), draw(st.booleans()), draw(st.booleans()), \
        draw(st.integers(0, 7))


@pytest.mark.parametrize('source', SOURCES)
@drawing(25)
@given(layout=layouts(), seed=st.integers(0, 2**32 - 1), count=st.integers(3, 9))
def test_any_layout_is_read(source, layout, seed, count):
    types = SOURCES[source]()
    fields, step, big, column, padding = layout
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    hands, features = rng.integers(0, 9, count), rng.integers(0, 2, count)
    columns = {**dict(zip('xyz', points.T, strict=True)), 'hand': hands, 'feature': features}
    row_step = step + padding if column else step * count + padding
    octets = bytearray(rng.bytes((count if column else 1) * row_step))
    codes = {2: 'u1', 7: 'f4', 8: 'f8'}
    expected = {}
    for name, datatype, offset in fields:
        if name in columns:
            dtype = np.dtype('<>'[big] + codes[datatype])
            values = columns[name].astype(dtype)
            expected[name] = values.astype(float)
            for k in range(count):
                at = k * (row_step if column else step) + offset
                octets[at:at + dtype.itemsize] = values[k:k + 1].tobytes()
    message = cloud(
        types, fields=[field(types, *row) for row in fields], is_bigendian=big, point_step=step,
        row_step=row_step, data=types.octets(bytes(octets)), height=count if column else 1,
        width=1 if column else count)
    chain = read(INITIAL, message).chain
    np.testing.assert_array_equal(chain.points, np.stack([expected[name] for name in 'xyz'], axis=1))
    if 'hand' in expected:
        np.testing.assert_array_equal(chain.hands, expected['hand'])
    else:
        assert chain.hands is None
    np.testing.assert_array_equal(chain.features, expected.get('feature', np.zeros(count)) != 0)


def test_last_row_needs_no_padding(types):
    full = cloud(types)
    padded = b''.join(bytes(full.data[k:k + 24]) + b'pad' for k in range(0, len(full.data), 24))[:-3]
    message = read(INITIAL, cloud(types, height=21, width=1, row_step=27, data=types.octets(padded)))
    np.testing.assert_array_equal(message.chain.points, curve())


@pytest.mark.parametrize(('changes', 'words'), [
    ({'width': 22}, '504 bytes of data; expected 528'),
    ({'height': 3, 'width': 7}, 'height 3 and width 7'),
    ({'height': 0, 'width': 0}, 'height 0 and width 0'),
    ({'width': 0}, '0 point(s); expected at least 3'),
    ({'width': 2}, '2 point(s); expected at least 3'),
    ({'point_step': 20}, "field 'z' at offset 16 of points of 20 bytes"),
    ({'point_step': 0}, 'of points of 0 bytes'),
    ({'height': 21, 'width': 1, 'row_step': 0}, 'row_step 0'),
])
def test_impossible_shape_is_refused(types, changes, words):
    assert words in refusal(GOAL, cloud(types, **changes))


def test_too_many_points_are_refused_before_their_bytes_are_read(types):
    assert '4000000000 points; expected at most' in refusal(INITIAL, cloud(types, width=4_000_000_000))


@pytest.mark.parametrize(('fields', 'words'), [
    ([('x', 7, 0), ('y', 7, 4)], 'no field z (fields: x y); expected fields x y z'),
    ([], 'no field x y z (fields: none)'),
    ([('x', 5, 0), ('y', 7, 4), ('z', 7, 8)], "field 'x' int32 (count 1); expected float32 or float64"),
    ([('x', 99, 0), ('y', 7, 4), ('z', 7, 8)], "field 'x' of datatype 99"),
    ([('x', 7, 0, 3), ('y', 7, 4), ('z', 7, 8)], "field 'x' float32 (count 3)"),
    ([('x', 7, 0), ('y', 7, 4), ('z', 7, 8), ('hand', 7, 12)],
     "field 'hand' float32 (count 1); expected uint8"),
    ([('x', 7, 0), ('y', 7, 4), ('z', 7, 8), ('feature', 1, 12)], "field 'feature' int8"),
    ([('x', 7, 0), ('y', 7, 4), ('z', 7, 8), ('x', 7, 12)], "two fields 'x'"),
])
def test_unusable_field_is_refused(types, fields, words):
    assert words in refusal(GOAL, cloud(types, fields=[field(types, *row) for row in fields]))


def test_hand_beyond_eight_is_refused(types):
    message = codec.chain_cloud(types, Chain(curve(), np.full(21, 9)), STAMP, 'world')
    assert 'hand 9; expected 0 for none, or 1 to 8' in refusal(INITIAL, message)


@pytest.mark.parametrize(('index', 'value', 'words'), [
    (slice(5, 16), np.nan, '10 of 21 points that were seen, and NaN in point(s) 5, 6, 7, 8, 9 and 6 more'),
    (6, np.inf, 'infinity in point(s) 6'),
    (8, curve()[7], 'coincident neighbours after point(s) 7'),
    (9, 1e30, 'a coordinate of 1e+30 m in point 9'),
])
def test_unusable_points_are_refused(types, index, value, words):
    points = curve()
    points[index] = value
    assert words in refusal(GOAL, cloud(types, data=types.octets(points.tobytes())))


@pytest.mark.parametrize('kind', [INITIAL, ACTION, GOAL])
@pytest.mark.parametrize(('seconds', 'words'), [
    (0, 'stamped 0 s: a stamp of zero'), (-3, 'stamped -3 s: a negative stamp')])
def test_stamp_must_be_a_time(types, kind, seconds, words):
    message = codec.action_trajectory(types, action()) if kind == ACTION else cloud(types)
    message.header.stamp.sec, message.header.stamp.nanosec = seconds, 0
    with pytest.raises(InputError, match=f'{kind} {words}'):
        read(kind, message)


# ---- reading actions

def test_written_action_is_read_back(types):
    message = read(ACTION, codec.action_trajectory(types, action()))
    assert (message.kind, message.stamp, message.frame_id) == (ACTION, STAMP, 'world')
    assert message.names == ('left_hand', 'right_hand')
    for name in ('times', 'positions', 'orientations'):
        np.testing.assert_array_equal(getattr(message, name), getattr(action(), name))


def test_velocities_of_an_action_are_ignored(types):
    message = codec.action_trajectory(types, action())
    zero = types.build('geometry_msgs/msg/Vector3', x=0.0, y=0.0, z=0.0)
    message.points[0].velocities = [types.build('geometry_msgs/msg/Twist', linear=zero, angular=zero)]
    np.testing.assert_array_equal(read(ACTION, message).positions, action().positions)


def rename(message, names):
    message.joint_names = names


def set_point(message, k, **changes):
    for name, value in changes.items():
        setattr(message.points[k], name, value)


def set_time(message, k, seconds):
    message.points[k].time_from_start.sec = seconds


def set_transform(message, part, **changes):
    for name, value in changes.items():
        setattr(getattr(message.points[1].transforms[1], part), name, value)


@pytest.mark.parametrize(('spoil', 'words'), [
    (lambda m: rename(m, []), '2 transforms in trajectory point 0; expected one for each of the 0'),
    (lambda m: rename(m, ['a', 'a']), "joint_names ['a', 'a']; expected a different name for each hand"),
    (lambda m: rename(m, ['a', '']), "joint_names ['a', '']"),
    (lambda m: set_point(m, 1, transforms=m.points[1].transforms[:1]), '1 transforms in trajectory point 1'),
    (lambda m: setattr(m, 'points', []), 'no trajectory points; expected at least one'),
    (lambda m: set_time(m, 1, 2), 'time_from_start 2 s of trajectory point 2 after 2.5 s'),
    (lambda m: set_time(m, 0, -1), 'time_from_start from -1 to 2 s'),
    (lambda m: set_time(m, 2, 1_700_000_000), 'time_from_start from 0 to 1.7e+09 s'),
    (lambda m: set_transform(m, 'rotation', x=0.0, y=0.0, z=0.0, w=0.0),
     'a quaternion of length 0 for right_hand in trajectory point 1'),
    (lambda m: set_transform(m, 'rotation', x=0.0, y=0.0, z=0.0, w=0.1), 'a quaternion of length 0.1'),
    (lambda m: set_transform(m, 'rotation', w=np.nan), 'NaN or infinity in rotation of trajectory point 1'),
    (lambda m: set_transform(m, 'translation', y=-1e300), 'a coordinate of -1e+300 m in trajectory point 1'),
    (lambda m: set_transform(m, 'translation', z=np.inf),
     'NaN or infinity in translation of trajectory point 1'),
])
def test_unusable_action_is_refused(types, spoil, words):
    message = codec.action_trajectory(types, action())
    spoil(message)
    assert words in refusal(ACTION, message)


def test_action_of_nine_hands_is_refused(types):
    nine = codec.action_trajectory(types, action(
        names=tuple('abcdefgh'), times=[0.0], positions=np.zeros((1, 8, 3)),
        orientations=np.tile([0.0, 0.0, 0.0, 1.0], (1, 8, 1))))
    assert len(read(ACTION, nine).names) == 8
    nine.joint_names = list('abcdefghi')
    nine.points[0].transforms = [*nine.points[0].transforms, nine.points[0].transforms[0]]
    assert '9 joint_names; expected 1 to 8' in refusal(ACTION, nine)


def test_written_messages_cross_the_wire(types):
    """All that is written can be serialised and comes back as it was."""
    travel = wire(types)
    chain = Chain(curve(), np.arange(21) % 2, np.arange(21) == 4)
    message = read(INITIAL, travel(codec.chain_cloud(types, chain, STAMP, 'world')))
    np.testing.assert_array_equal(message.chain.points, chain.points)
    np.testing.assert_array_equal(message.chain.hands, chain.hands)
    np.testing.assert_array_equal(
        read(ACTION, travel(codec.action_trajectory(types, action()))).positions, action().positions)


def test_module_loads_no_message_package():
    code = ('import sys, dlo_calibration.messages.codec\n'
            'print(sorted({"rclpy", "rosbags", "sensor_msgs"} & set(sys.modules)))')
    printed = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True).stdout
    assert printed == '[]\n'
