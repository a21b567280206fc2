# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Sentences: results, plans and predictions in plain English, and the texts of their tables."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
import math
from typing import Any, Mapping, TYPE_CHECKING

import numpy as np

from dlo_calibration.calibration.result import CalibrationResult, NOT_USABLE
from dlo_calibration.inference.missing_parameters import PARTS
from dlo_calibration.inference.trial_information import uninformative
from dlo_calibration.inference.uncertainty import IDENTIFIABLE, MODEL_ERROR, NOT_IDENTIFIABLE, WEAK
from dlo_calibration.model.action import Hand
from dlo_calibration.model.chain import Chain, Floats, grip_place, in_proportion, SHORT
from dlo_calibration.model.parameters import (
    BY_NAME,
    CLAMP_BENDS,
    interval,
    kept_curvature,
    knot_names,
    LOCKING,
    measured,
    natural_curvature,
    number,
    ParameterSpace,
    PER_WEIGHT,
)
from dlo_calibration.model.score import MEAN_DISTANCE, SIMILAR, VERY_SIMILAR

if TYPE_CHECKING:
    from dlo_calibration.planning.action_loads import ActionLoads
    from dlo_calibration.planning.plan import Plan
    from dlo_calibration.planning.prediction import PredictedStep, Prediction

MOST_COMBINATIONS = 3  # of parameters that the trials do not determine, in sentences


def sentences(result: CalibrationResult) -> list[str]:
    """Return sentences on the parameters and their uncertainty, the next action, and how well the fit is."""
    return [*_parameters(result), *rest_shape_sentences(result), *friction_sentences(result),
            *_forces(result), *(pair.words for pair in result.together), *_advice(result),
            *_uninformative(result), *_fit(result), *_missing_parameters(result), *_undetermined(result)]


def _parameters(result: CalibrationResult) -> list[str]:
    """Return a sentence on each parameter but the knots of the rest shape, the most certain ones first."""
    by_verdict: dict[str, list[str]] = {IDENTIFIABLE: [], WEAK: [], NOT_IDENTIFIABLE: []}
    alone = [name for name in result.parameters if name not in knot_names(result.space.knots)]
    for name in alone:
        p = result.parameters[name]
        verdict = p.verdict or (IDENTIFIABLE if p.identifiable else NOT_IDENTIFIABLE)
        quantity = BY_NAME[name].quantity
        value = measured(p.physical_value, p.physical_unit, p.physical_upper)
        ends = BY_NAME[name].interval(p.lower, p.upper, (p.physical_lower, p.physical_upper), p.physical_unit)
        bound = ends.startswith('at ')  # at least, at most
        if p.note == NOT_USABLE:
            words = f'{name} is not known, as {NOT_USABLE}: {quantity} {value} fits best'
        elif verdict == NOT_IDENTIFIABLE:
            words = f'{name} could not be determined'
            words += f': with these trials, {quantity} is only known to be {ends}' if bound else \
                f' ({p.note}): {quantity} {value}' if p.note else \
                f': with these trials, {quantity} may be anything from {ends}'
        elif bound:
            words = f'{name} is known on one side only: {quantity} is {ends}, with 90 % probability'
        else:
            well = 'well' if verdict == IDENTIFIABLE else 'only roughly'
            words = f'{name} is known {well}: {quantity} {value}, with 90 % probability {ends}'
        by_verdict[verdict].append(f'{words}.')
    texts = [text for group in by_verdict.values() for text in group]
    if any(p.physical_unit.endswith(PER_WEIGHT) for p in result.parameters.values()):
        texts.append('The mass was not given, so that stiffnesses are known only relative to the weight of '
                     'the DLO: multiply each by the weight per length, in N/m.')
    if result.examination is not None and not result.examination.regular:
        texts.append('The search has not reached a minimum, so that the intervals are only the spread of the '
                     'best parameter sets that it tried; more evaluations or another search may narrow them.')
    return texts


