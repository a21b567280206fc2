# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Trials with larger errors than the others, which the uncertainty of the parameters explains or not."""

from dataclasses import replace

from carried_trials import EVEN, observed, TRUTH
import numpy as np
import pytest

from dlo_calibration.calibration.calibrate import fitted
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.model.chain import Chain
from dlo_calibration.simulation.compiled import CompiledSimulator
from dlo_calibration.workspace.validation import validated, with_large_errors

OPTIONS = Options(calibrate=EVEN.free, engine='compiled', table=False, parts=1)


def make_simulator(options):
    return CompiledSimulator(table=options.table, nodes=21)


@pytest.fixture(scope='module')
def calibration():
    trials = tuple(observed(EVEN, TRUTH))
    return trials, fitted(Setting(trials, OPTIONS, make_simulator(OPTIONS)))


def warnings(trials, file):
    return with_large_errors(validated(file, trials, OPTIONS, make_simulator), file, OPTIONS,
                             make_simulator).warnings


def shifted(trials, by):
    """Return the trials, in the second of which all goal chains were seen elsewhere, by (3,) [m]."""
    first, second, *others = trials
    goals = tuple(replace(goal, chain=Chain(goal.chain.points + by)) for goal in second.goals)
    return (first, replace(second, goals=goals), *others)


def test_no_trial_is_named_where_all_have_the_same_error(calibration):
    assert warnings(*calibration) == ()


def test_a_trial_that_the_parameters_do_not_explain_is_named(calibration):
    trials, file = calibration
    words, = warnings(shifted(trials, (0.0, 0.0, 0.02)), file)
    assert 'a hand may have slipped or let go early' in words
    assert trials[1].name in words.partition('in these')[2]
    assert not any(trial.name in words for trial in (trials[0], *trials[2:]))
    assert 'sensitive' not in words


def test_a_trial_whose_points_the_uncertainty_of_the_parameters_moves_as_far_is_sensitive(calibration):
    trials, file = calibration
    flexibility = file.estimates['flexibility']
    vague = replace(file, estimates={**file.estimates, 'flexibility': replace(
        flexibility, lower=flexibility.value - 25, upper=flexibility.value + 25)})
    words, = warnings(shifted(trials, (0.0, 0.0, 0.02)), vague)
    assert trials[1].name in words.partition('these are sensitive')[2]
    assert 'slipped' not in words


def test_two_trials_do_not_say_which_is_right(calibration):
    trials, file = calibration
    assert warnings(shifted(trials, np.full(3, 0.02))[:2], file) == ()
