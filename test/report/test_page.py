# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The report is a page that shows the result in any browser, and needs no other file."""

import base64
from collections.abc import Mapping
from dataclasses import replace
import functools
import hashlib
from html import escape, unescape
from html.parser import HTMLParser
import math
import os
from pathlib import Path
import re
import shutil
import subprocess

from lxml import etree
import numpy as np
from PIL import Image
import pytest
from toy_messages import toy_trials
from toy_simulator import new_toy

from dlo_calibration import calibrate
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.stages import sliced
from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.digest import file_digests
from dlo_calibration.inference.advice import Advice
from dlo_calibration.model.parameters import interval, measured
from dlo_calibration.report.landscape import convergence_panel
from dlo_calibration.report.page import MOST_TRIALS, Origin, page_of, repeating_command
from dlo_calibration.writing import write_file

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome')
QUIET = ('--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
         '--hide-scrollbars', '--disable-background-networking',
         '--disable-component-update', '--disable-sync')
OPTIONS = Options.of({'workers': 1, 'evaluations': 60, 'seed': 4, 'mass': 0.03})
PATIENCE = 120
WIDTHS = (1280, 390)  # of a desktop and of a phone


@pytest.fixture(scope='module')
def result():
    """Return what the toy finds from three trials, one of which has a name that HTML must not take."""
    first, second, third = toy_trials(3)
    trials = (replace(first, name='<b>first</b> & "only"'), second, third)
    return calibrate(trials, OPTIONS, make_simulator=new_toy)


@pytest.fixture(scope='module')
def slices(result):
    """Return the slices through what was found."""
    return sliced(result, Options(), new_toy)


def written(folder, result, origin=None, slices=None):
    """Write the page of a result and return its text."""
    path = folder / 'report.html'
    write_file(path, page_of(result, origin or Origin('s', 'a command', OPTIONS), slices))
    return path.read_text(encoding='utf-8')


@pytest.fixture(scope='module')
def drawn(tmp_path_factory, result, slices):
    """Return the page with all its drawings."""
    return written(tmp_path_factory.mktemp('drawn'), result, slices=slices)


@pytest.fixture
def page(tmp_path, without_drawings):
    """Give a function that writes the page of a result without drawings and returns its text."""
    return functools.partial(written, tmp_path)


class Outline(HTMLParser):
    """What a page consists of: its text, headings, cells, drawings, and what it refers to."""

    def __init__(self, page):
        super().__init__()
        self.text, self.headings, self.references, self.drawings, self.open = [], [], [], {}, []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == 'img':
            self.drawings[attributes['alt']] = attributes['src']
            self.text.append(attributes['alt'])
        else:
            self.references += [attributes[name] for name in ('src', 'href') if name in attributes]
        if tag not in ('meta', 'br', 'img'):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f'</{tag}> closes nothing'

    def handle_data(self, text):
        if 'style' not in self.open:
            self.text.append(text)
            if self.open and re.fullmatch('h[1-6]', self.open[-1]):
                self.headings.append((self.open[-1], text))


def words(page):
    return ' '.join(' '.join(Outline(page).text).split())


def test_every_element_is_closed_and_every_drawing_explained(result, drawn):
    outline = Outline(drawn)
    assert outline.open == []
    assert [text for tag, text in outline.headings if tag == 'h1'] == ['Calibration of s']
    assert len(outline.drawings) > 4 * len(result.trials)  # each has words of its own
    assert all(len(words) > 20 for words in outline.drawings)


def test_drawings_are_images_that_stand_alone_and_do_not_change(result, drawn, tmp_path):
    drawings = Outline(drawn).drawings
    for source in drawings.values():
        kind, _, octets = source.partition(';base64,')
        root = etree.fromstring(base64.b64decode(octets))
        assert (kind, etree.QName(root).localname) == ('data:image/svg+xml', 'svg')
        links = root.xpath('//@*[local-name() = "href"]')
        # Bars of colours are PNG images.
        inside = [link[1:] for link in links if not link.startswith('data:image/png')]
        assert inside and all(root.xpath('//*[@id=$id]', id=link) for link in inside)
    assert Outline(written(tmp_path, result)).drawings.items() <= drawings.items()


def test_the_page_needs_no_other_file(drawn):
    ids = set(re.findall(' id="([^"]+)"', drawn))
    for reference in Outline(drawn).references:
        assert reference.startswith('#') and reference[1:] in ids
    assert 'url(' not in drawn and '@import' not in drawn and '<script' not in drawn
    assert len(drawn) < 3e6


def test_names_are_text_not_html(result, page):
    text = page(result)
    assert '<b>first' not in text
    assert '<b>first</b> & "only"' in words(text)


def test_the_page_gives_values_in_units(result, page):
    text = words(page(result))
    for name, estimate in result.parameters.items():
        assert f'{name} is known well' in text or f'{name} is known only roughly' in text \
            or f'{name} could not be determined' in text
        assert interval(estimate.lower, estimate.upper, '1') in text
    assert measured(result.errors.mean, 'm') in text


def test_the_page_advises_an_action(result, page):
    advice = Advice('drag', 'drag the middle', 'friction', 0.2, 0.05, 0.3, 0.5)
    text = words(page(replace(result, advice=advice)))
    assert 'To know friction better, drag the middle' in text
    assert 'from 20 to 5.' in text


def test_warnings_of_result_and_session_are_shown(result, page):
    text = words(page(replace(result, warnings=('it never rested',)),
                      Origin('s', 'c', OPTIONS, warnings=('a message was lost',))))
    assert 'Warnings' in text
    assert 'it never rested' in text
    assert 'a message was lost' in text


