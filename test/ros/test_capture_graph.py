# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The capture page on a ROS graph: photographs from image topics, and trials for a running calibrator."""

from contextlib import contextmanager
import json
import threading
from types import SimpleNamespace

from capture_page import drawn, GOAL, served, START, whole_trial
import cv2
import numpy as np
import pytest

from dlo_calibration.errors import InputError
from dlo_calibration.vision.lens import read_lens
from dlo_calibration.vision.photograph import decoded, ENCODINGS

pytest.importorskip('rclpy', reason='needs ROS 2, sourced or from PyPI')

COLOUR = (200, 40, 90)  # red, green, blue


@contextmanager
def publishing(environment, messages):
    """Publish messages of topics, given with their types, again and again."""
    from ros_robot import robot_of, TYPES

    with robot_of(environment) as robot:
        publishers = [(robot.node.create_publisher(TYPES.find(kind), topic, 1), TYPES.find(kind)(**fields))
                      for topic, kind, fields in messages]
        ending = threading.Event()

        def publish():
            while not ending.wait(0.05):
                for publisher, message in publishers:
                    publisher.publish(message)

        thread = threading.Thread(target=publish)
        thread.start()
        try:
            yield
        finally:
            ending.set()
            thread.join()


def raw(octets, encoding='rgb8', **fields):
    """Return the fields of an Image with these pixels."""
    pixels = cv2.cvtColor(cv2.imdecode(np.frombuffer(octets, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    height, width, _ = pixels.shape
    return {'height': height, 'width': width, 'encoding': encoding, 'step': 3 * width,
            'data': pixels.tobytes(), **fields}


CAMERA_INFO = {'width': 400, 'height': 300, 'distortion_model': 'plumb_bob', 'd': [0.1, 0.0, 0.0, 0.0, 0.0],
               'k': [440.0, 0.0, 200.0, 0.0, 450.0, 150.0, 0.0, 0.0, 1.0]}


@pytest.mark.long
def test_photographs_come_from_topics_with_the_lens_of_their_camera(ros_environment, tmp_path):
    image, compressed = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
    with publishing(ros_environment, [
            ('/camera/image_raw', image, raw(drawn(START))),
            ('/camera/camera_info', 'sensor_msgs/msg/CameraInfo', CAMERA_INFO),
            ('/plain/compressed', compressed, {'format': 'jpeg', 'data': drawn(GOAL, '.jpg')}),
            ('/odd', image, raw(drawn(START), 'rgb16'))]), served(tmp_path) as page:
        assert page.state()['ros']
        page.done('GET', 'api/topics')
        page.until(lambda _: len(page.done('GET', 'api/topics')['topics']) == 3, 'the topics')
        assert {'name': '/camera/image_raw', 'type': image} in page.done('GET', 'api/topics')['topics']
        first = page.done('POST', 'api/topics', {'name': '/camera/image_raw'})
        assert first['state']['lens'] == 'camera_info of /camera/image_raw'
        lens = read_lens(tmp_path / 'lens.yaml')
        assert lens.matrix[1, 1] == 450.0
        second = page.done('POST', 'api/topics', {'name': '/plain/compressed'})
        shown = page.get(f'api/photographs/{first["id"]}/picture')
        assert cv2.imdecode(np.frombuffer(shown, np.uint8), 1).shape == (300, 400, 3)
        assert second['state']['document']['trials'][0]['goal'] == second['id']
        assert 'rgb16' in page.refused('POST', 'api/topics', {'name': '/odd'})[1]
        assert 'no such topic' in page.refused('POST', 'api/topics', {'name': '/nothing'})[1]


@pytest.mark.long
def test_trials_are_sent_to_a_calibrator_in_another_process(ros_environment, tmp_path):
    from ros_robot import child

    with served(tmp_path / 'project') as page:
        whole_trial(page)
        assert 'another_name' in page.refused('POST', 'api/send', {'namespace': '/another_name'})[1]
        assert page.refused('POST', 'api/send', {'namespace': '/a b'})[0] == 400
        with child(ros_environment, tmp_path / 'node'):
            said = []
            # Its start may take longer than the page waits for it.
            page.until(lambda _: said.append(page.ask('POST', 'api/send', {'namespace': 'calibrator'})[::2])
                       or said[-1][0] == 200, 'the calibrator')
            assert json.loads(said[-1][1])['text'] == 'sent 1: /calibrator had 0 trials, and has 1 now'
            assert page.done('POST', 'api/send', {'namespace': '/calibrator'})['text'].endswith('has 2 now')


def image(encoding, values, step=None, big=False):
    """Return an Image of 4 x 4 pixels."""
    rows = np.ascontiguousarray(values)
    octets = rows.reshape(4, -1).view(np.uint8)
    return SimpleNamespace(encoding=encoding, width=4, height=4, step=step or octets.shape[1],
                           data=octets.tobytes(), is_bigendian=big)


def mosaic(pattern):
    """Return a (4, 4) mosaic of one colour; `pattern` has the letters of its first two rows."""
    tile = [COLOUR['rgb'.index(letter)] for letter in pattern]
    return np.tile(np.array(tile, np.uint8).reshape(2, 2), (2, 2))


IMAGES = {
    'rgb8': np.full((4, 4, 3), COLOUR, np.uint8),
    'bgr8': np.full((4, 4, 3), COLOUR[::-1], np.uint8),
    'rgba8': np.full((4, 4, 4), (*COLOUR, 7), np.uint8),
    'bgra8': np.full((4, 4, 4), (*COLOUR[::-1], 7), np.uint8),
    **{f'bayer_{pattern}8': mosaic(pattern) for pattern in ('rggb', 'bggr', 'gbrg', 'grbg')},
}


@pytest.mark.parametrize('encoding', IMAGES)
def test_colours_are_decoded(encoding):
    assert (decoded('image', image(encoding, IMAGES[encoding])) == COLOUR).all()


def test_grey_images_are_decoded():
    assert (decoded('image', image('mono8', np.full((4, 4), 77, np.uint8))) == 77).all()
    ramp = (np.arange(16).reshape(4, 4) * 100).astype('>u2')
    pixels = decoded('image', image('mono16', ramp, big=True))
    assert pixels[0, 0, 0] == 0 and pixels[3, 3, 2] == 255


@pytest.mark.parametrize('encoding, order', [('yuv422', (0, 1, 2, 3)), ('yuv422_yuy2', (1, 0, 3, 2))])
def test_video_images_are_decoded(encoding, order):
    mild = (150, 100, 120)
    luma, red, blue = cv2.cvtColor(np.full((1, 1, 3), mild, np.uint8), cv2.COLOR_RGB2YCrCb)[0, 0]
    pair = np.array([blue, luma, red, luma], np.uint8)[list(order)]  # U Y V Y, or Y U Y V
    pixels = decoded('image', image(encoding, np.tile(pair, (4, 2)))).astype(int)
    assert np.abs(pixels - mild).max() < 15


@pytest.mark.parametrize('fields', [
    {'encoding': 'compressed'}, {'width': 0}, {'height': 5}, {'step': 11}, {'width': 2**31, 'step': 2**33}])
def test_an_image_that_is_not_as_long_as_it_says_is_refused(fields):
    message = image('rgb8', IMAGES['rgb8'])
    vars(message).update(fields)
    with pytest.raises(InputError, match='image'):
        decoded('image', message)


def test_every_encoding_has_a_conversion():
    for encoding, (size, _) in ENCODINGS.items():
        assert decoded('image', image(encoding, np.full((4, 4 * size), 9, np.uint8))).shape == (4, 4, 3)
