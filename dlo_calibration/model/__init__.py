# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Chains, actions, trials, parameters, and the scores that compare chains."""

from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import Parameter, PARAMETERS, ParameterSpace
from dlo_calibration.model.score import difference_score, PointErrors
from dlo_calibration.model.trial import Goal, Trial

__all__ = ['Action', 'Chain', 'Goal', 'Hand', 'PARAMETERS', 'Parameter', 'ParameterSpace', 'PointErrors',
           'Trial', 'difference_score']
