# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The tables of an experiment, as Markdown, CSV and a picture."""

import csv
from dataclasses import replace
from io import StringIO

from experiment_outcomes import outcomes
import numpy as np
from PIL import Image
import pytest

from dlo_calibration.errors import InputError
from dlo_calibration.experiment.summary import summary
from dlo_calibration.experiment.tables import (
    Account,
    consistency_csv,
    document,
    markdown,
    runs_csv,
    scatter_picture,
    validity_csv,
)
from dlo_calibration.model.parameters import knot_names

DONE = [*outcomes(1, 60.0, (10.0, 50.0)), *outcomes(2, 70.0, (40.0, 80.0)), *outcomes(3, 80.0, (20.0, 40.0))]
FINDINGS = summary(DONE)
ACCOUNT = Account((FINDINGS,), 'the command', 'toy', 3, {'random': 150}, samples=False, complete=True)


def cells(text, first):
    """Return the rows of a Markdown table that begin with a cell."""
    rows = [[cell.strip() for cell in line.strip('|').split('|')]
            for line in text.splitlines() if line.startswith('|')]
    return [row for row in rows if row[0] == first]


def table(text):
    return list(csv.DictReader(StringIO(text)))


def test_consistency_has_an_average_and_a_deviation_for_each_parameter():
    text = markdown(ACCOUNT)
    average, *_ = cells(text, 'rope')
    assert average == ['rope', 'average', '70', '*25*']  # no trial shows its elasticity
    assert cells(text, '')[0] == ['', 'standard deviation', '10', '*0*']


def test_components_of_a_rest_shape_are_in_the_csv_only():
    spread = FINDINGS.parameters['friction']
    names = knot_names(9)
    bent = replace(FINDINGS, parameters={**FINDINGS.parameters, **dict.fromkeys(names, spread)},
                   informed={**FINDINGS.informed, **dict.fromkeys(names, 3)})
    account = replace(ACCOUNT, findings=(bent,))
    text = markdown(account)
    assert 'components of rest shapes are in `consistency.csv`' in text
    assert 'rest_curvature' not in text
    assert {row['parameter'] for row in table(consistency_csv(account))} >= set(names)


def test_a_table_says_in_how_many_runs_a_parameter_was_excited():
    some = replace(FINDINGS, informed={'friction': 3, 'elasticity': 1})
    average, *_ = cells(markdown(replace(ACCOUNT, findings=(some,))), 'rope')
    assert average[3] == '25 *(in 1 of 3 runs)*'


def test_validity_has_score_and_error_and_marks_the_very_similar():
    text = markdown(ACCOUNT)
    _, row, actions = cells(text, 'rope')
    assert row == ['rope', 'random', '**40**', '17.3', '2 of 3 runs', '80', '40 mm', '17.3 mm', '4', '2 mm',
                   '102', '1']
    assert actions == ['rope', 'random', '23.3 ± 15.3', '56.7 ± 20.8']
    worse = replace(FINDINGS, score=replace(FINDINGS.score, mean=50.0))
    assert cells(markdown(replace(ACCOUNT, findings=(worse,))), 'rope')[1][2] == '50'
    assert 'Not complete' not in text
    assert 'the command' in text


def test_the_papers_figures_stand_beside_the_samples_only():
    fifth = replace(FINDINGS, subject='object5')
    account = replace(ACCOUNT, findings=(replace(FINDINGS, subject='object1'), fifth), samples=True)
    text = markdown(account)
    assert cells(text, 'object5')[1][-1] == '53.39 ± 1.12'
    assert cells(text, 'object1')[1][-1] == '24.96 ± 1.33'
    assert cells(text, '')[:3] == [
        ['', 'standard deviation', '10', '*0*'], ['', 'average in the paper', '33.85', '49.55'],
        ['', 'standard deviation in the paper', '20.02', '13.88']]
    assert document(account)['paper']['consistency']['object4']['elasticity'] == [88.55, 1.5]
    text = markdown(replace(account, samples=False))
    assert 'paper' not in text
    assert document(replace(account, samples=False))['paper'] is None


def test_failures_and_missing_runs_are_reported():
    failed = replace(FINDINGS, failures=4)
    text = markdown(replace(ACCOUNT, findings=(failed,), complete=False))
    assert cells(text, 'rope')[1][-1] == '4'
    assert 'Not complete' in text


def test_csv_files_have_the_same_numbers():
    friction, elasticity = table(consistency_csv(ACCOUNT))
    assert friction['parameter'] == 'friction'
    assert (float(friction['mean']), float(friction['std'])) == (70.0, 10.0)
    assert elasticity['runs_that_told_anything'] == '0'
    whole, first, second = table(validity_csv(ACCOUNT))
    assert (whole['action'], float(whole['score_mean_cm'])) == ('all', pytest.approx(40.0))
    assert (first['action'], second['action']) == ('trial 1', 'trial 2')
    assert float(second['score_mean_cm']) == pytest.approx(170 / 3)
    rows = table(runs_csv(DONE))
    assert [row['left_out_trial'] for row in rows] == ['', '1', '2'] * 3
    assert [float(row['friction']) for row in rows[::3]] == [60.0, 70.0, 80.0]
    assert rows[1]['held_back_scores_cm'] == '10.0'


def test_the_scatter_shows_excited_parameters_in_colour(tmp_path):
    scatter_picture([DONE], tmp_path / 'a.png')
    nothing = [(task, replace(outcome, excited=())) for task, outcome in DONE]
    scatter_picture([nothing], tmp_path / 'b.png')

    def blue(path):
        image = np.asarray(Image.open(path).convert('RGB')).astype(int)
        return (np.abs(image - (31, 119, 180)).sum(axis=2) < 90).sum()

    assert blue(tmp_path / 'a.png') > 2 * blue(tmp_path / 'b.png') > 0  # the legend has one, too


def test_a_picture_that_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(InputError, match='choose another place'):
        scatter_picture([DONE], tmp_path / 'nowhere' / 'a.png')