def _forces(result: CalibrationResult) -> list[str]:
    """Return a sentence on what measured forces told."""
    forces = [force for trial in result.trials for *_, force in trial.forces]
    if not forces:
        return []
    words = (f'{len(forces)} measured force{"s" * (len(forces) > 1)} on hands are '
             f'{", ".join(map(number, result.force_error))} N from the simulated ones in x, y and z')
    untared = sum(not force.tared for force in forces)
    if untared:
        words += (f'; the offset of {"their" if untared == len(forces) else "some"} sensors is unknown, so '
                  'that only differences within a trial count')
    mass = result.parameters.get('mass')
    if mass is None:
        return [f'{words}.']
    if mass.verdict == NOT_IDENTIFIABLE:
        return [f'{words}; they do not tell the mass: let a hand rest for a second before it closes, so that '
                'its sensor shows the offset, and lift more of the DLO.']
    return [f'{words}; they tell the mass, and so stiffnesses absolutely, not only relative to the weight.']


def _undetermined(result: CalibrationResult) -> list[str]:
    return [f'This combination of parameters can change while the fit stays nearly the same: {words}.'
            for words in result.undetermined[:MOST_COMBINATIONS]]


def _uninformative(result: CalibrationResult) -> list[str]:
    names = uninformative(result.trials, result.examination) if len(result.trials) > 1 else ()
    return [f'{", ".join(names)} added no information about any parameter.'] * bool(names)


def _advice(result: CalibrationResult) -> list[str]:
    advice = result.advice
    if advice is None:
        return []
    partners = [name for pair in result.together for name in (pair.first, pair.second)
                if advice.parameter in (pair.first, pair.second) and name != advice.parameter]
    deviation, expected = (number(advice.of_hundred[key]) for key in ('std', 'expected_std'))
    aim = f'tell {advice.parameter} from {partners[0]}' if partners else f'know {advice.parameter} better'
    return [f'To {aim}, {advice.words} (action {advice.action}). On the scale from '
            f'0 to 100, that should bring its standard deviation from {deviation} to {expected}.']


def _fit(result: CalibrationResult) -> list[str]:
    """Compare the error of the fit with other errors."""
    examination, mean = result.examination, result.errors.mean
    words = [f'The simulated points are {measured(mean, "m")} from the measured ones on average '
             f'({number(100 * mean / result.length)} % of the length).']
    if examination is None:
        return words
    if np.isfinite(examination.default_error):
        words.append('With the default parameters they would be '
                     f'{measured(examination.default_error, "m")} away.')
    if np.isfinite(examination.cross_validated):
        words.append('A trial that is left out of the fit is predicted to '
                     f'{measured(examination.cross_validated, "m")}.')
    noise = examination.noise * MEAN_DISTANCE
    if np.isfinite(noise):
        words.append(f'The noise of the measured points alone gives {measured(noise, "m")}; ' + (
            'the fit is about as good as the measurement.' if mean < MODEL_ERROR * noise else
            'the rest comes from errors of the model or of the recorded hands.'))
    return [' '.join(words)]


def lower_score(result: CalibrationResult) -> str:
    """Say why the result is not the evaluation with the lowest difference score; empty if it is."""
    lowest, best = min(result.evaluations, key=lambda evaluation: evaluation.score), result.best
    if lowest.score >= best.score or number(lowest.score) == number(best.score):
        return ''
    return (f'Evaluation {lowest.index + 1} has a lower difference score than the result, '
            f'{number(lowest.score)} instead of {number(best.score)} cm: the search minimises the distances '
            'of all points, with less weight on outliers, while in the score differences of opposite sign '
            'cancel.')


def _missing_parameters(result: CalibrationResult) -> list[str]:
    """Name fixed parameters to calibrate, too."""
    missing = result.missing_parameters
    shares = [f'{parameter.name} {number(100 * parameter.share)} %' for parameter in missing]
    if not shares:
        return []
    names = [parameter.name for parameter in missing if parameter.name != PARTS]
    beside = ', '.join(name for name in result.space.free if name not in knot_names(result.space.knots))
    how = [f'name {" or ".join(names)} in calibrate, beside {beside}'] * bool(names)
    how += ['set parts to 0 (bending stiffness that differs along the DLO)'] * (len(names) < len(shares))
    return [f'Parameters that were held fixed would explain these shares of the squared residuals: '
            f'{", ".join(shares)}. To calibrate them, too, {"; or ".join(how)}.']


@dataclass(frozen=True)
class Row:
    """
    One parameter in words, or both components of the curvature at a knot.

    :param name: for people; that of a knot names both components.
    :param value: on the 0..100 scale, with its interval `ends`.
    :param physical: the same in physical units, with its interval `physical_ends`.
    :param verdict: of the less certain component.
    :param note: why the parameter is uncertain; may be empty.
    """

    name: str
    quantity: str
    value: str
    ends: str
    physical: str
    physical_ends: str
    verdict: str
    note: str


