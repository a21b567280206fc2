# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The result of a DLO with a rest shape and friction between its strands: thirty parameters, made up."""

from dataclasses import replace

import numpy as np
from toy_messages import toy_trials
from toy_simulator import new_toy

from dlo_calibration import calibrate
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult, parameter_estimates
from dlo_calibration.inference.uncertainty import DEVIATIONS, Uncertainty
from dlo_calibration.model.parameters import knot_names, PAPER_PARAMETERS, ParameterSpace

#: 0..100: friction keeps 2 1/m, and the strands slip after 0.3 1/m.
MEMORY = {'bending_friction': 57.6, 'bending_slip': 61.9, 'torsion': 60.0, 'damping': 45.0,
          'internal_damping': 30.0, 'length_scale': 52.0, 'stiffness_2': 55.0, 'clamp_twist': 58.0}


def rest_shape_space(knots: int = 9, mass: float = 0.05) -> ParameterSpace:
    """Return a space in which all of that is free."""
    return ParameterSpace((*PAPER_PARAMETERS, *MEMORY, *knot_names(knots)), mass=mass)


def rest_shape_result(knots: int = 9, mass: float = 0.05, seed: int = 0) -> CalibrationResult:
    """Return what a toy finds, with the parameters of `rest_shape_space` and any covariance of them."""
    result = calibrate(toy_trials(2), Options.of({'workers': 1, 'evaluations': 30}), make_simulator=new_toy)
    space, rng = rest_shape_space(knots, mass), np.random.default_rng(seed)
    fractions = np.repeat(np.linspace(0, 1, knots), 2)
    bent = 3 * np.sin(4 * fractions) + np.where(np.arange(2 * knots) % 2, 1.0, 2.0)  # 1/m
    point = np.concatenate([result.best.point, [value / 100 for value in MEMORY.values()], 0.5 + bent / 50])
    std = np.concatenate([0.02 * rng.uniform(0.5, 6, len(point) - 2 * knots),
                          rng.uniform(0.005, 0.015, 2 * knots)])
    std[-1] = 0.12  # weak
    mixed = np.eye(len(point)) + 0.3 * rng.normal(size=(len(point), len(point)))
    covariance = mixed @ mixed.T
    covariance *= np.outer(*2 * [std / np.sqrt(np.diag(covariance))])
    assert result.examination is not None
    uncertainty = Uncertainty(
        std=std, lower=np.clip(point - DEVIATIONS * std, 0, 1), upper=np.clip(point + DEVIATIONS * std, 0, 1),
        excited=np.ones(len(point), bool), at_bound=np.zeros(len(point), bool), covariance=covariance,
        residual=0.002, scale=0.004)
    best = replace(result.best, point=point, values=space.values(point))
    evaluations = tuple(replace(evaluation, point=(longer := np.append(evaluation.point, point[4:])),
                                values=space.values(longer)) for evaluation in result.evaluations)
    return replace(
        result, space=space, best=best, evaluations=evaluations,
        estimates=parameter_estimates(space, best, uncertainty),
        examination=replace(result.examination, uncertainty=uncertainty, regular=True, noise=0.001,
                            jacobian=rng.normal(size=(len(result.examination.jacobian), len(point))) * 0.05))
