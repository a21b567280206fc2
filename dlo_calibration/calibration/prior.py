# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The prior of a calibration: estimates of the parameters from the observed chains alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Sequence

import numpy as np

from dlo_calibration.calibration.options import Options
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import BY_NAME, HANDS, LOCKING, ParameterSpace, SCALE
from dlo_calibration.model.trial import Trial
from dlo_calibration.observation.estimate import start_point
from dlo_calibration.observation.excitation import excites
from dlo_calibration.observation.grips import GripEvidence
from dlo_calibration.search import Hints

#: Physical values of a cable in SI units. Half of the start points of a search take them and differ only in
#: stiffness: from random points, a search among many parameters rarely finds the friction between strands,
#: because strong damping explains the trials nearly as well.
CABLE = {'elasticity': 100.0, 'damping': 0.3, 'internal_damping': 0.004, 'torsion': 2 / 3,
         'bending_friction': 1.0, 'bending_slip': 0.5, LOCKING: 0.1}

#: The parameter of the radius, which the height of the resting DLO gives even without self-contact.
GUESSED = 'self_collision'


@dataclass(frozen=True)
class Prior:
    """
    What is known before the first simulation.

    :param space: the parameters to find; those in `guessed` have an estimate as their default.
    :param hints: for the search.
    :param guessed: names of the parameters whose default was replaced.
    """

    space: ParameterSpace
    hints: Hints
    guessed: tuple[str, ...] = ()

    @classmethod
    def of(cls, trials: Sequence[Trial], options: Options, evidence: GripEvidence | None = None) -> Prior:
        """
        Return the prior of the parameters to find, from the observed chains alone.

        :param evidence: what the trials show of the hands, if it is known already.
        """
        evidence = evidence or GripEvidence.of(trials)
        space, height = options.space, options.table_top
        shown = np.logical_or.reduce(excites(trials, space, height))
        start = _with_cable(space, start_point(trials, space, height))
        for name, value in evidence.estimates.items():
            if name in space.free:
                start[space.free.index(name)] = BY_NAME[name].coordinate(value)
        hints = Hints(start, shown & [name not in HANDS or name in evidence.estimates for name in space.free],
                      upper=space.upper, middle=np.where(np.isnan(start), space.default_point(), start))
        default = BY_NAME[GUESSED].default
        if GUESSED not in space.free or space.fixed.get(GUESSED, default) != default:
            return cls(space, hints)
        radius = space.values(hints.start)[GUESSED]
        if not 0 <= radius <= SCALE:
            return cls(space, hints)
        return cls(replace(space, fixed={**space.fixed, GUESSED: radius}), hints, (GUESSED,))


def _with_cable(space: ParameterSpace, start: Floats) -> Floats:
    """Return the (d,) prior estimate, with values of a cable if friction between strands is calibrated."""
    if 'bending_friction' not in space.free:
        return start.copy()
    cable = np.array([BY_NAME[name].coordinate(CABLE[name]) if name in CABLE else np.nan
                      for name in space.free])
    return np.asarray(np.where(np.isnan(start), cable, start))
