# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The capture page in a real browser: what a person does with mouse and keys, and what the page shows."""

import re
import time

from browser import browser, DESKTOP, STEPS, Tab, TELEPHONE
from capture_page import (
    clicks,
    CORNERS,
    DIAMETER,
    drawn,
    GOAL,
    SCALE,
    served,
    START,
    table,
    ToyInformation,
    whole_trial,
)
import cv2
import hung_loops
import numpy as np
from PIL import Image
import pytest

from dlo_calibration.files.session import samples
from dlo_calibration.model.parameters import interval
from dlo_calibration.page import information
from dlo_calibration.simulation.compiled import CompiledSimulator

pytestmark = [pytest.mark.usefixtures('without_drawings'), pytest.mark.long]

PATIENCE = 30  # s
PICTURE = re.compile(r'/photographs/\w+/picture')
TURN = np.linspace(0.0, 1.0, 300)
LOOP = np.column_stack([50 + 290 * TURN + 94 * np.sin(2 * np.pi * TURN) * np.sin(np.pi * TURN)**2,
                        125 + 94 * np.sin(np.pi * TURN)**4])  # px, crosses itself once


@pytest.fixture(scope='module')
def chromium():
    """Give the browser."""
    with browser() as started:
        yield started


@pytest.fixture(scope='module')
def server(tmp_path_factory, chromium):
    """Give the server; `empty` empties its project for each test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(information, 'LiveInformation', ToyInformation)
        with served(tmp_path_factory.mktemp('browser') / 'project', '--evaluations', 12, '--calibrate',
                    'flexibility', 'friction', simulator=CompiledSimulator, appraising=True) as client:
            yield client


@pytest.fixture
def empty(server):
    """Give the server with an empty project."""
    server.change(lambda document: document.update(photographs=[], trials=[], obstacles=[]))
    return server


@pytest.fixture
def opened(chromium, empty):
    """Give a function that opens the page; its console may report nothing but refusals."""
    tabs = []

    def tab(size=DESKTOP, **how):
        tabs.append(Tab(chromium, empty.address, size, **how))
        return tabs[-1]

    yield tab
    for window in tabs:
        window.close()
    assert [text for window in tabs for text in window.complaints if 'Failed to load' not in text] == []


@pytest.fixture
def prepared(empty):
    """Give the server with two photographs that have a scale."""
    for name, line in (('start.png', START), ('goal.png', GOAL)):
        empty.add(drawn(line), name)
    empty.change(scaled)
    return empty


def scaled(document):
    """Give all photographs of a document their scale."""
    document['dlo']['diameter'] = DIAMETER
    for photograph in document['photographs']:
        photograph['scale'] = SCALE


def seen(check):
    """Wait until a check returns a true value; return it."""
    begun = time.monotonic()
    while not (value := check()):
        assert time.monotonic() - begun < PATIENCE
        time.sleep(0.03)
    return value


def entry(server, k=0):
    """Return a photograph of the document."""
    return server.state()['document']['photographs'][k]


def saved_clicks(server, count, k=0):
    """Return the clicks of a photograph once there are `count`."""
    return seen(lambda: (saved := entry(server, k)['clicks']) and len(saved) == count and saved)


def photographs(folder):
    """Return the paths of a start and a goal photograph."""
    for name, line in (('start', START), ('goal', GOAL)):
        (folder / f'{name}.png').write_bytes(drawn(line))
    return [folder / 'start.png', folder / 'goal.png']


def test_a_whole_trial_from_upload_to_result(opened, empty, tmp_path):
    tab = opened()
    violations = {'empty': tab.violations()}
    tab.find('input[type=file]').first.set_input_files(photographs(tmp_path))
    tab.find('.photographs li').nth(1).wait_for()
    violations['photographs'] = tab.violations()
    tab.button('Next: Scale').click()
    tab.field('Four or more points').click()
    for k, corner in enumerate(CORNERS):
        tab.click(corner)
        tab.mark(f'point {k}').wait_for()
        for axis, value in zip('xy', table(corner), strict=True):
            tab.field(f'{axis} of P{k + 1} in mm').fill(str(1e3 * value))
            tab.keys('Tab')
    tab.find('.outcome').wait_for()
    assert tab.find('.line.grid').count() > 5
    violations['scale'] = tab.violations()
    tab.button('same scale for all').click()
    tab.button('Next: DLO').click()
    for role, line in (('Start', START), ('Goal', GOAL)):
        tab.photograph(role)
        tab.clicked(clicks(line))
        tab.find('.line.sure').first.wait_for()
        violations[role] = tab.violations()
    tab.button('Next: Hands').click()
    tab.button('Drag').click()
    tab.find('.line.way').first.wait_for()
    tab.drag(START[100], START[-1])
    seen(lambda: empty.state()['document']['trials'][0]['steps'][0]['fraction'] > 0.95)
    violations['hands'] = tab.violations()
    tab.button('Next: Calibrate').click()
    tab.find('.shows').wait_for()  # the information before the calibration
    tab.button('Calibrate').last.click()
    tab.find('table.result').wait_for()
    assert {'flexibility', 'friction'} <= set(tab.find('table.result').inner_text().split())
    headline = tab.find('[aria-label="Result"] > *').nth(1).inner_text()
    assert headline == empty.state()['calibration']['result']['headline']
    assert 'the simulated points are' in headline.lower()
    simulated = tab.find('.line.simulated polyline').first
    simulated.wait_for()
    at_goal = simulated.get_attribute('points')
    tab.field('Animation of the simulated DLO').last.fill('0')
    tab.find('output:has-text("0.0 s")').wait_for()
    assert simulated.get_attribute('points') != at_goal
    violations['result'] = tab.violations()
    with tab.page.expect_download() as download:
        tab.find('a[href$="session.mcap"]').click()
    assert download.value.path().stat().st_size > 1000
    assert {step: faults for step, faults in violations.items() if faults} == {}


def test_one_photograph_of_a_loop_that_hangs_is_a_trial(opened, empty, tmp_path):
    camera, (shape, ends) = hung_loops.view(), hung_loops.loop()
    Image.fromarray(hung_loops.picture(camera)).save(tmp_path / 'loop.png', compress_level=1)
    tab = opened()
    tab.find('input[type=file]').first.set_input_files([tmp_path / 'loop.png'])
    tab.find('.photographs li').first.wait_for()
    tab.field('It hangs between two clamps').click()
    tab.button('Next: Scale').click()
    tab.field('Length of the DLO').fill(str(1e3 * hung_loops.LENGTH))
    for k, clamp in enumerate(hung_loops.pixels(camera, ends + 2 * (ends - shape[[0, -1]]))):
        tab.click(clamp)
        tab.mark(f'clamp {k}').wait_for()
    violations = {'scale': tab.violations()}
    tab.button('Next: DLO').click()
    tab.clicked(hung_loops.pixels(camera, shape[[0, 100, 200, -1]]))
    tab.find('.line.sure').first.wait_for()
    violations['DLO'] = tab.violations()
    tab.step('Calibrate')
    tab.button('Calibrate').last.click()
    tab.find('table.result').wait_for()
    tab.find('.line.simulated polyline').first.wait_for()
    assert {step: faults for step, faults in violations.items() if faults} == {}


def test_a_narrow_interval_stays_visible_and_is_written_with_one_power_of_ten(opened, empty):
    estimate = {'value': 41.2, 'std': 0.1, 'lower': 41.0, 'upper': 41.4, 'physical_value': 1.02e-4,
                'physical_lower': 9.23e-5, 'physical_upper': 1.12e-4, 'physical_unit': 'N m^2',
                'identifiable': True, 'verdict': 'identifiable', 'note': ''}
    ends = {'lower': 0.0, 'upper': 0.2, 'value': 0.1}, {}, {'lower': 99.8, 'upper': 100.0, 'value': 99.9}
    names = 'friction', 'flexibility', 'damping'
    result = {'headline': 'Usable: yes.', 'unusable': '', 'sentences': [], 'warnings': [],
              'parameters': {name: {**estimate, **end} for name, end in zip(names, ends, strict=True)}}

    def answer(route):
        state = route.fetch().json()
        state['calibration'].update(state='done', result=result)
        route.fulfill(json=state)

    tab = opened()
    tab.page.route('**/api/state', answer)
    tab.page.reload()
    tab.step('Calibrate')
    tab.find('.headline.good').wait_for()
    for bar in tab.find('svg.bar').all():
        whole, mark, value = (bar.locator(part).bounding_box() for part in ('.whole', '.interval', '.value'))
        assert mark['width'] > 3 * value['width']
        assert mark['height'] > 1.5 * whole['height']
        for inside in (mark, value):
            assert whole['x'] - 0.1 <= inside['x'] <= whole['x'] + whole['width'] - inside['width'] + 0.1
    text = tab.find('table.result').inner_text()
    assert '1.02e-4 N m²' in text and '0.923e-4 to 1.12e-4 N m²' in text
    assert tab.violations() == []


@pytest.mark.parametrize(('lower', 'upper', 'text'), [
    (9.5e-4, 1.1e-3, '0.00095 to 0.0011 N'), (5e5, 2e6, '0.5e6 to 2e6 N'), (0.0, 1.12e-4, '0 to 1.12e-4 N'),
    (-2e-4, 1e-4, '-2e-4 to 1e-4 N'), (3.16e-6, 0.1, '0.00000316 to 0.1 N'), (12.0, 1897.0, '12 to 1900 N')])
def test_the_page_writes_intervals_as_the_reports_do(opened, lower, upper, text):
    words = opened().page.evaluate(
        "async ends => (await import('./page/words.js')).interval(...ends, 'N')", [lower, upper])
    assert words == interval(lower, upper, 'N') == text


def test_what_is_missing_is_said_once(opened, prepared):
    tab = opened()
    tab.step('DLO')
    tab.clicked(clicks(START))
    tab.find('.line.sure').first.wait_for()
    assert tab.find('.missing').inner_text() == 'Still missing: the DLO at the goal of trial 1.'
    assert 'goal photograph' not in tab.find('.panel').inner_text()
    tab.step('Calibrate')
    missing = tab.find('.missing')
    assert missing.count() == 1
    assert missing.locator('li').all_inner_texts() == [
        'Click along the DLO in the goal photograph, from one end to the other.',
        'Say what the hand did between the two photographs.']
    assert missing.locator('button').all_inner_texts() == ['Go to the DLO', 'Go to the hands']
    assert tab.find('.warnings').count() == 0
    assert tab.violations() == []
    tab.button('Go to the hands').click()
    tab.page.get_by_role('heading', name='Hands', level=2).wait_for()
    assert tab.find('.missing').inner_text() == 'Still missing: what the hand did in trial 1.'


def test_next_waits_until_all_photographs_are_added(opened, empty, tmp_path):
    tab = opened()
    uploads, following = [], tab.button('Next: Scale')
    tab.page.route('**/api/photographs', lambda route: uploads.append(route))
    tab.find('input[type=file]').first.set_input_files(photographs(tmp_path))
    for words in ('2 photographs are', '1 photograph is'):
        waiting = tab.find(f'.onward:has-text("Wait until {words} added.")')
        seen(lambda waiting=waiting: waiting.count() and uploads)
        assert following.is_disabled()
        assert tab.violations() == []
        uploads.pop().continue_()
    tab.find('.onward .note').wait_for(state='detached')
    assert following.is_enabled()


def test_clicks_are_dragged_nudged_inserted_and_removed_and_all_of_it_is_undone(opened, prepared):
    tab = opened()
    tab.step('DLO')
    tab.clicked(clicks(START))
    first = saved_clicks(prepared, 4)
    tab.drag(first[1], (first[1][0] + 20, first[1][1]))
    dragged = seen(lambda: (now := entry(prepared)['clicks'])[1][0] > first[1][0] + 15 and now)
    tab.mark('click 2').focus()
    tab.keys('ArrowRight', 'Shift+ArrowDown')
    u, v = first[2]
    seen(lambda: entry(prepared)['clicks'][2] == pytest.approx([u + 1, v + 10], abs=0.01))
    tab.mark('click 0').focus()
    tab.keys('Delete')
    saved_clicks(prepared, 3)
    tab.find('.outcome:has-text("3 clicks")').wait_for()
    tab.drag(START[100], START[100] + [0, 15])  # the line, between two clicks
    seen(lambda: [*entry(prepared)['clicks'], None][1] == pytest.approx(list(START[100] + [0, 15]), abs=1.5))
    assert saved_clicks(prepared, 4)[0] == dragged[1]
    for count in (3, 4):
        tab.keys('Control+z')
        saved_clicks(prepared, count)
    tab.keys('Control+z')  # successive nudges are one step
    seen(lambda: entry(prepared)['clicks'] == dragged)
    tab.button('Undo').click()  # a whole drag, too
    seen(lambda: entry(prepared)['clicks'] == first)
    tab.keys('Control+Shift+z')
    seen(lambda: entry(prepared)['clicks'] == dragged)


def test_an_unsure_line_looks_different_and_is_explained(opened, prepared):
    def crossing(document):
        document['photographs'][0]['clicks'] = [*clicks(START)[:2], [187.0, 40.0], *clicks(START)[2:]]
    prepared.change(crossing)
    tab = opened()
    tab.step('DLO')
    tab.find('#drawn .click').first.wait_for()
    assert tab.find('.line.unsure').count() > 1
    assert 'not sure' in tab.find('#player').inner_text()


def test_the_stage_is_busy_until_the_photograph_is_shown(opened, prepared):
    tab = opened()
    held = []
    tab.page.route(PICTURE, lambda route: held.append(route))
    tab.page.reload(wait_until='domcontentloaded')
    tab.step('DLO')
    tab.photograph('Goal')
    assert tab.find('#stage').get_attribute('aria-busy') == 'true'
    for route in held:
        route.continue_()
    tab.page.unroute(PICTURE)
    tab.find('#stage[aria-busy="false"]').wait_for()
    assert tab.find('#pictures img').get_attribute('src').startswith(
        f'api/photographs/{entry(prepared, 1)["id"]}/')


def test_which_strand_is_above_is_asked_at_the_crossing(opened, empty):
    empty.add(drawn(LOOP), 'loop.png')
    empty.change(scaled)
    tab = opened()
    tab.step('DLO')
    tab.clicked(LOOP[[4, 70, 110, 150, 190, 230, -5]])
    answer = tab.button('B (orange)')
    answer.hover()
    tab.find('.strand.second.pointed').first.wait_for()
    answer.click()
    assert seen(lambda: entry(empty)['crossings'])[0]['first_above'] is False
    tab.mark('crossing 0').focus()
    tab.keys('Enter')
    tab.button('A (blue)').click()
    seen(lambda: [answer['first_above'] for answer in entry(empty)['crossings']] == [True])
    tab.find('.bubble').wait_for(state='detached')


def test_the_dlo_is_traced_and_a_hand_moved_by_keys_alone(opened, prepared):
    tab = opened()
    tab.step('DLO')
    tab.find('#stage').focus()
    tab.keys('Enter', *['ArrowRight'] * 3, 'Enter')  # each click is in the middle of the stage
    two = saved_clicks(prepared, 2)
    assert two[1][0] - two[0][0] > 50
    prepared.change(lambda document: [photograph.update(clicks=clicks(line)) for photograph, line in zip(
        document['photographs'], (START, GOAL), strict=True)])
    tab.step('Hands')
    tab.button('Grasp and place').press('Enter')
    tab.mark('grip 0 0').focus()
    tab.keys('Shift+ArrowRight')
    seen(lambda: [step['fraction'] for step in prepared.state()['document']['trials'][0]['steps']]
         == [pytest.approx(0.51)])


def test_the_place_where_a_hand_opened_and_drawn_waypoints_are_marked(opened, prepared):
    def traced(document):
        for photograph, line in zip(document['photographs'], (START, GOAL), strict=True):
            photograph['clicks'] = clicks(line)
    prepared.change(traced)

    def steps():
        return prepared.state()['document']['trials'][0]['steps']

    tab = opened()
    tab.step('Hands')
    tab.button('Drag').click()
    tab.field('opened at a place that I mark').click()
    tab.click((250, 262))
    assert seen(lambda: steps() and steps()[0]['to'] == pytest.approx(table((250, 262)), abs=2e-3))
    tab.field('still holds the DLO').click()
    assert seen(lambda: steps()[0]['hold']) and steps()[0]['to'] is None
    tab.button('Add another movement').click()
    tab.button('Along a drawn path').click()
    tab.photograph('Start')
    tab.click((125, 250))
    tab.mark('way 1 0').wait_for()
    tab.click((187, 262))
    tab.mark('way 1 1').wait_for()
    tab.field('Height of place 2 in mm').fill('30')
    tab.keys('Tab')
    way = seen(lambda: (places := steps()[1]['waypoints']) and places[-1][2] > 0 and places)
    assert np.allclose(way, [[*table((125, 250)), 0], [*table((187, 262)), 0.03]], atol=2e-3)


def test_a_peg_is_clicked_given_a_height_and_removed(opened, prepared):
    def obstacles():
        return prepared.state()['document']['obstacles']

    tab = opened()
    tab.step('Scale')
    tab.find('summary:has-text("Obstacles")').click()
    tab.button('Add a peg').click()
    tab.find('.panel p:has-text("Click the middle of the peg’s top.")').wait_for()
    tab.click((200, 250))
    tab.find('.panel p:has-text("rim")').wait_for()
    tab.click((205, 250))
    peg, = seen(obstacles)
    assert peg['kind'] == 'peg' and peg['first'] == pytest.approx([200, 250], abs=1)
    tab.field('Height of peg 1 in mm').fill('30')
    tab.keys('Tab')
    seen(lambda: obstacles()[0]['height'] == pytest.approx(0.03))
    tab.find('.line.obstacle').nth(1).wait_for()
    assert tab.violations() == []
    tab.photograph('Goal')
    tab.find('.line.obstacle').nth(1).wait_for()  # it stands in that photograph, too
    tab.photograph('Start')
    first = obstacles()[0]['first']
    tab.mark('obstacle 0 0').focus()
    tab.keys('Shift+ArrowRight')
    seen(lambda: obstacles()[0]['first'] == pytest.approx([first[0] + 10, first[1]], abs=0.01))
    tab.button('Remove peg 1').click()
    seen(lambda: not obstacles())
    tab.button('Undo').click()
    seen(obstacles)
    assert tab.overflow() == 0


def test_the_wheel_zooms_under_the_pointer_and_dragging_the_background_moves_it(opened, prepared):
    tab = opened()
    tab.step('DLO')
    x, y = tab.place((125, 94))
    width = tab.find('#pictures img').bounding_box()['width']
    tab.page.mouse.move(x, y)
    tab.page.mouse.wheel(0, -300)
    seen(lambda: tab.find('#pictures img').bounding_box()['width'] > 1.3 * width)
    assert tab.place((125, 94)) == pytest.approx((x, y), abs=1)
    tab.page.mouse.down()
    tab.page.mouse.move(x + 50, y + 20, steps=3)
    tab.page.mouse.up()
    assert tab.place((125, 94)) == pytest.approx((x + 50, y + 20), abs=1)
    assert entry(prepared)['clicks'] == []  # panning is no click


def test_every_step_can_be_read_on_a_dark_telephone(opened, empty):
    whole_trial(empty)
    tab = opened(TELEPHONE, color_scheme='dark', reduced_motion='reduce')
    faults = {}
    for name in STEPS:
        tab.step(name)
        if name != 'Photographs':
            tab.find('#pictures img').wait_for()
        faults[name] = tab.violations(), tab.overflow()
    assert faults == {name: ([], 0) for name in STEPS}


def test_a_long_name_in_a_warning_does_not_widen_the_panel(opened, empty):
    empty.add(drawn(START), 'start.png')
    empty.add(cv2.imencode('.png', np.full((200, 300, 3), 200, np.uint8))[1].tobytes(), 'x' * 60)

    def same_scale(document):
        start, goal = document['photographs']
        start['scale'], goal['scale'] = SCALE, {'kind': 'same', 'photograph': start['id']}
    empty.change(same_scale)
    tab = opened()
    tab.step('Calibrate')
    tab.find(f'.missing li:has-text("{"x" * 60}")').first.wait_for()
    assert tab.overflow() == 0


def test_a_reopened_page_shows_the_project_and_a_second_window_the_newest_state(opened, prepared):
    first = opened()
    first.step('DLO')
    first.clicked(clicks(START)[:2])
    saved_clicks(prepared, 2)
    second = opened()
    second.step('DLO')
    second.mark('click 1').wait_for()
    second.clicked(clicks(START)[2:3])
    first.mark('click 2').wait_for()
    first.find('.notice').wait_for()
    first.clicked(clicks(START)[3:])
    assert len(saved_clicks(prepared, 4)) == 4
    first.page.reload()
    first.step('DLO')
    first.mark('click 3').wait_for()


def test_a_refusal_is_shown_where_it_happened(opened, empty, tmp_path):
    (tmp_path / 'notes.jpg').write_text('no photograph', encoding='utf-8')
    tab = opened()
    tab.find('input[type=file]').first.set_input_files(tmp_path / 'notes.jpg')
    text = tab.find('.drop .problem')
    text.first.wait_for()
    assert 'notes.jpg' in text.first.inner_text()
    assert empty.state()['document']['photographs'] == []


def test_changes_without_connection_are_kept_and_sent_later(opened, prepared):
    tab = opened()
    tab.step('DLO')
    tab.find('#pictures img').wait_for()
    tab.context.set_offline(True)
    tab.click(clicks(START)[0])
    tab.find('.lost').wait_for()
    tab.mark('click 0').wait_for()
    tab.context.set_offline(False)
    assert len(saved_clicks(prepared, 1)) == 1
    seen(lambda: tab.find('.lost').count() == 0)


def test_a_missing_camera_gives_a_sentence(opened, empty):
    tab = opened()
    tab.button('Use this computer’s camera').click()
    tab.find('dialog .problem').wait_for()
    assert tab.button('Take photograph').is_disabled()
    assert tab.violations() == []
    tab.keys('Escape')
    assert not tab.find('dialog').is_visible()


def test_trials_are_compared_with_an_earlier_result(opened, empty, tmp_path):
    whole_trial(empty)
    tab = opened()
    tab.step('Calibrate')
    panel = tab.find('details:has-text("Still the same DLO?")')
    panel.locator('summary').click()
    chooser = panel.locator('input[type=file]')
    chooser.set_input_files(samples() / 'xml' / 'dlo.xml')
    verdict = panel.locator('strong.verdict')
    seen(lambda: verdict.count() and verdict.inner_text() in ('agrees', 'changed', 'cannot tell'))
    assert panel.locator('p').count() > 1
    assert tab.violations() == []
    (tmp_path / 'no.xml').write_text('<dlo/>')
    chooser.set_input_files(tmp_path / 'no.xml')
    seen(lambda: 'no.xml' in panel.inner_text())
