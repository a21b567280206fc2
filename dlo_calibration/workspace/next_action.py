# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""advise(): the action that hands should do next, so that the wanted parameters become certain."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
import math
from typing import Callable, Sequence

import numpy as np

from dlo_calibration.calibration.choice import choose
from dlo_calibration.calibration.engines import make_simulator as make_chosen_simulator
from dlo_calibration.calibration.engines import obstacles_of, SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import InputError
from dlo_calibration.evaluation.evaluation import mean_length
from dlo_calibration.evaluation.pool import Pool, Threads
from dlo_calibration.inference.draws import drawn_points
from dlo_calibration.inference.expectation import Expectation, MOST_TRIALS, REACHED
from dlo_calibration.inference.target import wanted_deviations
from dlo_calibration.inference.uncertainty import DEVIATIONS
from dlo_calibration.model.action import Action
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import BY_NAME, extents, SCALE
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.noise import noise_of
from dlo_calibration.observation.table import lying_level
from dlo_calibration.planning.inquiry import Inquiries, Inquiry
from dlo_calibration.planning.options import AdviceOptions
from dlo_calibration.planning.surroundings import Surroundings
from dlo_calibration.workspace.live_information import appraise, Appraised

NODES, TIME_STEP = 21, 0.004  # of the simulation that seeks; a coarse one tells the actions apart
FEW, MANY = 4, 6  # draws that all actions, and that the best ones, are simulated with
BEST = 3  # actions whose displacements are refined
BESIDE = 4  # displacements that are tried beside each of them
TRIED = 4  # actions at a time that are checked against the limits
ERRORS = 3.0  # times the noise, that the chains before and after an action, and grips, have together
MODEL_ERROR = 5e-3  # share of the length by which a simulation with the right parameters misses, likewise
LEAST_TRUST = 0.1  # in derivatives, where trials told less than a linear model with white errors says
LEAST_TRIALS = 2  # one alone does not show what differs from trial to trial, such as errors of grips
TOLD_AFTER = 2  # trials after which a parameter that no action shows is given up
CLEAR = 0.25  # of a standard deviation that a single action must leave at most
SHOWN = 0.5  # of a standard deviation that all foreseen trials leave: if they leave more, none shows it


@dataclass(frozen=True, eq=False)
class NextAction:
    """
    The action to do next, or why there is none.

    :param names: of the d parameters.
    :param std: (d,) their present standard deviations in units of a search.
    :param wanted: (d,) those to reach; inf: any.
    :param expected: (d,) those after the action.
    :param action: the paths of the hands; None: the calibration is at its end.
    :param words: what the hands do, or why there is nothing to do.
    :param pause: when the hands wait and the DLO is observed, (begin, end) [s]; None: they do not wait.
    :param trials: how many trials are left, as far as can be foreseen.
    :param hopeless: names of wanted parameters that no permitted action makes certain enough.
    :param reached: whether all wanted parameters are certain enough.
    """

    names: tuple[str, ...]
    std: Floats
    wanted: Floats
    expected: Floats
    action: Action | None = None
    words: str = ''
    pause: tuple[float, float] | None = None
    trials: int = 0
    hopeless: tuple[str, ...] = ()
    reached: bool = False

    @classmethod
    def failed(cls, names: tuple[str, ...], why: str) -> NextAction:
        """Return no action, because of an error."""
        unknown = np.full(len(names), np.inf)
        return cls(names, unknown, unknown, unknown, words=why)

    @property
    def complete(self) -> bool:
        """Whether the calibration is at its end: all is reached, or the rest is hopeless."""
        return self.action is None and (self.reached or bool(self.hopeless))

    @property
    def distances(self) -> dict[str, tuple[float, float, float]]:
        """The half widths of the 90 % intervals on the 0..100 scale: present, expected, wanted; by name."""
        widths = DEVIATIONS * np.stack([self.std, self.expected, self.wanted], axis=1)
        widths = widths * (SCALE / extents(self.names))[:, None]
        return {name: (now, then, wanted) for name, (now, then, wanted) in zip(
            self.names, widths.tolist(), strict=True) if math.isfinite(wanted)}


