# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What only two parameters together tell: with a known posterior, and on a sample whose mass is unknown."""

from dataclasses import replace

import numpy as np
import pytest

from dlo_calibration import calibrate
from dlo_calibration.files.session import read_session, samples
from dlo_calibration.inference.together import known_together
from dlo_calibration.model.parameters import BY_NAME, extents
from dlo_calibration.report.sentences import sentences

NAMES = ('flexibility', 'friction', 'elasticity')
LOGARITHMS = np.array([np.log(BY_NAME[name].at_hundred / BY_NAME[name].at_zero) for name in NAMES]
                      ) / extents(NAMES)
DEVIATIONS = 1.645


def covariance(ratio, alone, power=1.0):
    """Return the covariance, in the box, of a DLO with EI / friction^power known to `ratio`."""
    along = np.array([power, 1.0, 0.0]) * alone
    physical = np.outer(along, along) + np.diag([ratio**2, 0.0, 0.01**2])
    return physical / np.outer(LOGARITHMS, LOGARITHMS)


@pytest.mark.parametrize('power', [1.0, -1.0, 0.5])
def test_the_combination_is_named_with_its_uncertainty(power):
    matrix = covariance(0.024, 0.16, power)
    pair, = known_together(NAMES, matrix, np.sqrt(np.diag(matrix)))
    assert (pair.first, pair.second) == ('flexibility', 'friction')
    assert pair.exponent == pytest.approx(-power)
    assert pair.known == pytest.approx(np.expm1(DEVIATIONS * 0.024), rel=0.1)
    assert pair.alone[1] == pytest.approx(np.expm1(DEVIATIONS * 0.16), rel=0.01)
    assert {1.0: 'flexibility / friction', -1.0: 'flexibility * friction',
            0.5: 'flexibility / friction^0.5'}[power] in pair.words
    assert '4 %' in pair.words
    assert '30 %' in pair.words


@pytest.mark.parametrize('matrix', [covariance(0.3, 0.16), covariance(0.01, 0.03)])
def test_nothing_is_said_where_each_is_known_alone_or_neither_together(matrix):
    assert known_together(NAMES, matrix, np.sqrt(np.diag(matrix))) == ()


@pytest.mark.long
def test_motion_under_gravity_tells_only_the_ratio_of_stiffness_and_mass():
    session = read_session(samples() / 'object1')
    options = replace(session.options, calibrate=('flexibility', 'friction', 'mass'), parts=1,
                      engine='compiled', workers=1)
    result = calibrate(session.trials, options)
    pair = result.together[0]
    assert (pair.first, pair.second, pair.exponent) == ('flexibility', 'mass', -1.0)
    assert pair.known < 0.2 * min(pair.alone)
    assert any(words.startswith('flexibility / mass') for words in sentences(result))
    assert result.physical()['flexibility'] / result.physical()['mass'] == pytest.approx(
        1e-4 / 0.03, rel=2 * pair.known)
