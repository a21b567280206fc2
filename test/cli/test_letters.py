# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The example that lays ropes into letters: the ropes can hold them, and they are drawn."""

from pathlib import Path
import sys

import numpy as np
from PIL import Image, ImageColor
from plan_executions import Belief, TRUE
import pytest
from reality import KNOWN_DLOS, laid, POINTS

from dlo_calibration import Chain, Options
from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.model.named_actions import GraspAndPlace

EXAMPLES = Path(__file__).resolve().parents[2] / 'examples'


@pytest.fixture
def examples(monkeypatch):
    """Give the modules of the example."""
    monkeypatch.syspath_prepend(EXAMPLES)
    import letters
    import letters_drawing
    yield letters, letters_drawing
    for name in ('letters', 'letters_drawing'):
        del sys.modules[name]


def whole_chain(points, dlo):
    chain = Chain(np.column_stack([points, np.full(len(points), dlo.radius)]))
    return chain.resample(np.linspace(0, chain.length, POINTS))


def away(points, goal):
    return float(np.linalg.norm(points - goal, axis=1).mean())


def test_ropes_hold_the_letters_for_which_the_strokes_are_too_sharp(examples):
    letters, _ = examples
    with_true = make_simulator(Options()).refined()
    sprung = []
    for name, corners in letters.LETTERS.values():
        dlo, = (dlo for dlo in KNOWN_DLOS if dlo.name == name)
        stroke = letters.stroke(corners, dlo.length)
        held = letters.held(stroke, Belief.certain(TRUE, dlo))
        assert away(held, stroke) < 0.01 * dlo.length  # it still is that letter
        goal, sharp = whole_chain(held, dlo), whole_chain(stroke, dlo)
        assert away(laid(dlo, goal, with_true), goal) < 0.001 * dlo.length
        sprung.append(away(laid(dlo, sharp, with_true), sharp) / dlo.length)
    assert max(sprung) > 0.005


@pytest.mark.long
def test_the_picture_and_the_film_show_all_ropes(examples, tmp_path, monkeypatch):
    letters, drawing = examples
    for name, fewer in (('STILL', 2), ('EVERY', 20), ('PRINTED', 80)):
        monkeypatch.setattr(drawing, name, fewer)
    start = np.column_stack([np.linspace(0, 0.6, 21), np.zeros(21), np.full(21, 0.004)])
    chains = np.stack([start, start + (0, 0.05, 0), start + (0, 0.1, 0)])
    actions = tuple(GraspAndPlace(start=0.0, point=0, to=(0, 0.1, 0.004)).action(Chain(points))
                    for points in chains[:-1])
    frames = []
    for letter, dlo, count in zip('DLO', KNOWN_DLOS, (2, 1, 2), strict=False):  # one is laid earlier
        frames.append(letters.Laid(letter, dlo, chains[-1], chains[:count + 1], (17.0, 8.0, 0.5)[:count + 1],
                                  actions[:count], (chains[[0] * 30], chains[[1] * 30])[:count]))
    drawing.draw_letters(frames, tmp_path / 'letters.png')
    drawing.draw_film(frames, tmp_path / 'letters.gif')
    with Image.open(tmp_path / 'letters.png') as picture, Image.open(tmp_path / 'letters.gif') as film:
        assert film.n_frames > 4
        for image in (picture, film):
            pixels = np.asarray(image.convert('RGB')).astype(int)
            for colour in drawing.COLOURS:
                assert (np.abs(pixels - ImageColor.getrgb(colour)).sum(axis=2) < 40).sum() > 50
