# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

from dlo_calibration.calibration.calibrate import calibrate as calibrate
from dlo_calibration.calibration.options import Options as Options
from dlo_calibration.errors import DloCalibrationError as DloCalibrationError
from dlo_calibration.errors import InputError as InputError
from dlo_calibration.errors import SimulationError as SimulationError
from dlo_calibration.evaluation.log import EvaluationLog as EvaluationLog
from dlo_calibration.export.mjcf import export_mjcf as export_mjcf
from dlo_calibration.export.sdf import export_sdf as export_sdf
from dlo_calibration.export.usd import export_usd as export_usd
from dlo_calibration.files.result import read_result as read_result
from dlo_calibration.files.session import read_session as read_session
from dlo_calibration.model.action import Action as Action
from dlo_calibration.model.action import Hand as Hand
from dlo_calibration.model.chain import Chain as Chain
from dlo_calibration.model.trial import Force as Force
from dlo_calibration.model.trial import Goal as Goal
from dlo_calibration.model.trial import Trial as Trial
from dlo_calibration.planning.options import AdviceOptions as AdviceOptions
from dlo_calibration.planning.options import PlanOptions as PlanOptions
from dlo_calibration.planning.planner import plan as plan
from dlo_calibration.planning.prediction import simulate as simulate
from dlo_calibration.simulation.bullet import BulletRope as BulletRope
from dlo_calibration.workspace.next_action import advise as advise
