# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The server of the capture page: from photographs to a result by HTTP."""

from contextlib import closing, ExitStack
import csv
import json
import shutil
import signal
import socket
import struct
import urllib.parse
import urllib.request
import zlib

from capture_page import (
    clicks,
    DIAMETER,
    drawn,
    GOAL,
    page_process,
    PATIENCE,
    PER_METRE,
    served,
    START,
    table,
    ToyInformation,
    whole_trial,
)
import cv2
import numpy as np
import pytest
from toy_simulator import new_toy, ToySimulator

from dlo_calibration.cli import main as cli
from dlo_calibration.files.result import read_result
from dlo_calibration.page import information
from dlo_calibration.page.calibration import ProjectCalibration
from dlo_calibration.simulation.scene import read_scene

pytestmark = pytest.mark.usefixtures('without_drawings')


@pytest.fixture(scope='module')
def shared(tmp_path_factory):
    """Give a page with an empty project, which tests do not change."""
    with served(tmp_path_factory.mktemp('shared') / 'project') as page:
        yield page


@pytest.fixture(scope='module')
def finished(tmp_path_factory):
    """Give a page whose trial has been calibrated, its folder, and its state."""
    folder = tmp_path_factory.mktemp('finished') / 'project'
    with served(folder, '--evaluations', 8, '--calibrate', 'flexibility', 'friction') as page:
        whole_trial(page)
        page.done('POST', 'api/calibrate', {'seed': 3})
        state = page.until(lambda state: 'report.html' in state['calibration']['files'], 'the report')
        yield page, folder, state


def test_two_photographs_make_a_trial(tmp_path):
    with served(tmp_path) as page:
        start = page.add(drawn(START), 'start.png')
        goal = page.add(drawn(GOAL, '.jpg'), 'goal.jpg')
        third = page.add(drawn(GOAL), 'third.png')
        state = page.state()
        assert [photograph['name'] for photograph in state['document']['photographs']] == [
            'start.png', 'goal.jpg', 'third.png']
        assert [(trial['start'], trial['goal']) for trial in state['document']['trials']] == [
            (start, goal), (goal, third)]
        assert not any(trial['complete'] for trial in state['trials'])
        assert state['photographs'][start]['width'] == 400


def test_clicks_become_a_chain_in_metres(finished):
    page, _, state = finished
    start, goal = (photograph['id'] for photograph in state['document']['photographs'])
    measured = state['photographs'][start]
    assert measured['scale']['residual'] < 1e-4
    length = np.linalg.norm(np.diff(START, axis=0), axis=1).sum() / PER_METRE
    # The photograph is too small for the tracer to be exact.
    assert measured['trace']['length'] == pytest.approx(length, abs=0.03)
    rows = np.array([list(map(float, row)) for row in csv.reader(
        page.get(f'api/files/{start}.csv').decode().splitlines())])
    assert rows.shape == (21, 3)
    assert rows[:, 2] == pytest.approx(DIAMETER / 2, abs=1e-3)
    assert b'<point ' in page.get(f'api/files/{goal}.xml')


def test_the_result_is_that_of_fit_on_the_saved_session(finished, tmp_path, command):
    page, folder, state = finished
    shown = state['calibration']['result']
    assert state['calibration']['state'] == 'done'
    assert (shown['seed'], shown['evaluations']) == (3, 8)
    assert shown['sentences'] and not shown['outdated']
    for name in ('session.mcap', 'request.xml'):
        saved = tmp_path / name
        saved.write_bytes(page.get(f'api/files/{name}'))
        _, result, _ = command('fit', saved, '--json')
        assert {name: result[name] for name in ('parameters', 'score')} == {
            name: shown[name] for name in ('parameters', 'score')}
    assert command('fit', folder / 'result' / 'session.mcap', '--json')[1]['score'] == shown['score']


def test_the_result_has_files(finished):
    page, _, _ = finished
    assert page.get('api/files/result.xml').startswith(b'<?xml')
    assert page.get('api/files/evaluations.csv').count(b'\n') == 9
    assert b'seed' in page.get('api/files/report.html')


