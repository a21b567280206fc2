# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Films of trials with the default and the found parameters beside each other, for report and `plot`."""

from dataclasses import replace
import re

from lxml import etree
import numpy as np
import pytest
from toy_messages import session_messages, toy_trials, write_session
from toy_simulator import new_toy, ToySimulator

from dlo_calibration import calibrate, Options
from dlo_calibration.cli import main as cli
from dlo_calibration.files.result import write_result
from dlo_calibration.messages.codec import bag_types
from dlo_calibration.report.before_after import films, svg_of
from dlo_calibration.report.page import Origin, page_of

OPTIONS = Options.of({'workers': 1, 'evaluations': 60, 'mass': 0.03})
SVG = '{http://www.w3.org/2000/svg}'


@pytest.fixture(scope='module')
def result():
    """Return what the toy finds; a trial has a name that SVG and HTML must not take."""
    first, second = toy_trials(2)
    return calibrate((replace(first, name='<b>"one"</b>'), second), OPTIONS, make_simulator=new_toy)


def lines(svg):
    """Return the moving lines of a film: the (k, n, 2) places [px] of each."""
    return [np.array([[list(map(float, pixel.split(','))) for pixel in chain.split()]
                      for chain in animate.get('values').split(';')])
            for animate in svg.iter(f'{SVG}animate')]


def test_the_found_parameters_end_at_the_measured_goal_and_the_default_ones_do_not(result):
    panel = films(result, [0, 1], OPTIONS, new_toy)[0]
    svg = etree.fromstring(svg_of(panel))
    dots = np.array([[float(dot.get(name)) for name in ('cx', 'cy')] for dot in svg.iter(f'{SVG}circle')])
    moving = lines(svg)
    assert len(moving) == 4  # two columns, each from above and from the side
    goals = dots.reshape(4, -1, 2)
    apart = [np.linalg.norm(line[-1] - goal, axis=1).mean()
             for line, goal in zip(moving, goals, strict=True)]
    assert max(apart[2:]) < 1
    assert max(apart[:2]) > 3 * max(apart[2:])
    assert max(apart[:2]) > 3
    assert re.search(r'left with default parameters: [\d.]+ mm .*right with found parameters', panel.words)


def test_times_increase_and_the_end_is_held(result):
    svg = etree.fromstring(svg_of(films(result, [1], OPTIONS, new_toy)[1]))
    for animate in svg.iter(f'{SVG}animate', f'{SVG}animateTransform'):
        times = list(map(float, animate.get('keyTimes').split(';')))
        values = animate.get('values').split(';')
        assert len(times) == len(values)
        assert times[0] == 0
        assert times[-1] == 1
        assert times == sorted(times)
        assert values[-1] == values[-2]


def test_the_report_shows_the_films(result, without_drawings):
    page = page_of(result, Origin('s', 'a command', OPTIONS), None, films(result, [0, 1], OPTIONS, new_toy))
    assert page.count('class="film"') == 2
    assert '<b>"one"</b>' not in page


def test_a_trial_that_the_defaults_cannot_simulate_has_no_film(result):
    assert films(result, [0], OPTIONS, lambda _: ToySimulator(fail_below=45.0)) == {}


@pytest.mark.long
def test_plot_writes_the_films(result, tmp_path, without_drawings, capsys):
    session = write_session(tmp_path / 'session.mcap', session_messages(bag_types(), 2))
    write_result(tmp_path / 'result.xml', result, OPTIONS.flat())
    words = ['plot', str(session), str(tmp_path / 'result.xml'), '--output', str(tmp_path)]
    assert cli.main(words, new_toy) == 0
    assert len(lines(etree.parse(tmp_path / 'trial_2.svg').getroot())) == 4