def parameter_rows(parameters: Mapping[str, Mapping[str, Any]], space: ParameterSpace) -> list[Row]:
    """Return the rows for the parameters in the plain values of a result."""
    rows, names = [], knot_names(space.knots)
    pairs = dict(zip(names[::2], names[1::2], strict=True))
    for name, values in parameters.items():
        if name in pairs and pairs[name] in parameters:
            place = number(100 * (int(name[-1]) - 1) / (space.knots - 1))
            rows.append(_knot(f'rest_curvature {name[-1]}', f'at {place} % of the length, x and y',
                              values, parameters[pairs[name]]))
        elif not any(name == second and first in parameters for first, second in pairs.items()):
            unit = values['physical_unit']
            rows.append(Row(
                name, BY_NAME[name].quantity, number(values['value']),
                interval(values['lower'], values['upper'], '1'),
                measured(values['physical_value'], unit, values['physical_upper']),
                BY_NAME[name].interval(values['lower'], values['upper'],
                                       (values['physical_lower'], values['physical_upper']), unit),
                values['verdict'], values['note']))
    return rows


def _knot(name: str, quantity: str, *pair: Mapping[str, Any]) -> Row:
    unit = pair[0]['physical_unit']

    def ends(prefix: str) -> str:
        """Return how far the intervals reach, to the wider side."""
        reaches = (max(component[f'{prefix}upper'] - value, value - component[f'{prefix}lower'])
                   for component in pair for value in (component[f'{prefix}value'],))
        return ', '.join(f'±{number(reach)}' for reach in reaches)

    x, y = pair
    return Row(
        name, quantity, f'{number(x["value"])}, {number(y["value"])}', ends(''),
        f'{number(x["physical_value"])}, {measured(y["physical_value"], unit)}',
        f'{ends("physical_")} {unit}',
        max(pair, key=lambda component: float(component['std']))['verdict'],
        '; '.join(dict.fromkeys(component['note'] for component in pair if component['note'])))


