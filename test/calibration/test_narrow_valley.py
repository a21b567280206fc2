# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""A search in a narrow, curved valley: of two trials that tell flexibility and friction together only."""

import json
from pathlib import Path

import numpy as np
import pytest

from dlo_calibration import Action, calibrate, Chain, Goal, Hand, Options, Trial

TRUTH = {'flexibility': 61.9, 'friction': 60.0}


def trials():
    """Return what a robot did with a rope of known properties, simulated finely and seen with noise."""
    for k, seen in enumerate(json.loads(Path(__file__).with_name('narrow_valley.json').read_text('utf-8'))):
        initial, waiting, resting = (Chain(np.array(points, float)) for points in
                                     (seen['initial'], *seen['goals']))
        hand = Hand('hand', (seen['grip'],), seen['times'], seen['positions'], offset=seen['offset'],
                    nearest=True)
        first, last = seen['goal_times']
        yield Trial(f'trial {k + 1}', initial, (Action((hand,)),),
                    (Goal(waiting, first, stable=False), Goal(resting, last)))


@pytest.mark.long
@pytest.mark.parametrize('seed', [1, 3])
def test_a_search_that_noise_does_not_explain_is_followed_by_another(seed):
    found = calibrate(list(trials()), Options(engine='compiled', seed=seed)).parameters
    for name, width in (('flexibility', 1.4), ('friction', 3.0)):
        assert found[name].value == pytest.approx(TRUTH[name], abs=width)