def test_the_film_ends_near_the_goal(finished):
    page, _, state = finished
    start, goal = (photograph['id'] for photograph in state['document']['photographs'])
    film = json.loads(page.get(f'api/animation/0?photograph={goal}'))
    pixels = np.array(film['pixels'])
    assert pixels.shape == (len(film['times']), 21, 2)
    assert film['names'] == ['left_hand']
    assert film['hands'][film['goal']] == [None]
    holds = next(hands for hands in film['hands'] if hands[0] is not None)
    assert holds[0] == pytest.approx(state['trials'][0]['hands'][0]['start_pixels'][0], abs=5)
    assert page.refused('GET', f'api/animation/1?photograph={goal}')[0] == 400
    assert page.refused('GET', 'api/animation/0?photograph=../../et')[0] == 404


def test_a_reopened_project_has_everything(finished, tmp_path):
    page, folder, before = finished
    copy = shutil.copytree(folder, tmp_path / 'copy')
    with served(copy) as again:
        after = again.state()
        assert after['document'] == before['document']
        for identity, measured in after['photographs'].items():
            assert measured['trace']['pixels'] == before['photographs'][identity]['trace']['pixels']
        assert after['calibration']['result'] == before['calibration']['result']
        assert after['calibration']['state'] == 'done'
        assert after['calibration']['files'] == before['calibration']['files']
        goal = before['document']['photographs'][1]['id']
        shown = f'api/animation/0?photograph={goal}'
        assert again.get(shown) == page.get(shown)
        state = again.change(lambda document: document['trials'][0]['steps'][0].update(fraction=0.5))
        assert state['calibration']['result']['outdated']


def test_a_result_is_shown_without_the_files_of_another_result(finished, tmp_path):
    copy = shutil.copytree(finished[1], tmp_path / 'copy')
    text = (copy / 'result' / 'result.json').read_text()
    score = finished[2]['calibration']['result']['score']
    (copy / 'result' / 'result.json').write_text(text.replace(f'{score!r}', '1.5'))
    calibration = ProjectCalibration(copy, new_toy, {})
    assert calibration.plain_result('')['score'] == 1.5
    assert (calibration.files, calibration.description) == ((), None)


def test_no_link_in_a_folder_is_followed(finished, tmp_path):
    copy = shutil.copytree(finished[1], tmp_path / 'copy')
    (tmp_path / 'secret').write_text('secret')
    (copy / 'result' / 'report.html').unlink()
    (copy / 'result' / 'report.html').symlink_to(tmp_path / 'secret')
    calibration = ProjectCalibration(copy, new_toy, {})
    assert set(calibration.files) == {'result.xml', 'session.mcap', 'evaluations.csv'}


@pytest.mark.parametrize('content', [
    b'', b'{"result": [[[[', b'[' * 100000, b'\xff', b'[]', b' ' * (2**22 + 1),
    b'{"result": {"parameters": 3}, "digest": "", "state": "done"}'])
def test_a_result_from_a_stranger_is_ignored_if_it_is_damaged(tmp_path, content):
    (tmp_path / 'result').mkdir()
    (tmp_path / 'result' / 'result.json').write_bytes(content)
    calibration = ProjectCalibration(tmp_path, new_toy, {})
    assert (calibration.state, calibration.plain_result('')) == ('idle', None)


@pytest.mark.long
def test_the_information_of_each_trial_is_shown_before_a_calibration(tmp_path, monkeypatch):
    monkeypatch.setattr(information, 'LiveInformation', ToyInformation)
    with served(tmp_path, '--calibrate', 'flexibility', appraising=True) as page:
        whole_trial(page)
        state = page.until(lambda state: state['trials'][0]['information'], 'the information')
        appraised = state['trials'][0]['information']
        assert appraised['parameters'] == {'flexibility': pytest.approx(
            {'before': 30.0 * 4.5 / 6.5, 'after': 6.0 * 4.5 / 6.5})}
        assert appraised['sentence'].startswith('trial 1 makes flexibility more certain')
        assert state['calibration']['state'] == 'idle'


