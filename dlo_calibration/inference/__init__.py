# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""What follows from a fit: intervals, which parameters are identifiable, the next action, what is missing."""

from dlo_calibration.inference.advice import Advice, advise
from dlo_calibration.inference.examination import Confirmation, Examination, examine
from dlo_calibration.inference.missing_parameters import MissingParameter
from dlo_calibration.inference.slices import Slices
from dlo_calibration.inference.trial_information import TrialInformation
from dlo_calibration.inference.uncertainty import Uncertainty

__all__ = ['Advice', 'Confirmation', 'Examination', 'MissingParameter', 'Slices', 'TrialInformation',
           'Uncertainty', 'advise', 'examine']
