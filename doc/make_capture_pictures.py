# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Make the pictures of capture.md: the capture page in use with the sample photographs.

    python doc/make_capture_pictures.py [FOLDER]

It needs Playwright's Python package and a Chromium, and takes some two minutes.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
import sys
import tempfile
import time
from typing import Sequence

import numpy as np
from PIL import Image

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / 'test' / 'support'))

from browser import browser, Tab  # noqa: E402
from capture_page import page_process  # noqa: E402

SAMPLE = HERE.parent / 'msg_samples/photographs'
CLICKS = json.loads((HERE.parent / 'test/capture/sample_clicks.json').read_text(encoding='utf-8'))
TRUTH = json.loads((SAMPLE / 'truth.json').read_text(encoding='utf-8'))
STICKERS = ((846, 809), (1478, 234))  # px, where the hand opened in second.jpg and third.jpg
COLOURS, MOST = 128, 120  # of a picture, and px of each that count; the table's grain takes the most room
DRAWN = 1.5  # s, for drawing everything


def save(folder: Path, name: str, png: bytes) -> None:
    """Write a screenshot as a small PNG."""
    picture = Image.open(io.BytesIO(png)).convert('RGB')
    rounded = np.minimum((np.asarray(picture).astype(int) + 4) // 8 * 8, 255)
    # Large areas of similar colours do not take the places of small marks in the palette.
    colours, counts = np.unique(rounded.reshape(-1, 3), axis=0, return_counts=True)
    shares = np.repeat(colours, np.minimum(counts, MOST), axis=0).astype(np.uint8)
    palette = Image.fromarray(shares[None]).quantize(COLOURS, Image.Quantize.MEDIANCUT)
    picture.quantize(palette=palette, dither=Image.Dither.NONE).save(folder / f'{name}.png', optimize=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the pictures."""
    given = sys.argv[1:] if arguments is None else arguments
    folder = Path(given[0]) if given else HERE
    with tempfile.TemporaryDirectory() as project, browser() as chromium, \
            page_process(Path(project) / 'rope', program=('-m', 'dlo_calibration')) as (server, _):
        tab = Tab(chromium, server.address, color_scheme='light', reduced_motion='reduce')
        take_pictures(tab, folder)
        tab.close()
    return 0


def take_pictures(tab: Tab, folder: Path) -> None:
    """Go through the steps of the page, and take a picture of each."""
    def picture(name: str) -> None:
        time.sleep(DRAWN)
        save(folder, name, tab.page.screenshot())

    tab.find('input[type=file]').first.set_input_files([SAMPLE / name for name in CLICKS])
    tab.find('.photographs li').nth(2).wait_for()
    picture('capture_photographs')
    tab.step('Scale')
    tab.field('The printed board lies in it').click()
    tab.button('The board lies in all photographs').click()
    tab.find('.line.grid').first.wait_for()
    picture('capture_scale')
    tab.step('DLO')
    tab.field('Mass').fill(str(1e3 * TRUTH['mass_kg']))
    for trial, role, name in ((1, 'Start', 'first.jpg'), (1, 'Goal', 'second.jpg'), (2, 'Goal', 'third.jpg')):
        show(tab, trial, role)
        tab.clicked(CLICKS[name])
        tab.find('.line.sure').first.wait_for()
    show(tab, 1, 'Goal')
    picture('capture_dlo')
    tab.step('Hands')
    show(tab, 1, 'Start')
    tab.button('Drag').click()
    typed(tab, 'Gripped point', 40)
    tab.field('opened at a place that I mark').click()
    tab.click(STICKERS[0])
    show(tab, 2, 'Start')
    tab.button('Grasp and place').click()
    typed(tab, 'Gripped point', 100)
    typed(tab, 'Height of the lift', 100)
    tab.field('opened at a place that I mark').click()
    tab.click(STICKERS[1])
    tab.find('.line.way').first.wait_for()
    picture('capture_hands')
    tab.step('Calibrate')
    tab.find('.shows').nth(1).wait_for()
    picture('capture_information')
    tab.button('Calibrate').last.click()
    tab.find('table.result').wait_for()
    tab.find('.line.simulated').first.wait_for()
    show(tab, 2, 'Goal')
    picture('capture_result')
    save(folder, 'capture', tab.find('#pictures').screenshot())


def show(tab: Tab, trial: int, role: str) -> None:
    """Go to a photograph of a trial."""
    tab.find(f'#strip button[aria-label^="{role} of trial {trial}"]').click()
    tab.find(f'#stage[aria-label*="{role.lower()} of trial {trial}"]').wait_for()


def typed(tab: Tab, label: str, value: float) -> None:
    """Type a number into a field."""
    tab.field(label).first.fill(str(value))
    tab.keys('Tab')


if __name__ == '__main__':
    sys.exit(main())