def test_unknown_numbers_are_not_shown(result, page):
    unknown = replace(result.examination, cross_validated=math.nan, noise=math.nan, default_error=math.nan)
    for examination in (None, unknown):
        assert not re.search(r'\b(nan|inf)\b', page(replace(result, examination=examination)))


def test_search_shows_what_failed(result):
    """Legends name only what is drawn."""
    def searched(**changes):
        evaluations = [replace(evaluation, scores=(9.0,) * 3, skipped=0, failure='')
                       for evaluation in result.evaluations]
        evaluations[1] = replace(evaluations[1], **changes)
        shown = convergence_panel(replace(result, evaluations=tuple(evaluations)))
        return shown.words, base64.b64decode(shown.source.partition(',')[2]).decode()

    assert not any('could not be simulated' in text for text in searched())
    assert all('could not be simulated' in text for text in searched(scores=(), failure='diverged'))


def test_slices_are_drawn_or_reported_as_missing(result, page, drawn):
    without = page(result)
    assert 'Left out' in without
    assert 'Along flexibility' in drawn
    assert 'Left out' not in drawn


def test_of_many_trials_the_worst_are_drawn(page):
    trials = toy_trials(MOST_TRIALS + 3)
    result = calibrate(trials, replace(OPTIONS, evaluations=5), make_simulator=new_toy)
    text = page(result)
    assert text.count('seen from above') == MOST_TRIALS
    for trial in trials:
        assert trial.name in text


def test_command_and_options_that_repeat_it(result, page, tmp_path):
    (tmp_path / 'session.mcap').write_bytes(b'what was heard')
    command = repeating_command('session.mcap', OPTIONS)
    assert command == 'dlo-calibration fit session.mcap --mass 0.03 --evaluations 60 --seed 4'
    text = page(result, Origin('s', command, OPTIONS, file_digests([tmp_path / 'session.mcap'])))
    assert command in unescape(text)
    assert hashlib.sha256(b'what was heard').hexdigest() in text
    assert f'numpy {np.__version__}' in words(text)
    assert 'settle_limit' in text


def test_page_that_cannot_be_written_is_an_input_error(result, tmp_path, without_drawings):
    with pytest.raises(InputError, match='choose another place'):
        write_file(tmp_path / 'none' / 'report.html', 'the page')


@pytest.fixture(scope='module')
def browse(tmp_path_factory):
    """Give a function that calls a browser with a profile of its own, and returns what it prints."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        missing = pytest.fail if os.environ.get('CI') else pytest.skip
        missing(f'none of {", ".join(BROWSERS)} is installed')
    profile = tmp_path_factory.mktemp('profile')

    def browse(*arguments):
        done = subprocess.run([browser, *QUIET, f'--user-data-dir={profile}', *map(str, arguments)],
                              capture_output=True, text=True, timeout=PATIENCE)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return browse


def framed(page: str, sizes: Mapping[int, int]) -> str:
    """
    Return a page that shows another one in frames side by side, and measures it in each.

    A frame, because no window is narrower than 500.

    :param sizes: height of the frame of each width.
    """
    measure = ("let seen = this.contentDocument.documentElement; document.body.append("
               "'measured in ' + this.width + ': ' + seen.scrollWidth + ' ' + seen.scrollHeight + '; ');"
               "for (let one of seen.querySelectorAll('.good, .weak, .bad')) document.body.append("
               "'verdict in ' + this.width + ': ' + Math.ceil(one.getBoundingClientRect().right) + '; ')")
    frames = (f'<iframe style="border:0; vertical-align:top" width="{width}" height="{height}" '
              f'onload="{measure}" srcdoc="{escape(page)}"></iframe>' for width, height in sizes.items())
    return f'<!DOCTYPE html><body style="margin:0; white-space:nowrap">{"".join(frames)}</body>'


def needed(document: str, width: int) -> tuple[int, int]:
    """Return the width and the height that a page needs in a frame, from the document with that frame."""
    across, down = re.search(rf'measured in {width}: (\d+) (\d+);', document).groups()
    return int(across), int(down)


@pytest.mark.long
def test_browser_shows_it_without_scrolling_sideways(drawn, browse, tmp_path):
    frame, shot = tmp_path / 'frame.html', tmp_path / 'shot.png'
    frame.write_text(framed(drawn, dict.fromkeys(WIDTHS, 1000)), encoding='utf-8')
    document = browse('--dump-dom', frame.as_uri())
    heights = {}
    for width in WIDTHS:
        across, heights[width] = needed(document, width)
        assert across <= width
        assert heights[width] > 3000
        verdicts = [int(right) for right in re.findall(rf'verdict in {width}: (\d+);', document)]
        assert len(verdicts) >= 4
        assert max(verdicts) <= width  # no verdict must be scrolled to
    frame.write_text(framed(drawn, heights), encoding='utf-8')
    browse(f'--screenshot={shot}', f'--window-size={sum(WIDTHS)},{max(heights.values())}', frame.as_uri())
    whole, begin = np.asarray(Image.open(shot).convert('L')), 0
    for width, down in heights.items():
        seen, begin = whole[:down, begin:begin + width], begin + width
        assert (seen[:, :4] > 250).all() and (seen[:, -2:] > 250).all()  # nothing is cut off at the sides
        for part in np.array_split(seen, down // 1000):
            assert (part < 128).mean() > 0.002  # there is something to read everywhere


def test_the_measurement_of_width_detects_wide_elements(browse, tmp_path):
    frame = tmp_path / 'frame.html'
    frame.write_text(framed('<div style="width:700px">wide</div>', {390: 500}), encoding='utf-8')
    assert needed(browse('--dump-dom', Path(frame).as_uri()), 390)[0] >= 700