@pytest.mark.long
def test_a_calibration_can_be_stopped_and_gives_the_best_so_far(tmp_path):
    with served(tmp_path, simulator=lambda: ToySimulator(seconds=0.02)) as page:
        whole_trial(page)
        page.done('POST', 'api/calibrate', {'evaluations': 100000})
        under_way = page.until(lambda state: state['calibration']['evaluations'] > 2)['calibration']
        assert under_way['state'] == 'calibrating'
        assert under_way['seconds_left'] > 1
        assert set(under_way['best']['parameters']) >= {'flexibility'}
        assert page.refused('POST', 'api/calibrate')[0] == 400
        page.done('POST', 'api/stop')
        state = page.until(lambda state: state['calibration']['state'] != 'calibrating')
        assert state['calibration']['state'] == 'stopped'
        assert state['calibration']['result']['evaluations'] < 100000


def test_trials_are_compared_with_an_earlier_result(finished):
    page, folder, _ = finished
    octets = (folder / 'result' / 'result.xml').read_bytes()
    answer = page.done('POST', 'api/check', octets, {'X-Name': 'old.xml'})
    assert answer['verdict'] in ('agrees', 'changed', 'cannot tell')
    assert all(answer['words'])
    assert 'old.xml' in page.refused('POST', 'api/check', octets[:300], {'X-Name': 'old.xml'})[1]
    assert page.refused('POST', 'api/check', b'x' * 3_000_000)[0] == 413


@pytest.mark.long
def test_a_calibration_that_fails_says_why(tmp_path):
    with served(tmp_path, simulator=lambda: ToySimulator(crash=True)) as page:
        whole_trial(page)
        page.done('POST', 'api/calibrate')
        state = page.until(lambda state: state['calibration']['state'] != 'calibrating')
        assert state['calibration']['state'] == 'failed'
        assert 'the toy is broken' in state['calibration']['text']


def test_open_pages_get_progress_and_the_end(tmp_path):
    with ExitStack() as stack:
        with served(tmp_path) as page:
            address = f'{page.address}api/events'
            events = stack.enter_context(urllib.request.urlopen(address, timeout=PATIENCE))
            assert events.headers['Content-Type'] == 'text/event-stream'
            page.add(drawn(START))
            while events.readline() != b'event: state\n':
                pass
            state = json.loads(events.readline().removeprefix(b'data: '))
            assert state == page.state()
        assert b'event' not in events.read()


def test_the_second_of_two_windows_does_not_undo_the_first(tmp_path):
    with served(tmp_path) as page:
        old = page.state()
        page.change(lambda document: document['dlo'].update(mass=0.03))
        late = {name: old[name] for name in ('revision', 'document')}
        status, _, answer = page.ask('PUT', 'api/document', late)
        assert status == 409
        assert json.loads(answer)['state']['document']['dlo']['mass'] == 0.03
        assert page.state()['document']['dlo']['mass'] == 0.03


@pytest.mark.parametrize('octets, word', [
    (b'', 'empty'),
    (b'just a text', 'no photograph'),
    (drawn(START, '.jpg')[:-3000], 'ends too early'),
    (b'\0\0\0\x18ftypheic' + bytes(100), 'HEIC'),
], ids=['empty', 'text', 'truncated', 'heic'])
def test_a_file_that_is_no_photograph_is_refused(shared, octets, word):
    status, sentence = shared.refused('POST', 'api/photographs', octets, {'X-Name': 'one.jpg'})
    assert (status, word in sentence) == (400, True), sentence
    assert shared.state()['document']['photographs'] == []


def test_a_huge_picture_is_refused_before_it_is_decoded(shared):
    head = struct.pack('>IIBBBBB', 20000, 10000, 8, 2, 0, 0, 0)
    bomb = b'\x89PNG\r\n\x1a\n' + b''.join(
        struct.pack('>I', len(data)) + kind + data + struct.pack('>I', zlib.crc32(kind + data))
        for kind, data in ((b'IHDR', head), (b'IDAT', zlib.compress(bytes(10**6)))))
    assert '20000 x 10000' in shared.refused('POST', 'api/photographs', bomb)[1]
    assert shared.state()['document']['photographs'] == []


