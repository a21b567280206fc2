# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Films on the capture page: from a file to trials, by HTTP and in a real browser."""


import re

from browser import browser, Tab
from capture_page import served
from filmed_trials import clicks, film_camera, filmed_trials, LENGTH, MASS, Move
from films import write_film
import numpy as np
import pytest

from dlo_calibration.files.session import read_session
from dlo_calibration.simulation.compiled import CompiledSimulator

pytestmark = pytest.mark.usefixtures('without_drawings')

SIZE, RATE = (1280, 720), 15.0
CAMERA = film_camera(SIZE)


def ramps(count, size=(160, 120)):
    for k in range(count):
        yield np.full((size[1], size[0], 3), 20 + 10 * k, np.uint8)


@pytest.fixture(scope='module')
def short(tmp_path_factory):
    """Give a film in which nothing is."""
    path = tmp_path_factory.mktemp('short') / 'short.mp4'
    write_film(path, ramps(8), 10.0)
    return path


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Give a film of a trial, and what happens in it; Chromium cannot play it, and shows its images."""
    path = tmp_path_factory.mktemp('whole') / 'whole.mp4'
    film = filmed_trials((Move(12, (0.06, 0.18)),), RATE)
    write_film(path, film.images(CAMERA, colour=(0.10, 0.24, 0.55)), RATE)
    return path, film


def sees_the_arrow(tab, server):
    """Let a person see the next movement on the film: from the DLO, as the last trial has left it."""
    tab.button('Show it on the newest picture').click()
    head = tab.find('#drawn .head path')
    head.wait_for()
    assert tab.find('#drawn .advised').count() == 1
    advice = server.state()['advice']
    (begin, *_, end), = advice['ways']
    box, (u, v) = head.bounding_box(), tab.place(end)
    assert box['x'] - 6 <= u <= box['x'] + box['width'] + 6
    assert box['y'] - 6 <= v <= box['y'] + box['height'] + 6
    line = server.done('GET', f'api/films/{advice["view"]}/line')
    seen = np.array(list(filter(None, line['pixels'][-1])))
    # An end may be hidden: then it is one step beyond the last point that is seen.
    step = np.median(np.linalg.norm(np.diff(seen, axis=0), axis=1))
    assert np.linalg.norm(seen - begin, axis=1).min() < 1.2 * step


def marked(page, identity, time, places):
    """Put clicks into an image of a film, and follow the DLO."""
    def edit(document):
        document['dlo']['mass'] = MASS
        document['films'][0]['marks'] = [{'time': time, 'clicks': np.asarray(places).tolist()}]

    page.change(edit)
    page.done('POST', f'api/films/{identity}/follow')


def start_of_trial(state):
    """Return when the only trial of the only film starts [s]."""
    film, = state['films'].values()
    trial, = film['trials']
    return trial['start']


@pytest.mark.long
def test_a_film_is_kept_played_and_removed(tmp_path, short):
    with served(tmp_path / 'project') as page:
        answer = page.done('POST', 'api/films', short.read_bytes(), {'X-Name': 'my%20film.mp4'})
        entry, = answer['state']['document']['films']
        assert (entry['id'], entry['name']) == (answer['id'], 'my film.mp4')
        seen = answer['state']['films'][entry['id']]
        assert (seen['width'], seen['height']) == (160, 120)
        assert seen['duration'] == pytest.approx(0.8)
        assert page.get(f'api/films/{entry["id"]}/video') == short.read_bytes()
        assert page.get(f'api/films/{entry["id"]}/frame?time=0.4')[:3] == b'\xff\xd8\xff'
        page.change(lambda document: document.update(films=[]))
        assert page.state()['films'] == {}


def test_what_is_no_film_is_refused_and_leaves_no_file(tmp_path):
    with served(tmp_path / 'project') as page:
        code, error = page.refused('POST', 'api/films', b'x' * 1000, {'X-Name': 'notes.mp4'})
        assert code == 400 and 'film notes.mp4' in error and 'no film' in error
        assert page.state()['document']['films'] == []
        assert list((tmp_path / 'project' / 'films').iterdir()) == []


@pytest.mark.long
def test_clicks_beside_any_dlo_are_a_problem_of_the_film(tmp_path, short):
    with served(tmp_path / 'project') as page:
        identity = page.done('POST', 'api/films', short.read_bytes())['id']
        marked(page, identity, 0.0, [(20, 20), (90, 90)])
        state = page.until(lambda state: state['films'][identity]['problem'], 'the problem')
        assert 'board' in state['films'][identity]['problem']


@pytest.mark.long
def test_a_film_becomes_a_trial_that_survives_the_end_of_the_page(tmp_path, whole):
    path, film = whole
    with served(tmp_path / 'project') as page:
        identity = page.done('POST', 'api/films', path.read_bytes())['id']
        marked(page, identity, 0.0, clicks(film, CAMERA))
        state = page.until(lambda state: state['films'][identity].get('trials'), 'the trial')
        own, = state['films'][identity]['trials']
        hand, = own['hands']
        assert hand['place'] == pytest.approx(12 / 60, abs=0.03)
        assert hand['closes'] == pytest.approx(film.holds[0][0], abs=0.25)
        trial, = state['trials']
        assert trial['complete']
        (tmp_path / 'session.mcap').write_bytes(page.get('api/files/session.mcap'))
        recorded, = read_session(tmp_path / 'session.mcap').trials
        assert recorded.initial.length == pytest.approx(LENGTH, rel=0.02)
        line = page.done('GET', f'api/films/{identity}/line')
        assert len(line['times']) == len(film.times)

        def edit(**changes):
            at = (hand['closes'] + hand['opens']) / 2
            page.change(lambda document: document['films'][0].update(trials=[{'at': at, **changes}]))

        edit(used=False)
        assert page.state()['trials'] == []
        edit(name='towards the wall')
        assert page.state()['trials'][0]['name'] == 'towards the wall'
        edit(start=1.0, end=own['end'] - 0.5)
        state = page.until(lambda state: not state['films'][identity]['cutting'], 'the trial, cut anew')
        changed, = state['films'][identity]['trials']
        assert changed['start'] == pytest.approx(1.0, abs=1 / RATE)
        assert changed['end'] == pytest.approx(own['end'] - 0.5, abs=1 / RATE)
        assert changed['hands'] == [{**hand, 'place': pytest.approx(hand['place'], abs=0.01)}]
    with served(tmp_path / 'project') as page:  # where the DLO is was kept
        state = page.until(lambda state: state['films'][identity].get('trials'), 'the trial')
        assert state['films'][identity]['trials'] == [changed]
        assert not state['films'][identity]['outdated']
        page.change(lambda document: document['films'][0].update(ruler=0.11))
        assert page.state()['films'][identity]['outdated']
    kept, = (tmp_path / 'project' / 'films').glob('*.npz')
    kept.write_bytes(kept.read_bytes()[:1000])
    with served(tmp_path / 'project') as page:  # it is followed again by itself
        state = page.until(lambda state: state['films'][identity].get('trials'), 'the trial')
        assert not state['films'][identity]['outdated']


@pytest.mark.long
def test_a_person_drops_a_film_clicks_calibrates_and_sees_the_simulated_dlo_on_it(tmp_path, whole):
    path, film = whole
    with browser() as started, served(tmp_path / 'project', '--evaluations', 40, '--calibrate', 'flexibility',
                                      'friction', simulator=CompiledSimulator, appraising=True) as server:
        tab = Tab(started, server.address)
        tab.find('input[type=file][accept*="video"]').set_input_files(str(path))
        tab.button('Follow the DLO').wait_for()
        tab.find('text=cannot play the film').wait_for()
        box = tab.find('#stage').bounding_box()
        place = tab.page.evaluate('getComputedStyle(document.querySelector("#pictures")).transform')
        scale, _, _, _, left, top = map(float, place[7:-1].split(','))
        for u, v in clicks(film, CAMERA, 3):
            tab.page.mouse.click(box['x'] + left + u * scale, box['y'] + top + v * scale)
        tab.find('#drawn .mark').nth(2).wait_for()
        tab.button('Follow the DLO').click()
        tab.find('text=Use this trial').wait_for()
        tab.field('Mass of the DLO').fill('30')
        tab.page.keyboard.press('Tab')
        tab.find('.advice').get_by_text('Grip').wait_for()
        assert tab.find('#drawn .head').count() == 0  # the DLO lies elsewhere in the first image
        sees_the_arrow(tab, server)
        tab.button('Next: Calibrate').click()
        tab.page.get_by_role('button', name='Calibrate', exact=True).last.click()
        tab.find('section[aria-label=Result]').wait_for()
        sees_the_arrow(tab, server)
        tab.button('Next: Calibrate').click()
        tab.button('Watch').click()
        tab.field('Time of the film').fill(str(round(film.holds[0][1], 1)))
        tab.find('#drawn .simulated').wait_for()
        assert tab.find('#drawn .sure').count()
        tab.field('Name').fill('towards the wall')
        tab.page.keyboard.press('Tab')
        tab.button('towards the wall').wait_for()
        edge = tab.page.get_by_role('slider', name='Start of towards the wall')
        before = float(edge.get_attribute('aria-valuenow'))
        box = edge.bounding_box()
        tab.page.mouse.move(box['x'] + box['width'] / 2, box['y'] + box['height'] / 2)
        tab.page.mouse.down()
        tab.page.mouse.move(box['x'] + 60, box['y'], steps=4)
        tab.page.mouse.up()
        state = server.until(lambda state: start_of_trial(state) > before + 0.2, 'the trial, cut anew')
        shown = float(edge.get_attribute('aria-valuenow'))
        assert start_of_trial(state) == pytest.approx(shown, abs=1 / RATE)
        tab.button('Undo').click()
        tab.page.wait_for_function(
            '([edge, before]) => Math.abs(edge.getAttribute("aria-valuenow") - before) < 0.01',
            arg=[edge.element_handle(), before])
        tab.button('towards the wall').press('Delete')
        tab.page.wait_for_function('tick => !tick.checked', arg=tab.field('Use this trial').element_handle())
        assert not tab.complaints
        tab.close()


@pytest.mark.long
def test_a_film_that_the_browser_can_play_runs(tmp_path):
    write_film(tmp_path / 'short.webm', ramps(20), 10.0, 'VP80')
    with browser() as started, served(tmp_path / 'project') as server:
        tab = Tab(started, server.address)
        tab.find('input[type=file][accept*="video"]').set_input_files(str(tmp_path / 'short.webm'))
        tab.button('Play').click()
        tab.page.locator('.controls output', has_text=re.compile('[1-9][.]')).wait_for()
        assert not tab.complaints
        tab.close()
