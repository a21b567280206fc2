# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Estimates from observed chains alone, without simulation: noise, resting and hanging parts, prior."""

from dlo_calibration.observation.estimate import prior_estimates, PriorEstimate
from dlo_calibration.observation.excitation import excites
from dlo_calibration.observation.material import with_shared_places
from dlo_calibration.observation.noise import smooth
from dlo_calibration.observation.plausibility import implausible, implausible_trials
from dlo_calibration.observation.table import resting_level

__all__ = ['PriorEstimate', 'excites', 'implausible', 'implausible_trials', 'prior_estimates',
           'resting_level', 'smooth', 'with_shared_places']
