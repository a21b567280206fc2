# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures and sentences of predictions show the chains, the bands and what the hands do."""

from dataclasses import replace

from made_up_dlo import MadeUpDlo, straight
import numpy as np
from PIL import Image, ImageColor
import pytest

from dlo_calibration.model.named_actions import Drag, GraspAndPlace, LiftAndHold, Release
from dlo_calibration.planning.prediction import simulate
from dlo_calibration.report.figure import BAND, SIMULATED
from dlo_calibration.report.plan_drawing import write_prediction_picture
from dlo_calibration.report.sentences import prediction_sentences, width


@pytest.fixture(scope='module')
def prediction():
    return simulate(MadeUpDlo(error=0.01), straight(), [
        GraspAndPlace(point=0, to=(0.1, 0.2, 0.004)), LiftAndHold(point=20), Release()], draws=1)


def picture(prediction, folder, name='trial 1'):
    write_prediction_picture(prediction, name, folder / 'one.png')
    return np.asarray(Image.open(folder / 'one.png').convert('RGB')).astype(int)


def count(image, colour):
    """Count the pixels of a colour."""
    return int((np.abs(image - ImageColor.getrgb(colour)).sum(axis=2) < 20).sum())


def test_chains_and_bands_are_drawn(prediction, tmp_path):
    step = prediction.steps[0]
    thin = replace(step, lower=step.chain - 1e-6, upper=step.chain + 1e-6)
    with_band, without = (picture(replace(prediction, steps=(one,)), tmp_path) for one in (step, thin))
    assert count(with_band[-60:], BAND) > 50  # the legend explains it
    assert count(with_band, SIMULATED) > 500
    assert count(with_band, BAND) > 3 * count(without, BAND)


@pytest.mark.long
def test_of_many_actions_five_are_shown(prediction, tmp_path):
    many = replace(prediction, steps=prediction.steps[:1] * 40)
    one = replace(prediction, steps=prediction.steps[:1])
    assert picture(many, tmp_path).shape[0] < 5 * picture(one, tmp_path).shape[0]


def test_a_trial_name_can_be_any_text(prediction, tmp_path):
    one = replace(prediction, steps=prediction.steps[:1])
    assert picture(one, tmp_path, '$_{\n_').std() > 10


def test_sentences_mention_a_dlo_that_does_not_come_to_rest_and_warnings(prediction):
    restless = replace(prediction, warnings=('a remark',),
                       steps=(replace(prediction.steps[0], settled=False),))
    sentence, remark = prediction_sentences(restless)
    assert '; the DLO did not come to rest. It bends to a radius of ' in sentence and remark == 'a remark'
    assert f'the 90 % intervals are {width(prediction.steps[0])} wide on average' in sentence


def test_a_hand_that_stays_on_the_table_lifts_nothing():
    drag = simulate(MadeUpDlo(), straight(), [Drag(point=5, direction=(0, 1, 0), distance=0.1)], draws=0)
    sentence, = prediction_sentences(drag)
    assert 'left_hand grips at 0.25 of the length, moves it to (0.150, 0.100, 0.004) m and opens' in sentence