def test_too_large_uploads_are_refused(shared):
    for method, path, size in (('POST', 'api/photographs', 64 * 2**20), ('PUT', 'api/document', 2 * 2**20)):
        status, sentence = shared.refused(method, path, bytes(size + 1))
        assert (status, 'send a smaller file' in sentence) == (413, True), sentence


@pytest.mark.parametrize('content, kind, status', [
    (b'{"revision": NaN}', 'application/json', 400),
    (b'{"revision": ', 'application/json', 400),
    (b'[' * 100000, 'application/json', 400),
    (b'[]', 'application/json', 400),
    (b'\xff\xfe', 'application/json', 400),
    (b'{}', 'text/plain', 415),
    (b'{"revision": 1, "document": {"photographs": [{"id": "../../../x"}]}}', 'application/json', 400),
])
def test_json_that_cannot_be_used_is_refused(shared, content, kind, status):
    assert shared.refused('PUT', 'api/document', content, {'Content-Type': kind})[0] == status


@pytest.mark.parametrize('headers, content', [
    (('Content-Length: 5', 'Transfer-Encoding: chunked'), b'{}'),
    (('Content-Length: x',), b''),
    (('no header',), b''),
    (('Content-Length: 9', 'Content-Encoding: gzip', 'Content-Type: application/json'), b'no gzip..'),
], ids=str)
def test_a_broken_request_is_refused_and_writes_nothing_to_the_terminal(shared, caplog, headers, content):
    address = urllib.parse.urlsplit(shared.address)
    lines = f'POST {address.path}api/calibrate HTTP/1.1', f'Host: {address.netloc}', *headers, '', ''
    with socket.create_connection((address.hostname, address.port), PATIENCE) as connection:
        connection.sendall('\r\n'.join(lines).encode() + content)
        assert connection.recv(100).split()[1] == b'400'
    shared.state()
    assert caplog.records == []


def test_an_upload_that_ends_early_writes_nothing_to_the_terminal(shared, caplog):
    address = urllib.parse.urlsplit(shared.address)
    lines = (f'POST {address.path}api/photographs HTTP/1.1', f'Host: {address.netloc}', 'Content-Length: 999',
             '', '')
    with socket.create_connection((address.hostname, address.port), PATIENCE) as connection:
        connection.sendall('\r\n'.join(lines).encode())
        shared.state()  # the server waits for the photograph
    shared.state()
    assert caplog.records == []


def test_an_incomplete_trial_is_not_calibrated(shared):
    assert 'no complete trial' in shared.refused('POST', 'api/calibrate')[1]
    for name in ('session.mcap', 'result.xml', 'report.html'):
        assert shared.refused('GET', f'api/files/{name}')[0] == 400
    assert shared.refused('POST', 'api/calibrate', {'workers': 3})[0] == 400


@pytest.mark.long
def test_clicks_beside_the_rope_or_outside_the_photograph_are_refused_or_unsure(tmp_path):
    with served(tmp_path) as page:
        empty = page.add(drawn(None))
        state = page.change(lambda document: document['photographs'][0].update(clicks=clicks(START)))
        measured = state['photographs'][empty]
        assert measured['trace_problem'] or not all(measured['trace']['sure'])
        outside = [[9e3, 9e3], [5.0, 5.0]]
        state = page.change(lambda document: document['photographs'][0].update(clicks=outside))
        assert '400 x 300' in state['photographs'][empty]['trace_problem']


@pytest.mark.parametrize('headers', [
    {'Host': 'example.org'}, {'Host': 'localhost:1'}, {'Origin': 'http://example.org'}, {'Origin': 'null'},
    {'Sec-Fetch-Site': 'cross-site'}, {'Sec-Fetch-Site': 'same-site'},
], ids=str)
def test_other_pages_are_refused(shared, headers):
    assert shared.refused('GET', 'api/state', None, headers)[0] == 403


def test_an_address_without_the_token_is_not_found(shared):
    base = shared.address.rstrip('/').rpartition('/')[0]
    shorter = shared.address[:-2].removeprefix(base)
    for path in ('/', '/api/state', '/page/main.js', '//', '/x/api/state', shorter):
        assert shared.refused('GET', base + path)[0] == 404


