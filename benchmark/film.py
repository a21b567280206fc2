# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Track DLOs in rendered films whose truth is known, and compare.

A film shows a simulated rope and a hand that moves it, at 1920 x 1080 pixels and 30 images a second, with
shadows, blur, noise and compression; in two of ten, the camera is held in the hand.

    python benchmark/film.py [FILMS] [SECONDS]

FILMS is the number of films, 10 unless told otherwise; SECONDS is their longest duration.  The films are kept
in a temporary folder while they are tracked.
"""

from dataclasses import dataclass, replace
import math
from pathlib import Path
import resource
import sys
import tempfile
import time
from typing import Any, Iterator, Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / 'test' / 'support'))

from films import Instant, Renderer, write_film  # noqa: E402
from laid_board import LaidBoard  # noqa: E402
from photographs import Camera, Hand, Look  # noqa: E402

from dlo_calibration.calibration.engines import make_simulator  # noqa: E402
from dlo_calibration.calibration.options import Options  # noqa: E402
from dlo_calibration.model.chain import Chain, Floats  # noqa: E402
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, NamedAction  # noqa: E402
from dlo_calibration.model.trial import Goal, Trial  # noqa: E402
from dlo_calibration.vision.film import read_film  # noqa: E402
from dlo_calibration.vision.tracker import Tracker  # noqa: E402
from dlo_calibration.vision.view import BoardFinder, film_lens  # noqa: E402

FILMS = 10
RATE = 30.0  # images a second
SIZE, FOCAL = (1920, 1080), 1500.0  # px
LENGTH, RADIUS, MASS = 0.6, 0.004, 0.03  # m, m, kg
FINE = {'mass': MASS, 'engine': 'compiled', 'nodes': 121, 'time_step': 0.001}
REST, APPROACH, SETTLE = 1.2, 0.9, 0.8  # s
AWAY = 0.5  # m, from where the hand comes
EXPOSURE, SUBFRAMES = 0.008, 3  # s; instants that are averaged
COUNT = 21  # points that are compared
WRONG = 0.008  # m: farther from the DLO than its diameter is wrong
LIFTED = 0.002  # m above the table, from where on a point is not on it
LOOKS = (
    Look(ground='wood', ground_colour=(0.72, 0.55, 0.38), ground_contrast=0.1, colour=(0.10, 0.24, 0.55)),
    Look(colour=(0.75, 0.15, 0.1), lamp=(0.5, 0.7)),
    Look(ground='cloth', ground_colour=(0.22, 0.25, 0.30), colour=(0.92, 0.92, 0.90), lamp=(-1.0, 0.8)),
    Look(ground='wood', ground_colour=(0.72, 0.55, 0.38), ground_contrast=0.1, colour=(0.93, 0.93, 0.9)),
    Look(ground_colour=(0.85, 0.80, 0.72), colour=(0.12, 0.12, 0.14), lamp=(2.5, 0.7)),
)
ACTIONS: tuple[tuple[NamedAction, ...], ...] = (
    (Drag(fraction=0.4, direction=(0.1, 1, 0), distance=0.12),
     GraspAndPlace(fraction=1.0, direction=(-0.1, 0.12, 0), distance=0.156, height=0.1)),
    (Drag(fraction=1.0, direction=(-1, 1, 0), distance=0.18),
     Drag(fraction=0.5, direction=(0, -1, 0), distance=0.1)),
    (GraspAndPlace(fraction=0.0, direction=(1.0, 0.5, 0), distance=0.2, height=0.06),
     Drag(fraction=0.7, direction=(0.2, -1, 0), distance=0.12)),
    (Drag(fraction=0.0, direction=(1, -0.8, 0), distance=0.2),
     GraspAndPlace(fraction=0.6, direction=(0, 1, 0), distance=0.15, height=0.08)),
    # The end goes over the middle: a crossing.
    (GraspAndPlace(fraction=1.0, direction=(-1.0, 0.45, 0), distance=0.3, height=0.07),
     GraspAndPlace(fraction=1.0, direction=(-0.1, -1.0, 0), distance=0.25, height=0.07),),
)
PARAMETERS = {'flexibility': 76.5, 'elasticity': 45.0, 'friction': 70.0, 'self_collision': 25.6}
BOARD = LaidBoard((0.42, -0.30), -0.1)
SHEETS = (BOARD.sheet,)


@dataclass(frozen=True, eq=False)
class Moment:
    """
    What is true at one image.

    :param chain: (n, 3) [m].
    :param hand: place (3,) of the finger tips [m]; None: there is none.
    :param closed: whether the hand holds the DLO.
    """

    time: float
    chain: Floats
    hand: Floats | None
    closed: bool


def moments(number: int) -> list[Moment]:
    """Return what happens in a film, image by image."""
    generator = np.random.default_rng(number)
    points = np.zeros((121, 3))
    points[:, 0], points[:, 2] = np.linspace(0.0, LENGTH, len(points)), RADIUS
    points = _moved(points, Drag(fraction=0.3, direction=(0, -1, 0), distance=0.04))[0][-1]
    listed: list[Moment] = []
    flexibility = generator.uniform(65.4, 86.2)

    def add(chain: Floats, hand: Floats | None, closed: bool) -> None:
        listed.append(Moment(len(listed) / RATE, chain, hand, closed))

    actions = ACTIONS[number % len(ACTIONS)]
    for named in actions + actions[:1]:
        for _ in range(round(REST * RATE)):
            add(points, None, False)
        chains, hands, closed = _moved(points, named, flexibility)
        begin, end = hands[0], hands[-1]
        away = AWAY * np.array([0.1, -1.0, 0.25])
        count = round(APPROACH * RATE)
        for share in np.linspace(1.0, 0.0, count):
            add(points, begin + (share ** 1.5) * away, False)
        for chain, hand, holds in zip(chains, hands, closed, strict=True):
            add(chain, hand, holds)
        points = chains[-1]
        for share in np.linspace(0.0, 1.0, count):
            add(points, end + (share ** 1.5) * away, False)
    for _ in range(round(REST * RATE)):
        add(points, None, False)
    return listed


def _moved(points: Floats, named: NamedAction,
           flexibility: float = 76.5) -> tuple[list[Floats], list[Floats], list[bool]]:
    """Return the chains during an action, where the hand is, and whether it is closed."""
    chain, options = Chain(points), Options.of(FINE)
    action = named.action(chain)
    hand = action.hands[0]
    times = np.arange(1, round((hand.end + SETTLE) * RATE) + 1) / RATE
    simulator = make_simulator(options)
    values = options.space.physical({**PARAMETERS, 'flexibility': flexibility}, LENGTH)
    goals = tuple(Goal(chain, float(time), stable=False) for time in times)
    chains = simulator.simulate(Trial(named.name, chain, (action,), goals), values).chains
    simulator.close()
    places = np.column_stack([np.interp(times, hand.times, axis) for axis in np.asarray(hand.positions).T])
    return list(chains), list(places), [bool(hand.times[0] <= time <= hand.end) for time in times]


def camera(number: int, time: float) -> Camera:
    """Return the camera of a film at a time [s]; every fifth one is held in the hand."""
    generator = np.random.default_rng(100 + number)
    tilt, turn, roll = generator.uniform((0.2, -0.3, -0.05), (0.6, 0.3, 0.05))
    place = Camera(SIZE, FOCAL, tilt, turn, roll, 0.78, (0.31, 0.0))
    if number % 5 != 4:
        return place
    sway = [0.02 * math.sin(time * rate + 2 * k) for k, rate in enumerate((2.3, 3.1, 1.7, 2.0))]
    return replace(place, tilt=tilt + sway[0], turn=turn + sway[1], roll=roll + sway[2],
                   target=(0.31 + sway[3], sway[0] / 2), distance=0.78 + sway[1])


def images(number: int, listed: Sequence[Moment]) -> Iterator[Any]:
    """Give the images of a film."""
    look = replace(LOOKS[number % len(LOOKS)], sheets=SHEETS, blur=0.8, noise=2.5)
    renderer = Renderer(look, RADIUS, seed=number)
    for k, moment in enumerate(listed):
        before = listed[max(k - 1, 0)]
        instants = []
        still = moment.hand is None and before.hand is None and number % 5 != 4
        for share in (np.linspace(0.0, 1.0, SUBFRAMES) - 0.5) * EXPOSURE * RATE if not still else (0.0,):
            # The middle of the exposure is the image's time.
            other = listed[min(max(k + int(np.sign(share)), 0), len(listed) - 1)]
            weight = abs(float(share))
            chain = (1 - weight) * moment.chain + weight * other.chain
            hand = moment.hand if moment.hand is None or other.hand is None else (
                (1 - weight) * moment.hand + weight * other.hand)
            instants.append(_instant(number, moment.time + share / RATE, chain, hand))
        yield renderer.image(instants)


def _instant(number: int, time: float, chain: Floats, hand: Floats | None) -> Instant:
    along = np.linspace(0.0, 1.0, len(chain))
    curve = CubicSpline(along, chain)(np.linspace(0.0, 1.0, 401))
    hands = () if hand is None else (Hand((float(hand[0]), float(hand[1])), -1.5, float(hand[2]) + 0.004),)
    return Instant(camera(number, time), curve, hands, ())


def report(number: int, folder: Path, longest: float) -> dict[str, Any]:
    """Render a film, track it, and return what came out."""
    listed = [moment for moment in moments(number) if moment.time < longest]
    path = folder / f'film{number}.mp4'
    if not path.exists():
        write_film(path, images(number, listed), RATE)
    truth = [BOARD.seen_from(moment.chain) for moment in listed]
    first = camera(number, 0.0).project(listed[0].chain[::30])
    clicks = first + np.random.default_rng(number).normal(0.0, 3.0, first.shape)
    begin = time.perf_counter(), time.process_time()
    film = read_film(path)
    lens = film_lens(film)
    finder, tracker = BoardFinder(lens), Tracker(COUNT)
    errors, worst, lost, wrong = [], [], [], []
    spent = 0.0
    for k, frame in enumerate(film):
        watch = time.process_time()
        scale = finder.next(frame.pixels)
        tracked = tracker.next(frame.pixels, 1 / film.frame_rate, scale) if k else tracker.start(
            frame.pixels, clicks, scale)
        spent += time.process_time() - watch
        if scale is None:
            lost.append((frame.time, 'too little of the board is seen'))
            continue
        if tracked.lost:
            lost.append((frame.time, tracked.reason))
            continue
        chain = truth[k]
        points = scale.points(tracked.pixels, RADIUS)
        fine = Chain(chain)
        true = fine.resample(np.linspace(0.0, fine.length, COUNT))
        dense = fine.resample(np.linspace(0.0, fine.length, 601))
        seen = np.isfinite(points).all(axis=1)
        table = seen & (true[:, 2] < RADIUS + LIFTED)
        if table.any():
            off = 1e3 * np.linalg.norm(points[table, :2] - true[table, :2], axis=1)
            errors.append(float(off.mean()))
            worst.append((float(off.max()), frame.time))
            # Wrong: where no part of the DLO is.  A part in the air is seen elsewhere on the table.
            gap = cKDTree(dense[:, :2]).query(points[table, :2])[0]
            if (gap > WRONG).sum() > 1:
                wrong.append(frame.time)
    seconds = time.perf_counter() - begin[0]
    count = len(listed)
    return {'film': number, 'images': count, 'mean_mm': float(np.mean(errors)) if errors else math.nan,
            'worst_frame_mm': max(errors, default=math.nan), 'worst_point_mm': max(worst, default=math.nan),
            'tracked': 1 - len(lost) / count, 'wrong': len(wrong) / count, 'wrong_at': wrong[:5],
            'lost': lost[:3], 'images_per_s': count / seconds, 'cpu_ms': 1e3 * spent / count,
            'memory_mb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3}


def main(arguments: Sequence[str] | None = None) -> int:
    """Conduct the benchmark."""
    given = sys.argv[1:] if arguments is None else arguments
    films = int(given[0]) if given else FILMS
    longest = float(given[1]) if len(given) > 1 else math.inf
    with tempfile.TemporaryDirectory() as folder:
        for number in range(films):
            print(report(number, Path(folder), longest), flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