def fit_facts(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return facts about the fit and the search, as pairs of texts, from the plain values of a result."""
    facts = [
        ('difference score', f'{number(values["score"])} cm (below {SIMILAR:g}: similar, '
                             f'below {VERY_SIMILAR:g}: very similar)'),
        ('mean error', f'{measured(values["mean_error_m"], "m")} '
                       f'({number(values["error_percent_of_length"])} % of the length)'),
        ('rms error', measured(values['rms_error_m'], 'm')),
        ('largest error', measured(values['max_error_m'], 'm')),
        ('trials', str(values['trials'])),
        ('evaluations', f'{values["evaluations"]} ({values["simulations"]} simulations) '
                        f'in {number(values["seconds"])} s'),
        ('search', f'{values["search"] or "-"}, seed {"-" if values["seed"] is None else values["seed"]}'),
        ('engine', values['engine'])]
    other = values['confirmation']
    if other is not None:
        facts.append((
            f'confirmed by {other["engine"]}',
            f'difference score {number(other["score"])} cm, '
            f'mean error {measured(other["mean_error_m"], "m")}; '
            f'points {measured(other["mean_distance_m"], "m")} from those of {values["engine"]}, '
            f'{measured(other["max_distance_m"], "m")} at most'))
    return [*facts, ('ended', values['stop_reason'])]


DRAWS = 200  # of the posterior, for an interval


def rest_shape_sentences(result: CalibrationResult) -> list[str]:
    """Say how curved a DLO is when nothing bends it, and where; nothing if that is not known."""
    names = [name for name in knot_names(result.space.knots) if name in result.parameters]
    if not names or result.unusable:
        return []
    from dlo_calibration.planning.dlo import Posterior  # the planner comes with it, which few results need

    places = np.linspace(0, 1, 101)
    size = np.hypot(*natural_curvature(result.physical(), places).T)
    most = int(size.argmax())
    drawn = [float(np.hypot(*natural_curvature(draw, places[most:most + 1])[0]))
             for draw in Posterior.of(result).draws(DRAWS, seed=0)]
    low, high = np.percentile(drawn, (5, 95)).tolist()
    verdicts = Counter(result.parameters[name].verdict for name in names)
    shares = [f'{verdicts[verdict]} {words}' for verdict, words in (
        (IDENTIFIABLE, 'are known well'), (WEAK, 'only roughly'),
        (NOT_IDENTIFIABLE, 'could not be determined')) if verdicts[verdict]]
    return [
        'When nothing bends it, the DLO is curved: most at '
        f'{number(100 * places[most])} % of its length, by {_with_radius(size[most])}, with 90 % probability '
        f'{interval(low, high, "1/m")}; least at {number(100 * places[size.argmin()])} %, by '
        f'{measured(size.min(), "1/m")}.',
        f'Of the {len(names)} components of this rest shape, {names[0]} to {names[-1]}, '
        f'{", ".join(shares)}.', *_askew(result)]


def _askew(result: CalibrationResult) -> list[str]:
    """Say how askew the DLO stands in each clamp where that is known."""
    physical, known = result.physical(), []
    for clamp, names in (('first', CLAMP_BENDS[:2]), ('second', CLAMP_BENDS[2:])):
        bend = math.degrees(math.hypot(*(physical.get(name, 0.0) for name in names)))
        if bend and any(_verdict(result, name) != NOT_IDENTIFIABLE for name in names):
            known.append(f'{number(bend)} degrees in the {clamp}')
    return [f'It stands askew in its clamps: by {" and ".join(known)}.'] * bool(known)


def friction_sentences(result: CalibrationResult) -> list[str]:
    """Say how much of a bend the DLO keeps; nothing if it keeps none, or if that is not known."""
    if not keeps_bends(result):
        return []
    physical, unsure = result.physical(), _verdict(result, 'bending_friction') == WEAK
    slips = '' if _verdict(result, 'bending_slip') == NOT_IDENTIFIABLE else (
        f'; they slip where the curvature changes by more than {measured(physical["bending_slip"], "1/m")}')
    stiffer = '' if not physical[LOCKING] or _verdict(result, LOCKING) == NOT_IDENTIFIABLE else (
        f' Bent to a radius of {measured(physical[LOCKING], "m")}, it is twice as stiff.')
    return [f'Bent far and released, the DLO {"may keep" if unsure else "keeps"} a curvature of up to '
            f'{_with_radius(kept_curvature(physical["bending_friction"], physical[LOCKING]))}, because its '
            f'strands rub on each other{slips}.{stiffer}']


def keeps_bends(result: CalibrationResult) -> bool:
    """Return whether it is known that there is friction between the strands."""
    return result.physical().get('bending_friction', 0.0) > 0 and \
        _verdict(result, 'bending_friction') != NOT_IDENTIFIABLE


def _verdict(result: CalibrationResult, name: str) -> str:
    """Return the verdict on a calibrated parameter; empty for others."""
    return result.parameters[name].verdict if name in result.parameters else ''


def _with_radius(curvature: float) -> str:
    return f'{measured(curvature, "1/m")} (a radius of {measured(1 / curvature, "m")})' if curvature > 0 \
        else measured(curvature, '1/m')


FLAT = 1e-3  # m; a hand that rises by less stays on the table; less if the DLO is short


def plan_sentences(plan: Plan) -> list[str]:
    """Return sentences on the actions, whether they reach the goal or why the search ended, and warnings."""
    steps = []
    for k, action in enumerate(plan.actions, start=1):
        hands = '; '.join(_hand(plan.start, hand, 'drags', 2, corners=True) for hand in action.action.hands)
        steps.append(f'{k}. {action.name}: {hands}; then the points are '
                     f'{distance(plan, action.predicted)} from the goal on average.'
                     f'{_borne(plan.start, action.loads)}')
    ended = [] if plan.reached else [f'The search ended: {plan.stop_reason}.']
    return [*steps, outcome(plan), *ended, *map(_sentence, plan.warnings)]


def _sentence(words: str) -> str:
    """Return words that begin with a capital letter and end with a full stop."""
    return f'{words[:1].upper()}{words[1:].removesuffix(".")}.'


def distance(plan: Plan, points: Floats) -> str:
    """Say how far points, (n, 3) [m], are from the goal on average, in mm and in percent of the length."""
    return of_length(plan, float(np.linalg.norm(points - plan.goal.points, axis=1).mean()))


def of_length(plan: Plan, error: float) -> str:
    """Return a distance [m] in mm and in percent of the length."""
    return f'{measured(error, "m")} ({number(100 * error / plan.start.length)} %)'


def outcome(plan: Plan) -> str:
    """Say whether the goal is reached, with how many actions, and how near it gets."""
    tolerance = f'the tolerance of {of_length(plan, plan.tolerance)}'
    if not plan.actions and plan.reached:
        return f'The DLO is at the goal already: {of_length(plan, plan.error_before)}, within {tolerance}.'
    if not plan.actions:
        return (f'The goal is not reached, and no action is planned: the DLO stays '
                f'{of_length(plan, plan.error_before)} away, beyond {tolerance}.')
    count = f'{len(plan.actions)} action{"" if len(plan.actions) == 1 else "s"}'
    change = (f'the mean error goes from {of_length(plan, plan.error_before)} to '
              f'{of_length(plan, plan.error_after)}')
    score = f'the difference score is {number(plan.score_after)} cm (below {SIMILAR:g}: similar)'
    if plan.reached:
        return f'The goal is reached with {count}: {change}, within {tolerance}; {score}.'
    return f'The goal is not reached: with {count}, {change}, beyond {tolerance}; {score}.'


def prediction_sentences(prediction: Prediction) -> list[str]:
    """Return a sentence for each action, and the warnings."""
    length = prediction.start.length
    return [*(f'{k}. {step.name}: {_hands(prediction.start, step)}; then the first point is at '
              f'{_place(step.chain[0], length)} m, the last one at {_place(step.chain[-1], length)} m, and '
              f'the 90 % intervals are {width(step)} wide on average'
              f'{"" if step.settled else "; the DLO did not come to rest"}.'
              f'{_borne(prediction.start, step.loads)}'
              for k, step in enumerate(prediction.steps, start=1)), *prediction.warnings]


def _borne(start: Chain, loads: ActionLoads | None) -> str:
    """Say what the DLO bears in an action, after a blank; nothing if it is unknown."""
    if loads is None:
        return ''
    bend, pull, _ = (f'{place / start.length:.2f} of the length' for place in loads.places)
    radius = loads.least_bend_radius
    bent = f'bends to a radius of {measured(radius, "m")} at {bend}' if radius < np.inf else 'stays straight'
    return (f' It {bent}, and bears up to {measured(loads.most_tension, "N")} at {pull}, a strain of '
            f'{number(100 * loads.most_strain)} %.')


def width(step: PredictedStep) -> str:
    """Say how wide the 90 % interval of a coordinate is, on average over all points."""
    return measured(float((step.upper - step.lower).mean()), 'm')


def _hands(start: Chain, step: PredictedStep) -> str:
    """Say what the hands do."""
    held_by, hands = step.step.held_by, step.step.action.hands
    after = ['holds it' if hand.name in held_by else 'opens' for hand in hands]
    return '; '.join(f'{hand.name} {end}' if len(hand.times) == 1 else _hand(start, hand, 'moves', 3, end)
                     for hand, end in zip(hands, after, strict=True))


def _hand(start: Chain, hand: Hand, on_the_table: str, axes: int, after: str = 'opens',
          corners: bool = False) -> str:
    """
    Say what a hand does.

    :param on_the_table: what it does where it does not lift the DLO.
    :param axes: number of coordinates to name of the place that it goes to.
    :param after: what it does there.
    :param corners: whether to name the places where its way turns, seen from above.
    """
    places, rise = start.arc_lengths(), float(hand.positions[:, 2].max() - hand.positions[0, 2])
    flat = in_proportion(FLAT, float(places[-1]))
    way = f'lifts {number(100 * rise)} cm, carries' if rise > flat else on_the_table
    grip = grip_place(places, hand.grips[0], hand.offset) / places[-1]
    turns = [place for place in hand.positions[1:-1, :axes] if corners and not np.isclose(
        place[:2], hand.positions[[0, -1], :2]).all(axis=1).any()]
    past = f'past {", ".join(_place(turn, places[-1]) for turn in turns)} ' if turns else ''
    return (f'{hand.name} grips at {grip:.2f} of the length, {way} it {past}to '
            f'{_place(hand.positions[-1, :axes], places[-1])} m and {after}')


def _place(point: Floats, length: float) -> str:
    """Return a place, (2,) or (3,) [m], in words; `length` of the DLO [m]."""
    digits = 3 + max(0, math.ceil(math.log10(SHORT / length)))
    rounded = point.round(digits) + 0.0  # no -0.000
    return f'({", ".join(f"{coordinate:.{digits}f}" for coordinate in rounded)})'
