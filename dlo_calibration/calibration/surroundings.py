# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The surroundings of a fit: simulations around the best parameter set, which its intervals need."""

from __future__ import annotations

from concurrent.futures import CancelledError
from dataclasses import replace

import numpy as np

from dlo_calibration.calibration.fit import Fit
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.evaluation.evaluation import Evaluation
from dlo_calibration.evaluation.linearisation import Linearisation
from dlo_calibration.evaluation.residuals import ResidualLayout
from dlo_calibration.evaluation.robust import Huber
from dlo_calibration.inference.examination import Examination, examine
from dlo_calibration.inference.uncertainty import Uncertainty
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import REST_SHAPE
from dlo_calibration.observation.noise import NO_NOISE, noise, with_other_noise

CHAINS = 16  # initial chains with other noise, over all trials


def examined(setting: Setting, fit: Fit) -> Fit:
    """
    Return a fit with the examination of its surroundings, and with the evaluation to report as its best.

    A parameter that no trial shows gets its default instead of a random value, unless the fit becomes
    significantly worse. If the user stops, there is no examination.
    """
    if fit.stopped:
        return replace(fit, examination=None)
    try:
        examination, best = _examined(setting, fit)
    except CancelledError:
        return replace(fit, examination=None, stopped=True)
    count = examination.evaluations + fit.examined
    return replace(fit, best=best, validated=0, examination=replace(examination, evaluations=count))


def _examined(setting: Setting, fit: Fit) -> tuple[Examination, Evaluation]:
    """
    Return the examination, and the evaluation to report as the best.

    :raises CancelledError: when stopped.
    """
    trials, space, best = setting.trials, fit.space, fit.best
    assert best.residuals is not None
    default, sigma = space.default_point(), noise(trials)
    finer = setting.pool.refined()
    noisy = sigma > NO_NOISE and 'length_scale' not in space.free
    evaluate = setting.evaluate(space)
    drawn = with_other_noise(
        trials, sigma, -(-CHAINS // len(trials)), np.random.default_rng(0)) if noisy else []
    here = best.point[None, :]
    try:
        # They begin first, as they depend on nothing that follows: threads that would wait do them.
        fine = None if finer is None else setting.evaluate(space, finer=finer).begin(here)
        starts = [setting.evaluate(space, others).begin(here) for others in drawn]
        examination = examine(
            best.point, best.residuals, ResidualLayout.compared(trials), evaluate.residuals,
            default=default, noise=sigma, finer=fine, starts=starts,
            fading=np.array([name not in REST_SHAPE for name in space.free]))
    finally:
        if finer is not None:
            finer.simulator.close()
    found, jacobian = examination.uncertainty, examination.jacobian
    point, again = np.where(found.excited, best.point, default), best
    if not np.array_equal(point, best.point):
        step = np.clip(_step(Linearisation(best.point, best.residuals, jacobian).at(point), found), -0.1, 0.1)
        points = np.stack([point, np.clip(point + step, 0.0, 1.0)])
        seen = list(evaluate(points, best.index))
        if len(seen) < len(points):
            raise CancelledError
        loss = Huber.of(best.residuals)
        again = replace(min(seen, key=lambda one: loss.cost(one.residuals)), index=best.index)
        examination = replace(examination, evaluations=examination.evaluations + len(points))
        # The cost is half the sum of squares; 10 % exceed a chi-square of 2.71 with one degree of freedom.
        worse = 2 * (loss.cost(again.residuals) - loss.cost(best.residuals)) / found.scale**2
        if worse > 2.71 * int((point != best.point).sum()):  # the defaults fit worse: the found values stay
            found, again = replace(found, excited=found.excited | (point != best.point)), best
    assert again.residuals is not None
    remaining = _step(Linearisation(again.point, again.residuals, jacobian), examination.uncertainty)
    return replace(examination, uncertainty=found.at(best.point, again.point, remaining)), again


def _step(fit: Linearisation, found: Uncertainty) -> Floats:
    """Return the (d,) Gauss-Newton step of the excited parameters to the minimum, within the unit cube."""
    step = np.zeros(len(fit.point))
    free = fit.columns(found.excited).weighted(Huber.of(fit.residuals).roots(fit.residuals))
    step[found.excited] = free.step(np.eye(len(free.point)) * found.residual**2)
    return np.asarray(np.clip(fit.point + step, 0.0, 1.0) - fit.point)
