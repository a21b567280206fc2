# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Parts: as many as the trials support, no more."""

from carried import EVEN, observed, STIFF_MIDDLE, TRUTH
import pytest

from dlo_calibration.calibration.calibrate import fitted
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.evaluation.evaluator import Evaluator
from dlo_calibration.simulation.compiled import CompiledSimulator


def calibrated(trials, budget=200, **rest):
    options = Options(calibrate=EVEN.free, parts=0, evaluations=budget)
    return fitted(Setting(tuple(trials), options, CompiledSimulator(table=False, nodes=21), **rest))


@pytest.fixture(scope='module')
def stiff_middle():
    return observed(EVEN.divided(4), STIFF_MIDDLE)


@pytest.fixture(scope='module')
def found(stiff_middle):
    seen = []
    return calibrated(stiff_middle, on_evaluation=seen.append), seen


def test_a_dlo_that_is_stiffer_in_the_middle_gets_four_parts(found):
    # In two parts it looks even: only four show it.
    result, _ = found
    assert result.space.parts == 4
    for name, value in STIFF_MIDDLE.items():
        assert result.values[name] == pytest.approx(value, abs=1.5), name
    assert result.stop_reason.endswith('4 parts: 8 would not predict left-out trials better')
    assert result.errors.mean < 1e-3


def test_every_evaluation_is_counted_and_told_in_the_parts_that_were_found(found):
    result, seen = found
    assert [one.index for one in result.evaluations] == [one.index for one in seen] == list(range(len(seen)))
    assert len(seen) <= 200
    assert {tuple(one.values) for one in result.evaluations} == {result.space.free}
    first = result.evaluations[0].values  # of the even DLO
    assert [first[f'stiffness_{part}'] for part in (2, 3, 4)] == [50, 50, 50]
    assert result.simulations > len(seen) * 4


def test_the_same_in_parts_is_the_same_dlo(found):
    result, seen = found
    even = result.evaluations[0]
    simulator = CompiledSimulator(table=False, nodes=21)
    again = Evaluator(result.trials, result.space, simulator).evaluate(0, even.point)
    assert again.score == pytest.approx(seen[even.index].score, rel=1e-6)


def test_an_even_dlo_stays_in_one_part():
    result = calibrated(observed(EVEN, TRUTH))
    assert result.space.free == EVEN.free
    assert result.values == pytest.approx(TRUTH, abs=1.0)
    assert '1 part: 4 would not predict left-out trials better' in result.stop_reason


def test_a_small_budget_leaves_the_dlo_even_and_says_so(stiff_middle):
    result = calibrated(stiff_middle, budget=13)
    assert result.space.free == EVEN.free
    assert len(result.evaluations) <= 13
    assert result.stop_reason.endswith('1 part: the rest of the budget is too small to try 2')


def test_without_a_second_trial_nothing_can_be_left_out(stiff_middle):
    assert calibrated(stiff_middle[:1], budget=30).space.free == EVEN.free


def test_a_stop_keeps_the_parts_that_were_found(stiff_middle, found):
    even = next(k for k, one in enumerate(found[1]) if 'stiffness_2' in one.values)
    seen = []
    result = calibrated(stiff_middle, on_evaluation=seen.append, should_stop=lambda: len(seen) > even + 3)
    assert result.space.free == EVEN.free
    assert len(result.evaluations) == len(seen) == even + 4
    assert result.stop_reason.endswith('1 part: stopped before 2 were fitted')
