# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The session of the tracker, behind a graph without ROS: images in, chains and actions out."""

import functools
import time

import cv2
from filmed_trials import clicks, film_camera, filmed_trials, Move, RADIUS
from films import depth_image, Instant, plain_look, Renderer
from laid_board import LaidBoard
import numpy as np
from photographs import Camera
import pytest
from toy_graph import ToyNode, TYPES

from dlo_calibration import InputError
from dlo_calibration.messages.codec import NANOSECONDS
from dlo_calibration.ros.tracker_session import INPUT_TYPES, OUTPUT_TYPES, TrackerOptions, TrackerSession

SIZE = (640, 480)
CAMERA = Camera(SIZE, 700.0, tilt=0.35, distance=0.8, target=(0.09, 0.03))
BLUE = (0.10, 0.24, 0.55)
ALONG = np.linspace(0.0, 1.0, 101)
START = 1_700_000_000 * NANOSECONDS


def curve(way=0.0):
    """Return a DLO that has moved some way towards y [m]."""
    return np.column_stack([0.4 * ALONG, 0.03 * np.sin(6 * ALONG) + way, np.full(101, RADIUS)])


BOARD = LaidBoard((-0.25, -0.12))


@functools.cache
def renderer():
    """Return the renderer of the table, which takes a second to make."""
    return Renderer(plain_look(sheets=(BOARD.sheet,), colour=BLUE), RADIUS, (-0.4, -0.35), (0.6, 0.5))


def pixels(way=0.0):
    """Return an image of the DLO and the board."""
    return renderer().image([Instant(CAMERA, curve(way))])


def points(count=4):
    """Return the parameter `points` of a person who clicks on the DLO."""
    places = CAMERA.project(curve()[np.linspace(0, 100, count).astype(int)])
    return ' '.join(f'{u:.0f},{v:.0f}' for u, v in places)


def raw(image, stamp):
    """Return the message of an image."""
    return TYPES.build('sensor_msgs/msg/Image', header=TYPES.header(stamp, 'camera'), height=image.shape[0],
                       width=image.shape[1], encoding='rgb8', is_bigendian=0, step=3 * image.shape[1],
                       data=TYPES.octets(image.tobytes()))


def compressed(image, stamp):
    """Return the message of an image as JPEG."""
    octets = cv2.imencode('.jpg', image[..., ::-1])[1].tobytes()
    return TYPES.build('sensor_msgs/msg/CompressedImage', header=TYPES.header(stamp, 'camera'), format='jpeg',
                       data=TYPES.octets(octets))


def depth(camera, line, stamp, millimetres=True):
    """Return the message of the depth that is seen of the DLO and the table."""
    metres = depth_image(camera, line, RADIUS)
    values = np.rint(1e3 * metres).astype('<u2') if millimetres else metres.astype('<f4')
    return TYPES.build('sensor_msgs/msg/Image', header=TYPES.header(stamp, 'camera'), height=values.shape[0],
                       width=values.shape[1], encoding='16UC1' if millimetres else '32FC1', is_bigendian=0,
                       step=values.itemsize * values.shape[1], data=TYPES.octets(values.tobytes()))


def camera_info():
    """Return the message of the calibration of the camera."""
    width, height = CAMERA.size
    region = TYPES.build('sensor_msgs/msg/RegionOfInterest', x_offset=0, y_offset=0, height=0, width=0,
                         do_rectify=False)
    return TYPES.build('sensor_msgs/msg/CameraInfo', header=TYPES.header(START, 'camera'), width=width,
                       height=height, distortion_model='plumb_bob', d=np.zeros(5), k=CAMERA.matrix.ravel(),
                       r=np.eye(3).ravel(), p=np.zeros(12), binning_x=0, binning_y=0, roi=region)


