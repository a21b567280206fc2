# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The posterior gives back the intervals and correlations of the result."""

from made_up_dlo import MadeUpDlo, ROPE
import numpy as np
import pytest

from dlo_calibration.model.parameters import BY_NAME
from dlo_calibration.planning import Posterior


def drawn(dlo, count=4000, seed=1):
    """Return draws on the 0..100 scale, by name."""
    draws = Posterior.of(dlo).draws(count, seed)
    return {name: np.array([BY_NAME[name].value(draw[name]) for draw in draws]) for name in ROPE}


def test_90_percent_of_the_draws_lie_in_the_interval():
    skewed = {**ROPE, 'friction': (70.0, 50.0, 72.0)}
    for name, values in drawn(MadeUpDlo(skewed)).items():
        value, lower, upper = skewed[name]
        assert np.percentile(values, 5) == pytest.approx(lower, abs=0.05 * (upper - lower))
        assert np.percentile(values, 50) == pytest.approx(value, abs=0.05 * (upper - lower))
        assert np.percentile(values, 95) == pytest.approx(upper, abs=0.05 * (upper - lower))


def test_no_draw_is_beyond_the_scale():
    values = drawn(MadeUpDlo({**ROPE, 'elasticity': (30.0, 0.0, 100.0)}))['elasticity']
    assert values.min() >= 0 and values.max() <= 100
    assert values.std() > 20


def test_draws_are_correlated_as_the_result_says():
    names = list(ROPE)
    correlations = {name: {other: float(name == other) for other in names} for name in names}
    correlations['flexibility']['friction'] = correlations['friction']['flexibility'] = -0.9
    values = drawn(MadeUpDlo(correlations=correlations))
    measured = np.corrcoef([values[name] for name in names])
    assert measured[0, 2] == pytest.approx(-0.9, abs=0.03)
    assert measured[0, 1] == pytest.approx(0, abs=0.05)


def test_draws_depend_on_the_seed_alone():
    posterior = Posterior.of(MadeUpDlo())
    assert posterior.draws(5, 3) == posterior.draws(5, 3)
    assert posterior.draws(5, 3) != posterior.draws(5, 4)
    assert posterior.draws(8, 3)[:5] == posterior.draws(5, 3)


def test_the_best_parameters_are_those_of_the_result():
    best = Posterior.of(MadeUpDlo()).best
    assert best['friction'] == pytest.approx(BY_NAME['friction'].physical(70.0))
    assert best['mass'] == 0.03
