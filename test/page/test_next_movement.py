# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The next movement on the capture page: in words, and as an arrow over the newest photograph."""

from browser import browser, Tab
from capture_page import (
    described,
    drawn,
    GOAL,
    PER_METRE,
    served,
    SIZE,
    START,
    table,
    ToyInformation,
    whole_trial,
)
import numpy as np
import pytest

from dlo_calibration import Action, Hand
from dlo_calibration.page import information
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.workspace.next_action import NextAction

pytestmark = pytest.mark.usefixtures('without_drawings')

FROM, TO = GOAL[-1], GOAL[-1] + (-60.0, -90.0)  # px
NOTHING = np.full(2, 0.1)
WORDS = 'grip the last end, lift it by 10 cm and carry it by 17 cm, then put it down'


def carried():
    """Return the advice to carry the last end from one pixel to another."""
    (x, y), (u, v) = table(FROM), table(TO)
    way = Hand('hand_1', (20,), np.arange(4.0), [[x, y, 0.0], [x, y, 0.1], [u, v, 0.1], [u, v, 0.0]])
    return NextAction(('flexibility', 'friction'), NOTHING, NOTHING, NOTHING, Action((way,)),
                      f'hand_1: {WORDS}', trials=2)


@pytest.fixture
def page(tmp_path, monkeypatch):
    """Give a page whose appraiser knows at once what to do next."""
    monkeypatch.setattr(information, 'LiveInformation', ToyInformation)
    monkeypatch.setattr(ToyInformation, 'advice', carried())
    with served(tmp_path / 'project', '--calibrate', 'flexibility', 'friction', appraising=True) as client:
        yield client


def test_the_way_is_projected_into_the_goal_photograph_of_the_last_trial(page):
    goal = whole_trial(page)['document']['trials'][0]['goal']
    advice = page.until(lambda state: state['advice'], 'the advice')['advice']
    assert advice['view'] == goal
    assert advice['words'] == f'{WORDS[0].upper()}{WORDS[1:]}'
    way, = advice['ways']
    assert way[0] == pytest.approx(FROM, abs=1.0)
    assert way[-1] == pytest.approx(TO, abs=1.0)
    assert len(way) == 2  # lifting does not move it along the table


def test_an_incomplete_trial_takes_the_advice_away(page):
    whole_trial(page)
    page.until(lambda state: state['advice'], 'the advice')
    state = page.change(lambda document: document['trials'][0].update(steps=[]))
    assert state['advice'] is None


@pytest.mark.long
def test_a_person_sees_the_arrow_after_each_pair_of_photographs(page):
    with browser() as started:
        tab = Tab(started, page.address)
        for line, name in ((START, 'start.png'), (GOAL, 'goal.png')):
            page.add(drawn(line), name)
        page.change(described)
        tab.step('Photographs')
        tab.find('.advice').get_by_text('Grip the last end').wait_for()
        tab.button('Show it on the newest picture').click()
        tab.find('#stage[aria-label*="goal of trial 1"]').wait_for()
        head = tab.find('#drawn .head path')
        head.wait_for()
        box, (u, v) = head.bounding_box(), tab.place(TO)
        assert box['x'] - 6 <= u <= box['x'] + box['width'] + 6
        assert box['y'] - 6 <= v <= box['y'] + box['height'] + 6
        turned = float(head.get_attribute('transform').removeprefix('rotate(').removesuffix(')'))
        assert turned == pytest.approx(np.degrees(np.arctan2(*(TO - FROM)[::-1])), abs=1.0)
        assert tab.find('#drawn .advised').count() == 1
        assert tab.find('#drawn .playing').count() == 1
        tab.photograph('Start')
        assert head.count() == 0
        assert tab.violations() == []
        assert tab.complaints == []


@pytest.mark.long
def test_what_is_advised_can_be_done_where_the_photograph_shows_the_table(tmp_path):
    with served(tmp_path, '--calibrate', 'flexibility', 'friction', simulator=CompiledSimulator,
                appraising=True) as page:
        whole_trial(page)
        advice = page.until(lambda state: state['advice'], 'the advice')['advice']
    way, = map(np.array, advice['ways'])
    assert (way > -1).all() and (way < SIZE).all()
    assert np.linalg.norm(GOAL - way[0], axis=1).min() < 0.02 * PER_METRE
    assert np.linalg.norm(way[-1] - way[0]) > 0.03 * PER_METRE
    assert advice['words'].startswith('Grip ')
