# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The result of a calibration."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
import math
from typing import Any, Iterator, Mapping, Sequence

import numpy as np

from dlo_calibration.calibration.choice import Choice
from dlo_calibration.calibration.fit import Fit
from dlo_calibration.calibration.prior import Prior
from dlo_calibration.calibration.setting import Setting
from dlo_calibration.evaluation.evaluation import Evaluation, mean_length
from dlo_calibration.evaluation.residuals import at_every_goal, ResidualLayout
from dlo_calibration.inference.advice import Advice
from dlo_calibration.inference.examination import Confirmation, DISTANCE_TOLERANCE, Examination
from dlo_calibration.inference.missing_parameters import MissingParameter, PARTS
from dlo_calibration.inference.outlier import Outlier, SOMETHING_ELSE
from dlo_calibration.inference.together import known_together, Together
from dlo_calibration.inference.uncertainty import (
    DEVIATIONS,
    IDENTIFIABLE,
    INVOLVED,
    NOT_IDENTIFIABLE,
    predictive_std,
    spread_of_best,
    Uncertainty,
    verdict,
)
from dlo_calibration.model.chain import Floats, frozen_array, interpolate_unseen
from dlo_calibration.model.parameters import BY_NAME, GRAVITY, measured, number, ParameterSpace, SCALE
from dlo_calibration.model.score import distances, MEAN_DISTANCE, observed, PointErrors
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.noise import NO_NOISE, noise

NOT_USABLE = 'the result is not usable'  # note of its parameters
#: Bending stiffness over weight and squared length of a DLO that hangs limp, and of one that hardly sags.
LIMP, RIGID = 0.01, 10.0
WORST = 0.1  # of the length; good models of real DLOs miss the measured points by 0.3 to 3 % of it
COARSE = 0.01  # of the length: a finer simulation that moves a trial by more leads it elsewhere


@dataclass(frozen=True)
class ParameterEstimate:
    """
    One calibrated parameter.

    `value`, `std` and the 90 % interval from `lower` to `upper` are on the 0..100 scale; `physical_value`,
    `physical_lower` and `physical_upper` are the same in `physical_unit`.

    :param identifiable: False if the trials do not determine the value.
    :param verdict: identifiable, weak, or not identifiable, by the width of the interval; see `uncertainty`.
    :param note: a warning; may be empty.
    """

    name: str
    value: float
    std: float
    lower: float
    upper: float
    physical_value: float
    physical_lower: float
    physical_upper: float
    physical_unit: str
    identifiable: bool
    verdict: str = ''
    note: str = ''


