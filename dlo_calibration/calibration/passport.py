# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Passport: who measured a DLO, when, in which sessions, and what calibrated it."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field
import datetime
import functools
from importlib.metadata import PackageNotFoundError, version
import math
from types import MappingProxyType
from typing import Mapping

import numpy as np

from dlo_calibration.calibration.engines import make_simulator
from dlo_calibration.calibration.options import Options
from dlo_calibration.evaluation.digest import digest
from dlo_calibration.model.action import Action, Hand
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import ParameterSpace
from dlo_calibration.model.trial import Goal, Trial

LEAST_STAMP = 946684800  # s: stamps before the year 2000 are those of a clock that counts from its start
BENDING = 0.1 * math.pow(10**-5.5 / 0.1, 0.5)  # N m^2, EI of the rope: bit for bit that of earlier versions
RESOLUTION = 1e-9  # m; the engine gives the same bits everywhere, and a DLO does not show less


@dataclass(frozen=True)
class Passport:
    """
    Where a result comes from.

    :param by: who measured; may be empty.
    :param measured: the day of the first message, YYYY-MM-DD; empty: the stamps do not say.
    :param calibrated: the day of the calibration.
    :param version: of this package.
    :param engine: what `engine_version` returned.
    :param sessions: the SHA-256 of each recorded file, by its name.
    """

    by: str = ''
    measured: str = ''
    calibrated: str = ''
    version: str = ''
    engine: str = ''
    sessions: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, 'sessions', MappingProxyType(dict(self.sessions)))

    @classmethod
    def new(cls, by: str, stamp: float = 0.0, sessions: Mapping[str, str] = MappingProxyType({})) -> Passport:
        """
        Return the passport of a calibration that this process has made today.

        :param stamp: of the first message [s since 1970]; 0: unknown.
        """
        measured = _day(stamp) if LEAST_STAMP < stamp < 2**33 else ''
        today = datetime.datetime.now(datetime.timezone.utc).date().isoformat()
        return cls(by, measured, today, package_version(), engine_version(), sessions)

    @property
    def warning(self) -> str:
        """What to know before the result is used with this version; empty if its engine is the same."""
        if not self.engine or self.engine == engine_version():
            return ''
        return (f'the result is of another version of the engine ({self.version or "unknown"}, engine '
                f'{self.engine}; here {package_version()}, engine {engine_version()}): the same parameters '
                'may move it a little differently; fit its session again')

    @property
    def words(self) -> str:
        """The passport in one sentence; empty if there is none."""
        if not self.version:
            return ''
        who = f' by {self.by}' * bool(self.by) + f' on {self.measured}' * bool(self.measured)
        when = f'measured{who}, ' * bool(who)
        files = f', from {", ".join(self.sessions)}' if self.sessions else ''
        return f'The result: {when}calibrated on {self.calibrated} with version {self.version}{files}.'


UNKNOWN = Passport()


def _day(stamp: float) -> str:
    return datetime.datetime.fromtimestamp(stamp, datetime.timezone.utc).date().isoformat()


def package_version() -> str:
    """Return the version of this package."""
    try:
        return version('dlo_calibration')
    except PackageNotFoundError:
        return 'not installed'


@functools.cache
def engine_version() -> str:
    """
    Return what identifies the physics of the engine: a digest of a rope's motion.

    The end of a rope is lifted, laid across the rope, and the rope is seen in motion and at rest.  Versions
    that move it alike are the same, whatever else has changed.
    """
    along = np.linspace(0.0, 0.6, 13)
    initial = Chain(np.column_stack([along, 0.02 * np.sin(9 * along), np.full(13, 0.005)]))
    path = initial.points[0] + np.array([[0, 0, 0], [0.15, 0.1, 0.1], [0.35, 0.0, 0.012]])
    trial = Trial('rope', initial, (Action((Hand('hand', (0,), np.array([0.1, 0.5, 0.9]), path),)),),
                  (Goal(initial, 0.5, stable=False, held_by=('hand',)), Goal(initial, 1.0)))
    fixed = {'internal_damping': 20.0, 'natural_curvature': 10.0, 'bending_friction': 30.0, 'torsion': 40.0}
    physical = {**ParameterSpace(fixed=fixed, mass=0.03).physical({}, 0.6), 'flexibility': BENDING}
    with closing(make_simulator(Options(engine='compiled', settle_limit=1.0))) as simulator:
        chains = simulator.simulate(trial, physical).chains
    return digest(np.round(chains / RESOLUTION))[:8]