class TrackerGraph(ToyNode):
    """The graph of a tracker's session."""

    def __init__(self, **options):
        super().__init__('tracker', INPUT_TYPES, OUTPUT_TYPES)
        self.set = options
        self.session = TrackerSession(self, TYPES, self.clock)

    def options(self):
        return TrackerOptions.of(self.set)

    def show(self, kind, message):
        """Send an image, and wait until it is tracked or refused."""
        before = int(self.status['tracked']), self.status['last_refusal'], self.status['state']
        self.send([(kind, message)])
        self.until(lambda: (int(self.status['tracked']), self.status['last_refusal'],
                            self.status['state']) != before)


@pytest.fixture
def graph():
    made = []

    def make(**options):
        made.append(TrackerGraph(**options))
        return made[-1]
    yield make
    for each in made:
        each.session.close()


def xyz(cloud):
    table = np.frombuffer(cloud.data, np.dtype([('x', '<f8'), ('y', '<f8'), ('z', '<f8')]))
    return np.stack([table['x'], table['y'], table['z']], axis=1)


def test_chains_have_the_stamps_of_the_images_and_lie_on_the_dlo(graph):
    node = graph(points=points())
    assert node.status['state'] == 'waiting'
    node.session.status_period = 0.0
    for k, way in enumerate((0.0, 0.004, 0.008)):
        kind, message = ('image', raw) if k % 2 == 0 else ('image/compressed', compressed)
        node.show(kind, message(pixels(way), START + k * NANOSECONDS // 15))
    clouds = node.heard['chain']
    assert [cloud.header.stamp.nanosec for cloud in clouds] == [0, 66666666, 133333333]
    assert {cloud.header.frame_id for cloud in clouds} == {'table'}
    truth = BOARD.seen_from(curve(0.008))[::5]
    found = xyz(clouds[-1])
    assert found.shape == (21, 3)
    assert np.nanmean(np.linalg.norm(found - truth, axis=1)) < 0.003
    assert node.status['state'] == 'tracking'
    assert node.heard['overlay/compressed']
    picture = cv2.imdecode(np.asarray(node.heard['overlay/compressed'][-1].data, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] == 640


def test_without_points_nothing_is_tracked_and_start_says_what_is_missing(graph):
    node = graph()
    assert 'points' in node.status['detail']
    done, answer = node.session.request('start')
    assert not done
    assert 'points' in answer


@pytest.mark.long
def test_stop_rests_and_start_finds_the_dlo_anew(graph):
    node = graph(points=points())
    node.session.status_period = 0.0
    node.show('image', raw(pixels(), START))
    assert node.session.request('stop')[0]
    assert node.status['state'] == 'stopped'
    assert not node.session.request('stop')[0]
    node.send([('image', raw(pixels(), START + NANOSECONDS))])
    assert node.session.request('start')[0]
    node.show('image', raw(pixels(), START + 2 * NANOSECONDS))
    assert node.status['state'] == 'tracking'


def test_an_image_without_the_board_is_refused_with_the_remedy(graph):
    node = graph(points=points())
    node.session.status_period = 0.0
    node.show('image', raw(np.full((480, 640, 3), 128, np.uint8), START))
    assert 'board' in node.status['last_refusal']
    node.show('image', raw(pixels(), START + NANOSECONDS))
    assert node.status['state'] == 'tracking'


def test_damaged_images_and_other_encodings_are_refused(graph):
    node = graph(points=points())
    node.session.status_period = 0.0
    message = raw(pixels(), START)
    message.encoding = 'rgb16'
    node.show('image', message)
    assert 'encoding' in node.status['last_refusal']
    node.session.hear('image', b'\1\2\3')
    node.until(lambda: 'do not decode' in node.status['last_refusal'])


def test_images_that_come_faster_than_they_are_tracked_are_dropped(graph):
    node = graph(points=points())
    node.session.status_period = 0.0
    message = raw(pixels(), START)
    for _ in range(20):
        node.send([('image', message)])
    node.until(lambda: int(node.status['tracked']) > 0)
    assert int(node.status['images']) == 20
    assert int(node.status['dropped']) > 5


@pytest.mark.parametrize('text', ['1,2 3', 'a,b', '1,2,3 4,5,6', '1,nan 2,3'])
def test_points_of_another_form_are_refused(text):
    with pytest.raises(InputError, match='points'):
        TrackerOptions.of({'points': text})


@pytest.mark.parametrize('millimetres', [True, False])
@pytest.mark.parametrize('late', [True, False])
def test_with_depth_points_in_the_air_have_their_heights(graph, millimetres, late):
    def lifted(height):
        line = curve()
        line[:, 2] += height * np.exp(-((ALONG - 0.5) / 0.3)**2)
        return line

    node = graph(points=points())
    node.session.status_period = 0.0
    node.send([('camera_info', camera_info())])
    for k, height in enumerate((0.0, 0.005, 0.01, 0.015, 0.02)):
        stamp = START + k * NANOSECONDS // 15
        picture = raw(renderer().image([Instant(CAMERA, lifted(height))]), stamp)
        of_picture = depth(CAMERA, lifted(height), stamp, millimetres)
        pair = [('image', picture), ('depth', of_picture)]
        # That of another instant belongs to another image.
        node.send([('depth', depth(CAMERA, lifted(0.1), stamp - NANOSECONDS // 30, millimetres))])
        before = node.status['tracked']
        for kind, message in pair if late else pair[::-1]:
            node.send([(kind, message)])
        node.until(lambda before=before: node.status['tracked'] != before)
    truth = BOARD.seen_from(lifted(0.02))[::5]
    found = xyz(node.heard['chain'][-1])
    assert np.isfinite(found[:, 0]).sum() >= 18
    off = np.abs(found - truth)
    assert np.nanmax(off[:, 2]) < 0.003 and np.nanmean(np.linalg.norm(off, axis=1)) < 0.003


@pytest.mark.parametrize('known, encoding, said', [(True, '8UC1', '16UC1'), (False, '16UC1', 'camera_info')])
def test_depths_that_cannot_be_used_are_refused_and_the_image_counts(graph, known, encoding, said):
    node = graph(points=points())
    node.session.status_period = 0.0
    if known:
        node.send([('camera_info', camera_info())])
    message = depth(CAMERA, curve(), START)
    message.encoding = encoding
    node.send([('depth', message)])
    node.show('image', raw(pixels(), START))
    node.until(lambda: node.status['tracked'] == '1')
    assert said in node.status['last_refusal']


@pytest.mark.long
def test_a_hand_with_a_tag_gives_an_action_and_where_the_dlo_was_before(graph):
    camera = film_camera((1280, 720))  # with fewer pixels, the board's markers are too small
    film = filmed_trials((Move(12, (0.06, 0.18)),), rate=15.0)
    node = graph(points=' '.join(f'{u:.0f},{v:.0f}' for u, v in clicks(film, camera)))
    node.session.status_period = 0.0
    for k, image in enumerate(film.images(camera, colour=BLUE)):
        node.show('image', raw(image, START + round(film.times[k] * NANOSECONDS)))
    deadline = time.monotonic() + 10
    while not node.heard['action'] and time.monotonic() < deadline:
        node.session.tick()
    action, = node.heard['action']
    initial, = node.heard['initial_chain']
    (closes, opens, _), = film.holds
    start = action.header.stamp.sec - 1_700_000_000 + action.header.stamp.nanosec / 1e9
    assert abs(start - closes) < 0.15
    assert abs(start + action.points[-1].time_from_start.sec
               + action.points[-1].time_from_start.nanosec / 1e9 - opens) < 0.15
    assert list(action.joint_names) == ['hand_1']
    assert initial.header.stamp.sec + initial.header.stamp.nanosec / 1e9 < (
        action.header.stamp.sec + action.header.stamp.nanosec / 1e9)
