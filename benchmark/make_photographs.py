# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Make the photographs of msg_samples: two trials of a rope whose properties are known.

    python benchmark/make_photographs.py [FOLDER]

Three photographs: the start of the first trial, its goal, which is the start of the second, and the goal of
the second.  The rope is simulated with a fine model, and rendered with the printed board beside it.  The
truth, and what the hand did, is in truth.json.
"""

from __future__ import annotations

from dataclasses import replace
import json
import math
from pathlib import Path
import re
import sys
from typing import Any, Sequence

import numpy as np
from PIL import Image
from scipy.interpolate import CubicSpline

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / 'test' / 'support'))

from laid_board import LaidBoard  # noqa: E402
from photographs import Camera, Look, photograph, Sheet  # noqa: E402

from dlo_calibration.calibration.engines import make_simulator  # noqa: E402
from dlo_calibration.calibration.options import Options  # noqa: E402
from dlo_calibration.model.action import Action  # noqa: E402
from dlo_calibration.model.chain import Chain, Floats  # noqa: E402
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, NamedAction  # noqa: E402
from dlo_calibration.model.parameters import BY_NAME  # noqa: E402
from dlo_calibration.model.trial import Goal, Trial  # noqa: E402

NAMES = ('first', 'second', 'third')
LENGTH, RADIUS, MASS = 0.6, 0.004, 0.03  # m, m, kg
TRUTH = {'flexibility': 76.4615, 'elasticity': 45.0, 'friction': 70.0, 'self_collision': 25.6}  # 0..100
FINE = {'mass': MASS, 'engine': 'compiled', 'nodes': 121, 'time_step': 0.001}
WAIT = 0.5  # s, after the hand has opened
#: How the rope came to lie as in the first photograph, from straight; then the two trials.
BEFORE = (GraspAndPlace(fraction=1.0, to=(0.53, 0.10, RADIUS)),
          Drag(fraction=0.3, direction=(0, -1, 0), distance=0.05))
TRIALS = (Drag(fraction=0.4, direction=(0.1, 1, 0), distance=0.12),
          GraspAndPlace(fraction=1.0, direction=(-0.1, 0.12, 0), distance=0.156, height=0.1))

#: Directions of the photographs: a turn by ASLANT against the rope's straight line, before all actions.
ASLANT = math.radians(-20)
BOARD = LaidBoard((0.395, -0.289), ASLANT + math.radians(2))
STICKER, STICKER_COLOUR = 0.016, (250, 225, 60)  # m, side of a piece of paper that says where the hand opened
SIZE, WIDE = (2400, 1800), 26.0  # px; focal length [mm] that would give the same view on film of 36 x 24 mm
FOCAL = WIDE * math.hypot(*SIZE) / math.hypot(36, 24)  # px
LENS = (0.02, -0.03, 0.0, 0.0, 0.0)
#: tilt, turn, roll [degrees], distance [m] and target [m] of each photograph: a telephone, held by hand
VIEWS = ((20, 3, 1.5, 0.62, (0.355, 0.01)), (22, -4, -1.0, 0.63, (0.36, 0.0)),
         (19, 6, 0.5, 0.63, (0.35, 0.01)))
LOOK = Look(ground='wood', ground_colour=(0.72, 0.55, 0.38), ground_contrast=0.10, colour=(0.10, 0.24, 0.55),
            second_colour=(0.80, 0.82, 0.86), pattern='braided', pitch=0.022, highlight=0.25,
            lamp=(2.3, 0.95), shadow=0.5, noise=2.0, blur=0.6)


def moved(points: Floats, named: NamedAction) -> tuple[Floats, Action]:
    """Return where points of the rope (n, 3) [m] lie after an action, and the way of the hand."""
    chain, options = Chain(points), Options.of(FINE)
    action = named.action(chain)
    goal = Goal(chain, max(hand.end for hand in action.hands) + WAIT)
    simulator = make_simulator(options)
    chains = simulator.simulate(Trial(named.name, chain, (action,), (goal,)),
                                options.space.physical(TRUTH, LENGTH)).chains
    simulator.close()
    return chains[0], action


def shapes() -> tuple[list[Floats], list[Action]]:
    """Return the shapes (121, 3) [m] of the rope in the photographs, and what the hand did between them."""
    points = np.zeros((121, 3))
    points[:, 0], points[:, 2] = np.linspace(0.0, LENGTH, len(points)), RADIUS
    for named in BEFORE:
        points, _ = moved(points, named)
    lying, actions = [points], []
    for named in TRIALS:
        points, action = moved(lying[-1], named)
        lying.append(points)
        actions.append(action)
    return lying, actions


def exact_trials() -> tuple[Trial, ...]:
    """Return the trials as they are, without photographs."""
    lying, actions = shapes()
    chains = [Chain(Chain(points).resample(np.linspace(0.0, Chain(points).length, 21))) for points in lying]
    trials = []
    for named, before, after, action in zip(TRIALS, chains[:-1], chains[1:], actions, strict=True):
        hands = tuple(replace(hand, grips=(round((named.fraction or 0.0) * 20),)) for hand in action.hands)
        trials.append(Trial(named.name, before, (Action(hands),), (Goal(after, action.hands[0].end + WAIT),)))
    return tuple(trials)


def camera(number: int) -> Camera:
    """Return the camera of one of the photographs."""
    tilt, turn, roll, distance, target = VIEWS[number]
    return Camera(SIZE, FOCAL, math.radians(tilt), ASLANT + math.radians(turn), math.radians(roll), distance,
                  target, LENS)


def sticker(place: Floats) -> Sheet:
    """Return a piece of paper with its middle at a place (x, y) [m]."""
    side = np.full((8, 8, 3), STICKER_COLOUR, dtype=np.uint8)
    return Sheet(side, (STICKER, STICKER), (place[0] - STICKER / 2, place[1] - STICKER / 2))


def photograph_of(number: int, points: Floats, opened: Sequence[Floats]) -> np.ndarray[Any, Any]:
    """
    Return one of the photographs, as pixels.

    :param opened: places where the hand let go so far (x, y) [m], each with a sticker.
    """
    along = np.linspace(0.0, 1.0, len(points))
    curve = CubicSpline(along, points)(np.linspace(0.0, 1.0, 601))
    sheets = (BOARD.sheet, *map(sticker, opened))
    pixels: np.ndarray[Any, Any] = photograph(camera(number), curve, RADIUS,
                                              replace(LOOK, sheets=sheets), seed=13)
    return pixels


def truth(lying: Sequence[Floats], actions: Sequence[Action]) -> dict[str, Any]:
    """Return what is true of the rope and its trials; places are in the board's frame [m]."""
    def places(points: Floats) -> list[list[float]]:
        return np.round(BOARD.seen_from(points), 5).tolist()

    def few(points: Floats) -> list[list[float]]:
        chain = Chain(points)
        return places(chain.resample(np.linspace(0.0, chain.length, 21)))

    parameters = {name: {'value': value, 'physical_value': float(f'{BY_NAME[name].physical(value):.4g}'),
                         'physical_unit': BY_NAME[name].unit} for name, value in TRUTH.items()}
    return {'length_m': LENGTH, 'diameter_m': 2 * RADIUS, 'mass_kg': MASS, 'parameters': parameters,
            'photographs': {f'{name}.jpg': few(points) for name, points in zip(NAMES, lying, strict=True)},
            'trials': [{'start': f'{NAMES[k]}.jpg', 'goal': f'{NAMES[k + 1]}.jpg', 'action': named.name,
                        'fraction': named.fraction, 'hand': places(action.hands[0].positions),
                        'times_s': np.round(action.hands[0].times, 3).tolist()}
                       for k, (named, action) in enumerate(zip(TRIALS, actions, strict=True))]}


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the photographs and the truth."""
    given = sys.argv[1:] if arguments is None else arguments
    folder = Path(given[0]) if given else HERE.parent / 'msg_samples/photographs'
    folder.mkdir(exist_ok=True)
    lying, actions = shapes()
    opened = [action.hands[0].positions[-1] for action in actions]
    for number, name in enumerate(NAMES):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xa405] = round(WIDE)  # FocalLengthIn35mmFilm
        pixels = photograph_of(number, lying[number], opened[:number])
        Image.fromarray(pixels).save(folder / f'{name}.jpg', quality=85, exif=exif)
    text = json.dumps(truth(lying, actions), indent=1)
    text = re.sub(r'\[\s+([-\d.,\s]+?)\s+\]', lambda match: f'[{" ".join(match[1].split())}]', text)
    (folder / 'truth.json').write_text(f'{text}\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
