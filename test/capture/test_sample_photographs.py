# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The sample photographs of msg_samples, with clicks made without knowing the truth."""

import json
from pathlib import Path

import numpy as np
from photographed_trials import drafted
import pytest

from dlo_calibration import calibrate, Options
from dlo_calibration.calibration.engines import make_simulator

SAMPLE = Path(__file__).resolve().parents[2] / 'msg_samples/photographs'
CLICKS = json.loads(Path(__file__).with_name('sample_clicks.json').read_text(encoding='utf-8'))
TRUTH = json.loads((SAMPLE / 'truth.json').read_text(encoding='utf-8'))


@pytest.fixture(scope='module')
def drafts(tmp_path_factory):
    """Return the drafts of the sample, and the ids of its photographs."""
    photographs = {name: ((SAMPLE / name).read_bytes(), clicks) for name, clicks in CLICKS.items()}
    opened = [trial['hand'][-1][:2] for trial in TRUTH['trials']]  # at the stickers
    trials = [{'start': 'first.jpg', 'goal': 'second.jpg', 'steps': [
                  {'kind': 'drag', 'fraction': 0.4, 'to': opened[0]}]},
              {'start': 'second.jpg', 'goal': 'third.jpg', 'steps': [
                  {'kind': 'grasp_and_place', 'fraction': 1.0, 'height': 0.1, 'to': opened[1]}]}]
    return drafted(tmp_path_factory.mktemp('sample') / 'project', photographs, trials,
                       {'mass': TRUTH['mass_kg']})


def test_chains_of_the_sample_are_those_of_the_simulated_rope(drafts):
    trials = drafts[0].complete
    assert len(trials) == 2
    chains = [trials[0].initial, trials[0].goals[0].chain, trials[1].goals[0].chain]
    for chain, name in zip(chains, CLICKS, strict=True):
        errors = np.linalg.norm(chain.points - TRUTH['photographs'][name], axis=1)
        assert errors.mean() < 0.001 and errors.max() < 0.0025, name
        assert chain.length == pytest.approx(TRUTH['length_m'], rel=0.005)


@pytest.mark.long
def test_parameters_of_the_sample_lie_in_their_intervals(drafts):
    read, _ = drafts
    options = Options.of({**read.options, 'engine': 'compiled', 'workers': 1, 'evaluations': 80})
    parameters = calibrate(read.complete, options, make_simulator=make_simulator).parameters
    for name in ('flexibility', 'friction'):
        estimate = parameters[name]
        assert estimate.verdict == 'identifiable'
        assert estimate.lower < TRUTH['parameters'][name]['value'] < estimate.upper
        assert estimate.upper - estimate.lower < 10