@pytest.mark.parametrize('path', [
    'page/..%2fserver.py', 'page/%2e%2e/server.py', 'api/files/..%2fproject.json', 'api/files/project.json',
    'api/photographs/..%2f..%2fx/picture', 'api/board/a5.pdf', 'api/animation/x', 'api/nothing',
    'api/files/'])
def test_names_never_lead_to_other_files(shared, path):
    assert shared.refused('GET', path)[0] == 404


def test_every_answer_keeps_other_pages_out(finished):
    page, _, _ = finished
    for path in ('api/state', 'api/nothing', 'api/files/report.html'):
        headers = page.ask('GET', path)[1]
        assert headers['X-Content-Type-Options'] == 'nosniff'
        assert headers['Referrer-Policy'] == 'no-referrer'
        assert "default-src 'none'" in headers['Content-Security-Policy']
        assert ('sandbox' in headers['Content-Security-Policy']) == path.endswith('.html')
        assert 'Access-Control-Allow-Origin' not in headers


def test_pictures_have_the_width_that_is_asked_for(tmp_path):
    with served(tmp_path) as page:
        identity = page.add(drawn(START))
        for width, expected in ((160, 160), (5000, 400), (None, 400)):
            query = '' if width is None else f'?width={width}'
            octets = page.get(f'api/photographs/{identity}/picture{query}')
            pixels = cv2.imdecode(np.frombuffer(octets, np.uint8), cv2.IMREAD_COLOR)
            assert pixels.shape == (expected * 3 // 4, expected, 3)
            place = START[100] * expected / 400
            blue, _, red = pixels[round(place[1]), round(place[0])].astype(int)
            assert red > blue + 60
        assert page.refused('GET', f'api/photographs/{identity}/picture?width=-3')[0] == 400
        assert page.refused('GET', f'api/photographs/{identity}/picture?width=1')[0] == 400


def test_a_camera_calibration_is_used_and_can_be_removed(tmp_path):
    lens = json.dumps({
        'image_width': 400, 'image_height': 300, 'camera_name': 'one', 'distortion_model': 'plumb_bob',
        'camera_matrix': {'rows': 3, 'cols': 3, 'data': [450.0, 0, 200, 0, 450, 150, 0, 0, 1]},
        'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': [0.0] * 5}}).encode()
    with served(tmp_path) as page:
        assert page.done('POST', 'api/lens', lens, {'X-Name': 'one.yaml'})['lens'] == 'one.yaml'
        assert page.refused('POST', 'api/lens', b'no: calibration', {'X-Name': 'two.yaml'})[0] == 400
        assert page.state()['lens'] == 'one.yaml'
        assert page.done('DELETE', 'api/lens')['lens'] is None


def test_the_board_can_be_printed_from_the_page_and_the_command_line(shared, tmp_path, capsys):
    assert shared.get('api/board/letter.pdf').startswith(b'%PDF')
    assert cli.main(['capture', '--print-board', str(tmp_path / 'board.pdf')]) == 0
    assert (tmp_path / 'board.pdf').read_bytes().startswith(b'%PDF')
    assert '100 %' in capsys.readouterr().err


@pytest.mark.long
def test_kill_loses_nothing_and_a_signal_ends_it_well(tmp_path):
    folder = tmp_path / 'project'
    words = '--evaluations', 100000, '--search', 'random', '--workers', 1
    with page_process(folder, *words) as (page, process):
        before = whole_trial(page)
        page.done('POST', 'api/calibrate')
        page.until(lambda state: state['calibration']['evaluations'] > 1)
        process.kill()
        process.wait()
    with page_process(folder, *words, '--host', '0.0.0.0') as (page, process):
        after = page.state()
        assert after['document'] == before['document']
        assert after['trials'][0]['complete']
        page.done('POST', 'api/calibrate')
        page.until(lambda state: any(
            'goes on after' in warning for warning in state['calibration']['warnings']))
        process.send_signal(signal.SIGTERM)
        warning, *rest = process.communicate(timeout=PATIENCE)[1].splitlines()
        assert process.returncode == 0
        assert warning.startswith('warning: --host 0.0.0.0')
        assert rest == [f'everything is kept in {folder}']
    assert (folder / 'result' / 'unfinished' / 'evaluations.log').is_file()


