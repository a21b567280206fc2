# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The plain values of a result fit JSON, with None for unknown values."""

from dataclasses import replace
import json
import math

import pytest
from toy_messages import toy_trials
from toy_simulator import new_toy

from dlo_calibration import calibrate
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import evaluation_rows, plain, with_nulls


@pytest.fixture(scope='module')
def result():
    """Return the result of the toy for two trials."""
    options = Options.of({'workers': 1, 'evaluations': 20, 'mass': 0.05})
    return calibrate(toy_trials(2), options, make_simulator=new_toy)


def test_json_gives_back_the_same_values(result):
    values = plain(result)
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert values['parameters']['friction']['value'] == result.parameters['friction'].value
    assert (values['score'], values['mean_error_m']) == (result.best.score, result.errors.mean)
    assert set(values['correlations']) == set(result.space.free)


def test_unknown_values_are_none(result):
    unknown = replace(result.examination, noise=math.nan)
    assert plain(replace(result, examination=unknown))['noise_m'] is None
    values = plain(replace(result, examination=None, advice=None))
    for key in ('cross_validated_error_m', 'default_error_m', 'noise_m', 'residual_std_m', 'correlations',
                'advice', 'confirmation'):
        assert values[key] is None
    assert with_nulls({'a': (math.inf, 1.0), 'b': float('nan')}) == {'a': [None, 1.0], 'b': None}


def test_each_evaluation_has_a_row_and_a_failed_one_empty_cells(result):
    failed = replace(result.evaluations[1], scores=(), errors=None, failure='diverged')
    head, rows = evaluation_rows(replace(result, evaluations=(result.evaluations[0], failed)))
    assert all(len(row) == len(head) for row in rows)
    assert rows[0][-2:] == [result.evaluations[0].errors.mean, '']
    assert rows[1][-4:] == ['', '', '', 'diverged']