@dataclass(frozen=True)
class CalibrationResult:
    """
    The result of a calibration.

    :param estimates: what the trials tell of each parameter; see `parameters`.
    :param chains: (g, n, 3) simulated chains at the goals of each trial [m].
    :param examination: around the best evaluation; None if the user stopped before.
    :param advice: which action to observe next; None if none would help, or it was not computed.
    :param missing_parameters: fixed parameters that would explain part of the residuals; empty if noise
        explains the residuals, or if it was not computed.
    :param choice: the decided options; None: nothing was calibrated.
    :param hand_error: of stamps or places of the hands that was not corrected; '' if there is none.
    :param outlier: a trial that does not fit the others.
    :param unusable_fit: why the calibration that found the parameters is unusable, where they only are
        validated here.
    :param implausible: why the trials cannot be as described, see `plausibility`; `warnings` has it, too.
    """

    space: ParameterSpace
    estimates: Mapping[str, ParameterEstimate]
    best: Evaluation
    trials: tuple[Trial, ...]
    chains: tuple[Floats, ...]
    evaluations: tuple[Evaluation, ...]
    seconds: float
    search: str
    engine: str
    stop_reason: str
    seed: int | None = None
    warnings: tuple[str, ...] = ()
    confirmation: Confirmation | None = None
    examination: Examination | None = None
    advice: Advice | None = None
    missing_parameters: tuple[MissingParameter, ...] = ()
    choice: Choice | None = None
    implausible: tuple[str, ...] = ()
    hand_error: str = ''
    outlier: Outlier | None = None
    unusable_fit: str = ''

    @classmethod
    def of(cls, setting: Setting, prior: Prior, fit: Fit) -> CalibrationResult:
        """Return the result of a fit; `seconds` is 0 until the calibration has ended."""
        trials, best, examination = setting.trials, fit.best, fit.examination
        uncertainty = spread_of_best(fit.evaluations, best.point, fit.space.upper)
        if examination is not None:
            uncertainty = examination.uncertainty if examination.regular else uncertainty.of_excited(
                examination.uncertainty.excited)
        return cls(
            space=fit.space, best=best, trials=trials,
            estimates={**parameter_estimates(fit.space, best, uncertainty, prior.guessed),
                       **hand_estimates(setting)},
            chains=simulated_chains(trials, best), evaluations=fit.evaluations, seconds=0.0,
            search=fit.search, engine=setting.simulator.name, stop_reason=fit.stop_reason,
            seed=setting.options.seed, examination=examination,
            warnings=(*_warnings(best, fit.evaluations), *_coarse(trials, examination)),
            hand_error=setting.hand_error)

    @property
    def unusable(self) -> str:
        """
        Why the parameters should not be used, in one sentence; '' if they can be.

        The first of these reasons counts: a trial is implausible; stamps or places of the hands are wrong;
        the stiffness may lie beyond its scale; the fit is far worse than models of DLOs are; a trial that
        does not fit the others decides a value, unless it is sensitive; two engines differ by more than the
        fit misses the measurement; the search ended before a minimum; the fit is not better than the default
        parameters, though noise does not explain it; the trials determine no parameter.
        """
        mean, examination, other = self.errors.mean, self.examination, self.confirmation
        if self.implausible:
            return self.implausible[0]
        if self.hand_error:
            return self.hand_error
        if self._beyond_scale:
            return self._beyond_scale
        if mean > WORST * self.length:
            return (f'the mean error is {number(100 * mean / self.length)} % of the length; check frames, '
                    'grips and clocks')
        if self.choice is None:
            return self.unusable_fit
        if self.outlier is not None and self.outlier.decided and not self.outlier.sensitive:
            return self.outlier_words
        if other is not None and other.mean_distance > max(mean, DISTANCE_TOLERANCE):
            return (f'engine {other.engine} differs from {self.engine} by '
                    f'{measured(other.mean_distance, "m")}, '
                    'more than the fit from the measurement; check the trials on which they disagree')
        if examination is None or not examination.regular:
            return (f'the search has not reached a minimum ({self.stop_reason}); calibrate with more '
                    'evaluations or another search')
        if mean >= examination.default_error and not examination.noise_alone:
            return (f'the default parameters fit as well ({measured(examination.default_error, "m")} on '
                    'average), and noise does not explain what is left; check frames, grips and clocks')
        if all(self.estimates[name].verdict == NOT_IDENTIFIABLE for name in self.space.free):
            remedy = 'observe an action that shows one' if self.advice is None else \
                f'next, {self.advice.words}'
            return f'these trials determine none of the parameters; {remedy}'
        return ''

    @cached_property
    def _beyond_scale(self) -> str:
        """Why the stiffness of a very short and light, or a very long and heavy DLO may lack, in words."""
        examination, name = self.examination, 'flexibility'
        if examination is None or examination.noise_alone or name not in self.space.free or \
                'mass' in self.space.free:
            return ''
        parameter, mass = BY_NAME[name], self.physical()['mass']
        limp = self.values[name] > 0
        if self.estimates[name].upper < SCALE if limp else not (
                examination.uncertainty.at_bound[self.space.free.index(name)]):
            return ''
        end = parameter.at_hundred if limp else parameter.at_zero
        share = end / (mass * GRAVITY * self.length**2)
        power = math.ceil(math.log10(share / LIMP)) if limp else math.floor(math.log10(share / RIGID))
        factor = 10.0**power
        if (factor <= 1) == limp:  # the scale contains all that such a DLO may be
            return ''
        whose, by = ('its own', f'{factor:g}') if self.space.mass_known else ('what is assumed', 'its weight')
        return (f'flexibility may lie beyond the end of its scale, {measured(end, parameter.unit)}: give a '
                f'mass of {number(factor * mass)} kg, {factor:g} times {whose}, and divide all stiffnesses '
                f'by {by}, as motion tells only their ratio to the weight')

    @property
    def headline(self) -> str:
        """The first line to read: whether the result is usable, its mean error, and what to do next."""
        mean, from_noise = self.errors.mean, MEAN_DISTANCE * self.noise_level
        error = f'the simulated points are {measured(mean, "m")} from the measured ones'
        if from_noise > NO_NOISE:
            error += f', {number(float(f"{mean / from_noise:.2g}"))} times the noise'
        if self.unusable:
            return f'Not usable: {self.unusable.removesuffix(".")}. {error[0].upper()}{error[1:]}.'
        return f'Usable: {error}. {self._next_step}'.strip()

    @property
    def _next_step(self) -> str:
        """What a user of a usable result should do next; '' where nothing was fitted."""
        if self.choice is None:
            return ''
        if self.outlier is not None:
            return f'Next: repeat {self.outlier.trial}, which does not fit the others.'
        if self.advice is not None:
            return f'Next: {self.advice.words}, to know {self.advice.parameter} better.'
        unknown = [name for name, estimate in self.estimates.items() if estimate.verdict == NOT_IDENTIFIABLE]
        if unknown:
            return f'Next: do not rely on {", ".join(unknown)}, which these trials do not determine.'
        if self.missing_parameters:
            name = self.missing_parameters[0].name
            return 'Next: calibrate with parts 0.' if name == PARTS else f'Next: calibrate {name}, too.'
        return 'Nothing more is needed.'

    @cached_property
    def noise_level(self) -> float:
        """Standard deviation of one measured coordinate [m]; nan if the chains have too few points."""
        return noise(self.trials) if self.examination is None else self.examination.noise

    @cached_property
    def force_error(self) -> Floats:
        """Root mean square of how far simulated forces are off in x, y and z, (3,) [N]; nan: not measured."""
        residuals = self.best.residuals
        rows = zip(self.trials, ResidualLayout.of(self.trials).force_rows, strict=True)
        if residuals is None or not any(trial.forces for trial in self.trials):
            return np.full(3, np.nan)
        off = np.concatenate([residuals[row].reshape(-1, 3) / trial.force_scale for trial, row in rows])
        return np.asarray(np.sqrt(np.mean(off**2, axis=0)))

    @cached_property
    def parameters(self) -> Mapping[str, ParameterEstimate]:
        """The calibrated parameters; none of an unusable result is identifiable."""
        if not self.unusable:
            return self.estimates
        return {name: estimate if estimate.verdict == NOT_IDENTIFIABLE else
                replace(estimate, identifiable=False, verdict=NOT_IDENTIFIABLE, note=NOT_USABLE)
                for name, estimate in self.estimates.items()}

    @property
    def outlier_words(self) -> str:
        """The trial that does not fit the others, and the values without it; '' if there is none."""
        odd = self.outlier
        if odd is None:
            return ''
        without = ', '.join(f'{name} {number(odd.values[name])} instead of {number(self.values[name])}'
                            for name in odd.decided) or 'the same values within their intervals'
        why = 'its goal chains seem to run from the other end of the DLO' if odd.turned else SOMETHING_ELSE
        if odd.sensitive:
            why = (f'it is sensitive, as the uncertainty of the parameters moves its points by '
                   f'{measured(odd.spread, "m")}; or {SOMETHING_ELSE}')
        return (f'{odd.trial} does not fit the others: {measured(odd.error, "m")} from what they predict, '
                f'where they miss {measured(odd.usual, "m")}; without it: {without}; {why}: repeat it, or '
                f'leave it out (--without {odd.number})')

    def including(self, point: Floats) -> CalibrationResult:
        """Return a result whose intervals contain a (d,) point of the box as well."""
        assert self.examination is not None
        uncertainty = self.examination.uncertainty
        uncertainty = uncertainty.within(np.minimum(uncertainty.lower, point),
                                         np.maximum(uncertainty.upper, point))
        estimates = {name: wider for name, wider in parameter_estimates(
            self.space, self.best, uncertainty).items() if
            (wider.lower, wider.upper) != (self.estimates[name].lower, self.estimates[name].upper)}
        return replace(self, examination=replace(self.examination, uncertainty=uncertainty),
                       estimates={**self.estimates, **estimates})

    @property
    def trial_errors(self) -> tuple[Floats, ...]:
        """The point errors [m] of each trial."""
        return trial_errors(self.trials, self.best)

    @property
    def values(self) -> dict[str, float]:
        """Found parameters on the 0..100 scale, by name."""
        return {name: estimate.value for name, estimate in self.estimates.items()}

    @property
    def correlations(self) -> dict[str, dict[str, float]] | None:
        """Correlation of each pair of found parameters, by name; None if it is unknown."""
        examination, names = self.examination, self.space.free
        if examination is None or not examination.regular or examination.uncertainty.correlations is None:
            return None
        rows = zip(names, examination.uncertainty.correlations, strict=True)
        known = {name: dict(zip(names, map(float, row), strict=True)) for name, row in rows}
        return {name: {other: known.get(name, {}).get(other, float(name == other))
                       for other in self.parameters} for name in self.parameters}

    @cached_property
    def band(self) -> Floats | None:
        """(p,) standard deviation of each simulated goal point due to the parameters' [m]; None: unknown."""
        examination = self.examination
        if examination is None or not examination.regular or examination.uncertainty.covariance is None:
            return None
        return at_every_goal(
            predictive_std(examination.jacobian, examination.uncertainty.covariance), self.trials)

    @property
    def std(self) -> Floats:
        """(d,) standard deviations of the found values, in units of a search."""
        return self.space.point({name: self.estimates[name].std for name in self.space.free})

    @property
    def errors(self) -> PointErrors:
        """Point errors of the best evaluation."""
        assert self.best.errors is not None
        return self.best.errors

    @property
    def length(self) -> float:
        """Mean length of the DLO over the trials [m]."""
        return mean_length(self.trials)

    @property
    def simulations(self) -> int:
        """Number of rollouts that the search and the examination simulated."""
        examined = 0 if self.examination is None else self.examination.evaluations
        return examined * len(self.trials) + sum(
            len(self.trials) - evaluation.skipped for evaluation in self.evaluations)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Combinations of parameters that are not identifiable, in words."""
        if self.examination is None or not self.examination.regular:
            return ()
        return tuple(combination(self.space.free, vector)
                     for vector in self.examination.uncertainty.undetermined)

    @property
    def together(self) -> tuple[Together, ...]:
        """The pairs of parameters that are known only together."""
        if self.examination is None or not self.examination.regular or self.unusable:
            return ()
        uncertainty = self.examination.uncertainty
        return () if uncertainty.local is None else known_together(
            self.space.free, uncertainty.local, uncertainty.std)

    def physical(self) -> dict[str, float]:
        """Physical values of all parameters in SI units, for a DLO of the observed length."""
        return self.space.physical(self.values, self.length)


def parameter_estimates(space: ParameterSpace, best: Evaluation, uncertainty: Uncertainty,
                        guessed: Sequence[str] = ()) -> dict[str, ParameterEstimate]:
    """
    Return the parameters of the best evaluation with their uncertainty, in both units.

    :param guessed: names of the parameters whose default was estimated from the chains alone.
    """
    parameters = {}
    columns = [space.values(each) for each in (best.point, uncertainty.lower, uncertainty.upper,
                                               uncertainty.std)]
    for k, name in enumerate(space.free):
        value, lower, upper, std = (column[name] for column in columns)
        (at_value, unit), (at_lower, _), (at_upper, _) = (
            space.reported(name, x) for x in (value, lower, upper))
        note = ''
        if not uncertainty.excited[k]:
            note = 'no trial shows it; it keeps its default'
            if name in guessed:
                note = 'no trial shows it; estimated from the height at which the DLO lies'
        low, high = sorted((at_lower, at_upper))
        own_verdict = uncertainty.verdicts[k]
        if uncertainty.excited[k] and (lower <= 0) != (upper >= SCALE):
            words = BY_NAME[name].interval(lower, upper, (low, high), unit)
            note = f'{words}: the interval reaches the end of the scale'
            if uncertainty.at_bound[k]:
                note += ', where the best value is'
        parameters[name] = ParameterEstimate(
            name, value, std, lower, upper, at_value, low, high, unit,
            own_verdict == IDENTIFIABLE, own_verdict, note)
    return parameters


def hand_estimates(setting: Setting) -> dict[str, ParameterEstimate]:
    """Return the errors of the hands that were corrected as the chains show them."""
    estimates, deviations = {}, setting.evidence.deviations
    for name in setting.choice.corrected:
        parameter, at = BY_NAME[name], getattr(setting.options, name)
        scale = SCALE / (parameter.at_hundred - parameter.at_zero)
        low, high = (at + side * DEVIATIONS * deviations[name] for side in (-1, 1))
        value, lower, upper = map(parameter.value, (at, low, high))
        words = verdict(*(each / SCALE * parameter.extent for each in (lower, upper, SCALE)))
        estimates[name] = ParameterEstimate(
            name, value, deviations[name] * scale, lower, upper, at, low, high, parameter.unit,
            words == IDENTIFIABLE, words, 'as the chains show it, without simulation')
    return estimates


def combination(names: Sequence[str], vector: Floats) -> str:
    """Return a combination of parameters in words, e.g. ``flexibility - 0.8 friction``."""
    largest = float(np.abs(vector).max())
    words = ''
    for k in np.argsort(-np.abs(vector), kind='stable'):
        share = float(vector[k]) / largest
        if abs(share) >= INVOLVED:
            sign = ('- ' if share < 0 else '+ ') if words else ('-' if share < 0 else '')
            size = '' if abs(share) > 0.95 else f'{abs(share):.1f} '
            words += f'{" " if words else ""}{sign}{size}{names[k]}'
    return words


def trial_errors(trials: Sequence[Trial], evaluation: Evaluation) -> tuple[Floats, ...]:
    """Return the point errors [m] of each trial, from an evaluation of every goal."""
    assert evaluation.residuals is not None
    return tuple(distances(evaluation.residuals[rows]) for rows in ResidualLayout.of(trials).point_rows)


def simulated_chains(trials: Sequence[Trial], evaluation: Evaluation) -> tuple[Floats, ...]:
    """Return the simulated chains of each trial, (g, n, 3) [m]: measured chains plus residuals."""
    assert evaluation.residuals is not None
    offsets = ResidualLayout.of(trials).chains(evaluation.residuals)
    simulated = []
    for trial, away in zip(trials, offsets, strict=True):
        chains, places = observed(trial) + away, trial.initial.arc_lengths()
        for k, goal in enumerate(trial.goals):
            if not goal.chain.seen.all():  # nothing was compared there
                chains[k] = interpolate_unseen(chains[k], goal.chain.seen, places)
        simulated.append(frozen_array(chains))
    return tuple(simulated)


def _warnings(best: Evaluation, evaluations: Sequence[Evaluation]) -> tuple[str, ...]:
    warnings = []
    if best.unsettled:
        warnings.append(f'never came to rest: {", ".join(best.unsettled)}; the last state was compared')
    failed = [evaluation for evaluation in evaluations if evaluation.failure]
    if failed:
        warnings.append(f'{len(failed)} of {len(evaluations)} evaluations could not be simulated: '
                        f'{failed[0].failure}')
    return tuple(warnings)


def _coarse(trials: Sequence[Trial], examination: Examination | None) -> Iterator[str]:
    """Yield a sentence for each trial that a finer simulation leads elsewhere."""
    moves = () if examination is None else examination.coarse
    for k, (trial, moved) in enumerate(zip(trials, moves, strict=False), 1):
        if moved > COARSE * trial.initial.length:
            yield (f'{trial.name}: half the time step and twice the nodes move it by {measured(moved, "m")}, '
                   'so it tells little; does the DLO snap? Let go of it where it is hardly bent, move it '
                   f'more slowly, or leave it out (--without {k})')


def plain(result: CalibrationResult) -> dict[str, Any]:
    """
    Return a result as plain values, under the keys that `fit --json` prints.

    Units are SI; scores are in cm; `value`, `std`, `lower` and `upper` are on the scale from 0 to 100.
    None stands for an unknown value.
    """
    examination, other, advice = result.examination, result.confirmation, result.advice
    values: dict[str, Any] = with_nulls({
        'headline': result.headline, 'unusable': result.unusable,
        'parameters': {name: {key: value for key, value in asdict(estimate).items() if key != 'name'}
                       for name, estimate in result.parameters.items()},
        **_fit(result.best.score, result.best.scores, result.errors),
        'error_percent_of_length': 100 * result.errors.mean / result.length,
        'trials': len(result.trials), 'evaluations': len(result.evaluations),
        'simulations': result.simulations, 'seconds': result.seconds, 'engine': result.engine,
        'search': result.search, 'seed': result.seed, 'stop_reason': result.stop_reason,
        'choice': result.choice.words if result.choice else '',
        'warnings': result.warnings,
        'cross_validated_error_m': examination and examination.cross_validated,
        'default_error_m': examination and examination.default_error,
        'noise_m': examination and examination.noise,
        'residual_std_m': examination and examination.uncertainty.residual,
        'force_error_n': None if np.isnan(result.force_error).any() else result.force_error.tolist(),
        'correlations': result.correlations,
        'advice': advice and {**asdict(advice), **advice.of_hundred},
        'explanations': {missing.name: missing.share for missing in result.missing_parameters},
        'undetermined': result.undetermined,
        'together': [{**asdict(pair), 'words': pair.words} for pair in result.together],
        'confirmation': other and {
            'engine': other.engine, **_fit(other.score, other.scores, other.errors),
            'mean_distance_m': other.mean_distance, 'max_distance_m': other.max_distance}})
    return values


def evaluation_rows(result: CalibrationResult) -> tuple[list[str], list[list[Any]]]:
    """
    Return the header and the rows of a table of all evaluations, which are numbered from 1.

    Parameters are on the scale from 0 to 100, scores in cm, the mean point error in m. A failed evaluation
    leaves cells empty.
    """
    names, trials = result.space.free, [trial.name for trial in result.trials]
    head = ['evaluation', *names, 'score', *(f'score of {name}' for name in trials), 'mean_error_m',
            'failure']
    return head, [
        [evaluation.index + 1, *(evaluation.values[name] for name in names), evaluation.score,
         *(evaluation.scores or [''] * len(trials)),
         '' if evaluation.errors is None else evaluation.errors.mean, evaluation.failure]
        for evaluation in result.evaluations]


def with_nulls(value: Any) -> Any:
    """Replace numbers that are not finite, which JSON cannot express, by None."""
    if isinstance(value, Mapping):
        return {str(key): with_nulls(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [with_nulls(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _fit(score: float, scores: Sequence[float], errors: PointErrors) -> dict[str, Any]:
    return {'score': score, 'scores': scores, 'mean_error_m': errors.mean, 'rms_error_m': errors.rms,
            'max_error_m': errors.max, 'mean_abs_error_m': errors.mean_abs}