def advise(trials: Sequence[Trial], options: Options, limits: AdviceOptions, *, start: Chain | None = None,
           make_simulator: SimulatorFactory = make_chosen_simulator,
           should_stop: Callable[[], bool] = lambda: False) -> NextAction:
    """
    Return the action to do next: of those that the hands may do, the one that tells most.

    The same trials, options and limits give the same action.

    :param trials: so far; none: only the prior is known.
    :param start: the DLO at rest; None: as the last trial left it.
    :raises InputError: if there is no start, or a parameter is wanted that is not calibrated.
    :raises CancelledError: once `should_stop` is True.
    """
    options = choose(trials, options).options
    appraised = appraise(make_simulator, trials, options, should_stop=should_stop)
    return next_action(appraised, options, limits, resting(trials) if start is None else start,
                       make_simulator, should_stop)


def resting(trials: Sequence[Trial]) -> Chain:
    """
    Return where the DLO rests after the last trial.

    :raises InputError: if that is unknown.
    """
    goal = trials[-1].goals[-1] if trials else None
    if goal is None or not goal.stable or goal.held_by:
        raise InputError('advice', 'no DLO at rest that no hand holds', 'one', 'send an initial_chain')
    return goal.chain


def next_action(appraised: Appraised, options: Options, limits: AdviceOptions, start: Chain,
                make_simulator: SimulatorFactory, should_stop: Callable[[], bool] = lambda: False
                ) -> NextAction:
    """
    Return the action to do next, from what the trials said; see `advise`.

    :param options: decided, see `choose`.
    """
    space, appraisal = options.space, appraised.appraisal
    wanted, std = wanted_deviations(limits.wanted, space), appraisal.uncertainty.std
    nothing = NextAction(space.free, std, wanted, std)
    if (std <= wanted).all():
        if len(appraised.trials) >= LEAST_TRIALS:
            return replace(nothing, words='each wanted parameter is certain enough', reached=True)
        wanted = np.minimum(wanted, std / 2)  # to choose the second trial
    if not start.seen.all():
        start = start.interpolated(start.arc_lengths())
    level = lying_level(start, options.table_height) if options.table else None
    if level is None:
        return replace(nothing, words='the DLO does not lie on the table, and only there is advice given')
    coarse = replace(options, nodes=min(options.nodes, NODES), time_step=max(options.time_step, TIME_STEP))
    inquiries = Inquiries(start, level, limits, Surroundings.of(
        obstacles_of(options), limits.clearance, start.points))
    with closing(make_simulator(coarse)) as simulator, closing(Threads(options.workers)) as threads:
        seeker = _Seeker(Pool(simulator, threads, should_stop), appraised, options, inquiries, nothing,
                         wanted)
        return seeker.found()


