# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The options of hands, of a plan and of advice, declared once, here; see `calibration.options`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from dlo_calibration.calibration.options import declared, DeclaredOptions, MACHINE, SEARCH
from dlo_calibration.errors import InputError
from dlo_calibration.inference.target import read_targets
from dlo_calibration.model.chain import in_proportion, SHORT
from dlo_calibration.planning.limits import HANDS, Limits, REACH

KINDS = ('grasp_and_place', 'drag')  # of actions
POINTS, SCORE = 'points', 'score'  # objectives
LIFT, SPEED = 0.05, 0.1  # m, m/s; of a DLO that is not short
SLOWEST = 1e-4  # m/s


@dataclass(frozen=True)
class HandOptions(DeclaredOptions):
    """What hands may do, and where they and the DLO may be."""

    hands: int = declared(1, 'number of hands, hand_1 and hand_2; two act at the same time', minimum=1,
                          maximum=len(HANDS), of=SEARCH)
    kinds: tuple[str, ...] = declared(KINDS, 'the kinds of actions that the hands may do', choices=KINDS,
                                      of=SEARCH)
    crossings: bool = declared(False, 'whether an action may put the DLO over itself', of=SEARCH)
    height: float = declared(
        0.0, f'lift of a grasp_and_place above the higher one of its two places; 0: {LIFT:g} m, for a DLO '
        f'shorter than {SHORT:g} m a sixth of its length', unit='m', minimum=0.0, maximum=10.0, of=MACHINE)
    speed: float = declared(
        0.0, f'speed of the hands; 0: {SPEED:g} m/s, for a DLO shorter than {SHORT:g} m a third of its '
        'length a second', unit='m/s', minimum=0.0, maximum=10.0, of=MACHINE)
    reach_1: str = declared(
        '', f'where hand_1 can be: {REACH}, in the frame of the table; empty: everywhere', of=MACHINE)
    reach_2: str = declared('', 'where hand_2 can be, as reach_1', of=MACHINE)
    no_go: tuple[str, ...] = declared(
        (), "boxes that neither a hand nor the DLO may enter, each 'x0 y0 z0 x1 y1 z1', two opposite corners "
        'in metres in the frame of the table; they should be larger than what they protect by the size of '
        'the gripper, as a hand counts as a point', of=MACHINE)
    clearance: float = declared(
        0.015, 'distance that the hands keep from the bodies of a scene; the DLO may touch them', unit='m',
        minimum=0.001, maximum=1.0, of=MACHINE)
    least_bend_radius: float = declared(
        0.0, 'smallest radius to which actions may bend the DLO, e.g. that of a data sheet; at most '
        'one draw in ten may be bent more sharply; 0: any', unit='m', minimum=0.0, maximum=10.0, of=MACHINE)
    most_tension: float = declared(
        0.0, 'largest tension that actions may cause in the DLO, likewise; 0: any', unit='N', minimum=0.0,
        maximum=1e6, of=MACHINE)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.kinds or len(set(self.kinds)) < len(self.kinds):
            raise InputError('parameter kinds', f'{" ".join(self.kinds) or "no name"}',
                             'one or more different names', 'name each kind of action once')
        if 0 < self.speed < SLOWEST:
            raise InputError('parameter speed', f'{self.speed:g} m/s', f'0, or at least {SLOWEST:g} m/s',
                             'let the hands move faster')
        self.limits  # noqa: B018

    def of_length(self, length: float) -> Self:
        """Return the options for a DLO of a length [m]: lift and speed are those of its length if open."""
        return replace(self, height=self.height or in_proportion(LIFT, length),
                       speed=self.speed or in_proportion(SPEED, length))

    @property
    def limits(self) -> Limits:
        """
        Where hands and DLO may be, and what the DLO may bear.

        :raises InputError: if one of the options cannot be read.
        """
        return Limits.read(self.reach_1, self.reach_2, self.no_go, self.least_bend_radius, self.most_tension)


@dataclass(frozen=True)
class PlanOptions(HandOptions):
    """Everything that a user can set for a plan."""

    actions: int = declared(4, 'largest number of actions of a plan; fewer win if the goal is reached with '
                            'them', minimum=1, maximum=20, of=SEARCH)
    objective: str = declared(
        POINTS, "what is minimised: points, the mean distance of the points from the goal; or score, this "
        "distance and the paper's difference score per point, which counts orientation and facing",
        choices=(POINTS, SCORE), of=SEARCH)
    tolerance: float = declared(
        1.0, 'the goal is reached if the mean distance of the points from it is at most this share of the '
        'length', unit='%', minimum=0.01, maximum=100.0, of=SEARCH)
    draws: int = declared(8, 'number of draws from the posterior that a plan is judged on; 0: only on the '
                          'found parameters', minimum=0, maximum=1000, of=SEARCH)
    seed: int = declared(1, 'random seed; the same seed gives the same plan', minimum=0, maximum=2**31 - 1,
                         of=SEARCH)
    workers: int = declared(0, 'number of threads that simulate; 0: one per core', minimum=0, maximum=1024,
                            of=MACHINE)


@dataclass(frozen=True)
class AdviceOptions(HandOptions):
    """Everything that a user can set for advice, besides the options of the calibration."""

    wanted: str = declared(
        '', "how certain the parameters shall become: names and half widths of their 90 % intervals, on the "
        "0..100 scale or in percent of the physical value, e.g. 'flexibility 2, friction 3' or 'EI 5 %'; "
        'empty: each one that is calibrated shall be identifiable', of=MACHINE)
    pause: float = declared(
        2.0, 'how long the hands wait in the advised action before they put the DLO down, or open, so that '
        'it is observed there, too; 0: it is observed only after they have opened', unit='s', minimum=0.0,
        maximum=60.0, of=MACHINE)

    def __post_init__(self) -> None:
        super().__post_init__()
        read_targets(self.wanted)