def refusal_of(capsys, *words):
    """Return the refusal of a command that cannot begin."""
    assert cli.main(['capture', '--no-browser', *map(str, words)]) == 2
    line, = capsys.readouterr().err.splitlines()
    return line


def test_unusable_input_is_refused_in_one_sentence(tmp_path, capsys):
    with closing(socket.socket()) as server:
        server.bind(('127.0.0.1', 0))
        server.listen()
        port = server.getsockname()[1]
        assert str(port) in refusal_of(capsys, tmp_path / 'one', '--port', port)
    assert '0 to 65535' in refusal_of(capsys, tmp_path / 'one', '--port', 99999)
    (tmp_path / 'file').write_text('x')
    for words in ((tmp_path / 'file',), ('--print-board', tmp_path / 'file' / 'board.pdf')):
        refusal = refusal_of(capsys, *words)
        assert str(tmp_path / 'file') in refusal
        assert refusal.endswith('; choose another place')
    assert 'evaluations' in refusal_of(capsys, tmp_path / 'one', '--evaluations', -1)
    with served(tmp_path / 'two'):
        assert 'another capture' in refusal_of(capsys, tmp_path / 'two')


def with_peg(document):
    """Let a low peg of 16 mm stand beside the DLO; the camera looks straight down."""
    photograph = document['photographs'][0]['id']
    document['obstacles'] = [
        {'photograph': photograph, 'kind': 'peg', 'first': [200, 250], 'second': [205, 250], 'height': 0.002}]


@pytest.mark.long
def test_obstacles_on_the_photograph_are_the_scene_of_the_calibration(tmp_path, command):
    folder = tmp_path / 'project'
    with served(folder, '--evaluations', 4, '--calibrate', 'flexibility', 'friction') as page:
        whole_trial(page)
        state = page.change(with_peg)
        start, goal = (photograph['id'] for photograph in state['document']['photographs'])
        assert state['obstacles'][0]['problem'] is None
        assert len(state['photographs'][start]['obstacles']) == 2
        assert len(state['photographs'][goal]['obstacles']) == 2  # it stands there, too
        page.done('POST', 'api/calibrate', {'seed': 3})
        state = page.until(lambda state: 'report.html' in state['calibration']['files'], 'the report')
        assert not state['calibration']['result']['outdated']
        for path in (folder / 'obstacles.urdf', folder / 'result' / 'obstacles.urdf'):
            peg, = read_scene(str(path))
            assert peg.position[:2] == pytest.approx(table((200, 250)), abs=2e-3)
            assert 2 * peg.sizes[1] == pytest.approx(0.016, rel=0.05)
        scene = read_result(folder / 'result' / 'result.xml').file_options.options().scene
        assert scene == str((folder / 'result' / 'obstacles.urdf').resolve())
        assert command('fit', folder / 'result' / 'session.mcap', '--json')[1]['score'] == (
            state['calibration']['result']['score'])
        assert page.get('api/files/obstacles.urdf') == (folder / 'obstacles.urdf').read_bytes()
        state = page.change(lambda document: document['obstacles'][0].update(height=0.03))
        assert state['calibration']['outdated']
        kept, = read_scene(str(folder / 'result' / 'obstacles.urdf'))
        assert kept.sizes[0] == 0.002  # with which it was calibrated


def test_a_calibration_with_an_obstacle_that_has_no_place_is_refused(tmp_path):
    with served(tmp_path) as page:
        whole_trial(page)
        page.change(with_peg)
        state = page.change(lambda document: document['obstacles'][0].update(second=[200, 250]))
        assert 'obstacle 1' in state['obstacles'][0]['problem']
        _, sentence = page.refused('POST', 'api/calibrate', {})
        assert 'obstacle 1' in sentence
        page.change(lambda document: document.update(obstacles=[]))
        assert 'no obstacle yet' in page.refused('GET', 'api/files/obstacles.urdf')[1]