class _Seeker:
    """Seeks the action that tells most."""

    def __init__(self, pool: Pool, appraised: Appraised, options: Options, inquiries: Inquiries,
                 nothing: NextAction, wanted: Floats) -> None:
        self._wanted = wanted
        self._pool, self._space, self._inquiries, self._nothing = pool, options.space, inquiries, nothing
        self._point, self._uncertainty = appraised.appraisal.point, appraised.appraisal.uncertainty
        self._count, self._seed = len(appraised.trials), options.seed
        start = inquiries.start
        self._length = mean_length(appraised.trials) if appraised.trials else start.length
        # The next trial is as likely to resemble those so far in this as not: half of it, in logarithms.
        self._trust = np.clip(appraised.appraisal.promised / self._uncertainty.std, LEAST_TRUST**2, 1.0)**0.5
        self._noise = float(np.nan_to_num(noise_of([start.points[None]])))
        self._scale = float(np.hypot(ERRORS * self._noise, MODEL_ERROR * self._length))
        self._draws = [self._space.physical(self._space.values(point), self._length)
                       for point in self._points(FEW)]

    def _points(self, count: int) -> Floats:
        return drawn_points(self._point, self._uncertainty, count, self._seed)

    def _expectation(self, inquiries: Sequence[Inquiry], count: int, wanted: Floats) -> Expectation:
        return Expectation.of([inquiry.trial for inquiry in inquiries], self._space, self._pool,
                              self._points(count), self._uncertainty, self._scale, self._length, wanted,
                              self._noise, trust=self._trust, finer=self._pool.refined())

    def found(self) -> NextAction:
        """Return the next action."""
        nothing, wanted = self._nothing, self._wanted
        coarse = self._inquiries.coarse()
        expectation = self._expectation(coarse, FEW, wanted)
        left, then = expectation.foreseen()
        far = (nothing.std > wanted) & (then > REACHED * wanted)
        if self._count < MOST_TRIALS:
            far &= then > SHOWN * nothing.std
        # What earlier trials left unknown, though they promised to show some of it, needs a clear view.
        single = np.array([expectation.expected(k) for k in np.flatnonzero(expectation.possible).tolist()])
        far |= self._uncertainty.unknown & (nothing.std > wanted) & (
            single.min(axis=0, initial=np.inf) > CLEAR * nothing.std)
        if self._count >= TOLD_AFTER and far.any():
            wanted = np.where(far, np.inf, wanted)
            nothing = replace(nothing, hopeless=tuple(np.array(nothing.names)[far].tolist()))
            if (nothing.std <= wanted).all():
                return replace(nothing, words=self._why(then))
            expectation = replace(expectation, wanted=wanted)
            left, _ = expectation.foreseen()
        if (nothing.std <= nothing.wanted).all():
            left = 1  # only to see whether it agrees
        ranked = [coarse[k] for k in expectation.ranked]
        refined, finer = self._refined(ranked[:BEST], wanted)
        places = {id(inquiry): k for k, inquiry in enumerate(refined)}
        for inquiry in self._permitted([*(refined[k] for k in finer.ranked), *ranked[BEST:]]):
            if id(inquiry) not in places:
                finer = self._expectation([inquiry], MANY, wanted)
                places = {id(inquiry): 0}
            expected = finer.expected(places[id(inquiry)])
            return replace(nothing, action=inquiry.action, pause=inquiry.pause, expected=expected,
                           words=inquiry.words(self._inquiries.start), trials=max(left, 1))
        tidying = self._inquiries.tidying(self._pool, self._draws)
        if tidying is not None:
            return replace(nothing, action=tidying.action, trials=max(left, 1), words='only to lay the DLO '
                           f'where it can be moved: {tidying.words(self._inquiries.start)}')
        return replace(nothing, words=self._why(then))

    def _refined(self, ranked: Sequence[Inquiry], wanted: Floats) -> tuple[list[Inquiry], Expectation]:
        """Return the best actions with changed displacements, and what they would tell."""
        generator = np.random.default_rng(self._seed)
        tried = list(ranked)
        expectation = self._expectation(tried, MANY, wanted)
        for best in (BEST, 1):
            leading = [tried[k] for k in expectation.ranked[:best]]
            others = [other for inquiry in leading
                      for other in self._inquiries.beside(inquiry, BESIDE * BEST // best, generator)]
            more = self._expectation(others, MANY, wanted)
            tried += others
            expectation = expectation.with_others(more)
        return tried, expectation

    def _permitted(self, ranked: Sequence[Inquiry]) -> list[Inquiry]:
        """Return the first permitted action alone, as a list; none if there is none."""
        for first in range(0, len(ranked), TRIED):
            some = ranked[first:first + TRIED]
            refusals = self._inquiries.refused(some, self._pool, self._draws)
            for inquiry, refusal in zip(some, refusals, strict=True):
                if not refusal:
                    return [inquiry]
        return []

    def _why(self, then: Floats) -> str:
        """Say why there is no action: which parameters no permitted action shows well enough."""
        nothing, words = self._nothing, []
        for name, now, after, wanted in zip(nothing.names, nothing.std, then, nothing.wanted, strict=True):
            if now > wanted and after > REACHED * wanted:
                scale = SCALE / BY_NAME[name].extent
                ends = [f'{DEVIATIONS * scale * each:.1f}' for each in (now, after, wanted)]
                words.append(f'{name}: ± {ends[0]} of 100 now, ± {ends[1]} after {MOST_TRIALS} more trials, '
                             f'± {ends[2]} is wanted')
        said = sorted(self._inquiries.refusals, key=lambda text: -self._inquiries.refusals[text])[:2]
        return '; '.join([f'no permitted action makes certain enough what is wanted: {"; ".join(words)}'
                          if words else 'no action is permitted', *said])
