# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Track DLOs in rendered films whose truth is known, and compare.

A film shows a simulated rope and a hand that moves it, at 30 images a second, with shadows, blur, noise and
compression.  The first ten, at 1920 x 1080 pixels, were made with the tracker in mind; in two of them, the
camera is held in the hand.  Those with a number from 10 on are random, at 1280 x 720 pixels: colours, ground,
lamp, camera, thickness and flexibility, what is moved and how, and from where the hand comes.

    python benchmark/film.py [--films NUMBER ... | --random COUNT] [--folder FOLDER]

The first ten take some two hours.  FOLDER keeps them and the figures of each, so that a run goes on where
another was interrupted; remove from it what shall be made anew.
"""

import argparse
from dataclasses import dataclass, replace
from functools import cache, partial
import math
from pathlib import Path
import subprocess
import sys
import tempfile
import time
from typing import Any, Iterator, Mapping, Sequence

from figures import kept, machine, table
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
from dlo_calibration.errors import InputError  # noqa: E402
from dlo_calibration.model.chain import Chain, Floats  # noqa: E402
from dlo_calibration.model.named_actions import Drag, GraspAndPlace, NamedAction  # noqa: E402
from dlo_calibration.model.trial import Goal, Trial  # noqa: E402
from dlo_calibration.vision.film import Film, read_film  # noqa: E402
from dlo_calibration.vision.observer import FilmWriter, Observer  # noqa: E402
from dlo_calibration.vision.view import BoardFinder, film_lens  # noqa: E402

FILMS = 10  # which are no random ones
RATE = 30.0  # images a second
SIZE, FOCAL = (1920, 1080), 1500.0  # px
SMALL = 2 / 3  # of that, in random films
LENGTH, RADIUS, MASS = 0.6, 0.004, 0.03  # m, m, kg
FINE = {'mass': MASS, 'engine': 'compiled', 'nodes': 121, 'time_step': 0.001}
REST, APPROACH, SETTLE = 1.2, 0.9, 0.8  # s
AWAY, ARM = 0.5 * np.array([0.1, -1.0, 0.25]), -1.5  # m, from where the hand comes; rad, where its arm is
EXPOSURE, SUBFRAMES = 0.008, 3  # s; instants that are averaged
COUNT = 21  # points that are compared
WRONG = 0.008  # m: farther from the DLO than its diameter is wrong
LIFTED = 0.002  # m above the table, from where on a point is not on it
DURATIONS = (15.0, 45.0)  # s, of films whose memory is measured
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
GROUNDS = (('paper', (0.85, 0.80, 0.72)), ('paper', (0.45, 0.46, 0.48)), ('wood', (0.72, 0.55, 0.38)),
           ('wood', (0.33, 0.20, 0.12)), ('cloth', (0.22, 0.25, 0.30)), ('cloth', (0.15, 0.30, 0.22)))
COLOURS = ((0.10, 0.24, 0.55), (0.75, 0.15, 0.10), (0.92, 0.92, 0.90), (0.12, 0.12, 0.14), (0.85, 0.70, 0.12),
           (0.12, 0.45, 0.20), (0.85, 0.42, 0.10), (0.50, 0.50, 0.52), (0.70, 0.58, 0.40))
LEAST_CONTRAST = 0.25  # between a colour and its ground, in the root of linear light
MARGIN = 0.03  # of the picture, where no random film shows the DLO


@dataclass(frozen=True, eq=False)
class Scene:
    """
    What a film shows.

    :param away: (3,) from the DLO to where the hand comes from [m].
    :param arm: direction of the hand's arm [rad].
    :param held: whether the camera is held in the hand.
    """

    look: Look
    actions: tuple[NamedAction, ...]
    camera: Camera
    radius: float
    flexibility: float
    away: Floats
    arm: float
    held: bool


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


@cache
def scene(number: int) -> Scene:
    """Return what a film shows."""
    if number >= FILMS:
        return next(drawn for drawn in _random(number) if _in_picture(drawn))
    tilt, turn, roll = np.random.default_rng(100 + number).uniform((0.2, -0.3, -0.05), (0.6, 0.3, 0.05))
    actions = ACTIONS[number % len(ACTIONS)]
    return Scene(LOOKS[number % len(LOOKS)], actions + actions[:1],
                 Camera(SIZE, FOCAL, tilt, turn, roll, 0.78, (0.31, 0.0)), RADIUS,
                 float(np.random.default_rng(number).uniform(65.4, 86.2)), AWAY, ARM, number % 5 == 4)


def _random(number: int) -> Iterator[Scene]:
    """Draw what a random film may show."""
    generator = np.random.default_rng(number)
    size = round(SMALL * SIZE[0]), round(SMALL * SIZE[1])
    pairs = [(ground, colour) for ground in GROUNDS for colour in COLOURS
             if np.linalg.norm(np.sqrt(ground[1]) - np.sqrt(colour)) > LEAST_CONTRAST]
    while True:
        (kind, ground), colour = pairs[generator.integers(len(pairs))]
        azimuth, elevation = generator.uniform((-math.pi, 0.6), (math.pi, 1.3))
        look = Look(ground=kind, ground_colour=ground, ground_contrast=generator.uniform(0.03, 0.15),
                    colour=colour, lamp=(azimuth, elevation))
        arm = generator.uniform(-2.6, -0.5)
        away = 0.5 * np.array([math.cos(arm), math.sin(arm), 0.25])
        tilt, turn, roll, distance = generator.uniform((0.1, -0.5, -0.1, 0.78), (0.7, 0.5, 0.1, 0.95))
        place = Camera(size, SMALL * FOCAL, tilt, turn, roll, distance, (0.31, 0.0))
        yield Scene(look, tuple(_random_action(generator) for _ in range(3)), place,
                    generator.uniform(0.0025, 0.006), generator.uniform(55.0, 90.0), away, arm,
                    bool(generator.random() < 0.3))


def _random_action(generator: np.random.Generator) -> NamedAction:
    """Draw an action: half of them at an end."""
    fraction = float(generator.integers(2)) if generator.random() < 0.5 else generator.uniform(0.1, 0.9)
    angle = generator.uniform(-math.pi, math.pi)
    direction, distance = (math.cos(angle), math.sin(angle), 0.0), generator.uniform(0.08, 0.3)
    if generator.random() < 0.5:
        return Drag(fraction=fraction, direction=direction, distance=distance)
    return GraspAndPlace(fraction=fraction, direction=direction, distance=distance,
                         height=generator.uniform(0.04, 0.1))


def _in_picture(drawn: Scene) -> bool:
    """Tell whether a film shows the whole DLO, always."""
    size = np.array(drawn.camera.size)
    points = np.concatenate([moment.chain for moment in events(drawn)[::5]])
    pixels = drawn.camera.project(points)
    return bool(((pixels > MARGIN * size) & (pixels < (1 - MARGIN) * size)).all())


def events(shown: Scene) -> list[Moment]:
    """Return what happens in a film, image by image."""
    points = np.zeros((121, 3))
    points[:, 0], points[:, 2] = np.linspace(0.0, LENGTH, len(points)), shown.radius
    points = _moved(points, Drag(fraction=0.3, direction=(0, -1, 0), distance=0.04), 76.5)[0][-1]
    listed: list[Moment] = []

    def add(chain: Floats, hand: Floats | None, closed: bool) -> None:
        listed.append(Moment(len(listed) / RATE, chain, hand, closed))

    for named in shown.actions:
        for _ in range(round(REST * RATE)):
            add(points, None, False)
        chains, hands, closed = _moved(points, named, shown.flexibility)
        begin, end = hands[0], hands[-1]
        count = round(APPROACH * RATE)
        for share in np.linspace(1.0, 0.0, count):
            add(points, begin + (share ** 1.5) * shown.away, False)
        for chain, hand, holds in zip(chains, hands, closed, strict=True):
            add(chain, hand, holds)
        points = chains[-1]
        for share in np.linspace(0.0, 1.0, count):
            add(points, end + (share ** 1.5) * shown.away, False)
    for _ in range(round(REST * RATE)):
        add(points, None, False)
    return listed


def _moved(points: Floats, named: NamedAction,
           flexibility: float) -> tuple[list[Floats], list[Floats], list[bool]]:
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


def camera(shown: Scene, time: float) -> Camera:
    """Return the camera of a film at a time [s]."""
    place = shown.camera
    if not shown.held:
        return place
    sway = [0.02 * math.sin(time * rate + 2 * k) for k, rate in enumerate((2.3, 3.1, 1.7, 2.0))]
    return replace(place, tilt=place.tilt + sway[0], turn=place.turn + sway[1], roll=place.roll + sway[2],
                   target=(0.31 + sway[3], sway[0] / 2), distance=place.distance + sway[1])


def images(number: int, listed: Sequence[Moment]) -> Iterator[Any]:
    """Give the images of a film."""
    shown = scene(number)
    look = replace(shown.look, sheets=SHEETS, blur=0.8, noise=2.5)
    renderer = Renderer(look, shown.radius, seed=number)
    for k, moment in enumerate(listed):
        before = listed[max(k - 1, 0)]
        instants = []
        still = moment.hand is None and before.hand is None and not shown.held
        for share in (np.linspace(0.0, 1.0, SUBFRAMES) - 0.5) * EXPOSURE * RATE if not still else (0.0,):
            # The middle of the exposure is the image's time.
            other = listed[min(max(k + int(np.sign(share)), 0), len(listed) - 1)]
            weight = abs(float(share))
            chain = (1 - weight) * moment.chain + weight * other.chain
            hand = moment.hand if moment.hand is None or other.hand is None else (
                (1 - weight) * moment.hand + weight * other.hand)
            instants.append(_instant(shown, moment.time + share / RATE, chain, hand))
        yield renderer.image(instants)


def _instant(shown: Scene, time: float, chain: Floats, hand: Floats | None) -> Instant:
    along = np.linspace(0.0, 1.0, len(chain))
    curve = CubicSpline(along, chain)(np.linspace(0.0, 1.0, 241))
    hands = () if hand is None else (
        Hand((float(hand[0]), float(hand[1])), shown.arm, float(hand[2]) + 0.004),)
    return Instant(camera(shown, time), curve, hands, ())


def rendered(number: int, folder: Path) -> tuple[Path, list[Moment]]:
    """Return a film, which is made unless the folder has it, and what happens in it."""
    listed = events(scene(number))
    path = folder / f'film{number}.mp4'
    if not path.exists():
        part = folder / f'part{number}.mp4'
        write_film(part, images(number, listed), RATE)
        part.rename(path)
    return path, listed


def clicks(number: int, listed: Sequence[Moment]) -> Floats:
    """Return the rough clicks (5, 2) of a person in the first image [px]."""
    exact = camera(scene(number), 0.0).project(listed[0].chain[::30])
    return np.asarray(exact + np.random.default_rng(number).normal(0.0, 3.0, exact.shape))


def report(number: int, folder: Path) -> dict[str, Any]:
    """Track the DLO in a film, and return what came out, or why it was refused."""
    path, listed = rendered(number, folder)
    radius = scene(number).radius
    truth = [BOARD.seen_from(moment.chain) for moment in listed]
    film = read_film(path)
    observer = Observer(BoardFinder(film_lens(film)), COUNT)
    means, points_off, lost, wrong = [], [], [], []
    spent = 0.0
    frames = iter(film)
    for k, chain in enumerate(truth):
        watch = time.perf_counter()
        frame = next(frames)
        try:
            view = observer.next(frame.time, frame.pixels) if k else observer.start(
                frame.time, frame.pixels, clicks(number, listed))
        except InputError as refused:
            return {'images': len(truth), 'refused': str(refused)}
        spent += time.perf_counter() - watch
        if view.scale is None or view.tracked.lost:
            lost.append(frame.time)
            continue
        points = view.points(radius)
        fine = Chain(chain)
        true = fine.resample(np.linspace(0.0, fine.length, COUNT))
        dense = fine.resample(np.linspace(0.0, fine.length, 601))
        table_points = np.isfinite(points).all(axis=1) & (true[:, 2] < radius + LIFTED)
        if table_points.any():
            off = 1e3 * np.linalg.norm(points[table_points, :2] - true[table_points, :2], axis=1)
            means.append(float(off.mean()))
            points_off.append(float(off.max()))
            # Wrong: where no part of the DLO is.  A part in the air is seen elsewhere on the table.
            gap = cKDTree(dense[:, :2]).query(points[table_points, :2])[0]
            if (gap > WRONG).sum() > 1:
                wrong.append(frame.time)
    return {'images': len(truth), 'mean_mm': float(np.mean(means)), 'worst_image_mm': max(means),
            'worst_point_mm': max(points_off), 'lost': lost, 'wrong': wrong,
            'images_per_s': len(truth) / spent}


def to_and_fro(film: Film, path: Path, seconds: float) -> None:
    """Write a film that plays another one forwards and backwards, until it has so many seconds."""
    writer = FilmWriter(str(path), film.size, film.frame_rate)
    left = round(seconds * film.frame_rate)
    while left > 0:
        for frames in (film.frames(), film.backwards()):
            for frame in frames:
                if left > 0:
                    writer.write(frame.pixels)
                    left -= 1
    writer.close()


def memory(folder: Path, seconds: float) -> dict[str, Any]:
    """Return the most memory that `track` and its decoder take together, for a film of so many seconds."""
    path, listed = rendered(0, folder)
    long = folder / f'long{seconds:.0f}.mp4'
    to_and_fro(read_film(path), long, seconds)
    points = ' '.join(f'{u:.0f},{v:.0f}' for u, v in clicks(0, listed))
    command = [sys.executable, '-m', 'dlo_calibration', 'track', str(long), '--points', points, '--board',
               '--output', str(folder / 'tracked'), '--json']
    most = 0.0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None:
            most = max(most, resident_mb(process.pid))
            time.sleep(0.1)
    assert process.returncode == 0, process.returncode
    long.unlink()
    return {'seconds': seconds, 'memory_mb': most}


def resident_mb(process: int) -> float:
    """Return the memory of a process and of its children [MB], what they share once."""
    try:
        children = Path(f'/proc/{process}/task/{process}/children').read_text().split()
        rows = Path(f'/proc/{process}/smaps_rollup').read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):  # it has ended
        return 0.0
    own = sum(float(row.split()[1]) for row in rows if row.startswith('Pss:')) * 1024 / 1e6
    return own + sum(resident_mb(int(child)) for child in children)


def text_of(reports: Mapping[int, dict[str, Any]], memories: Sequence[dict[str, Any]]) -> str:
    """Return the tables."""
    refused = {number: own for number, own in reports.items() if 'refused' in own}
    reports = {number: own for number, own in reports.items() if number not in refused}
    rows = [(number, 'in the hand' if scene(number).held else 'on a stand', own['images'],
             f'{own["mean_mm"]:.2f}', f'{own["worst_image_mm"]:.1f}', f'{own["worst_point_mm"]:.1f}',
             f'{100 * (1 - len(own["lost"]) / own["images"]):.1f} %', len(own['wrong']),
             f'{own["images_per_s"]:.1f}') for number, own in reports.items()]
    rows += [(number, 'refused', own['images'], *['-'] * 6) for number, own in refused.items()]
    total = sum(own['images'] for own in reports.values())
    rows.append(('all', '', total, f'{np.mean([own["mean_mm"] for own in reports.values()]):.2f}',
                 *(f'{max(own[key] for own in reports.values()):.1f}'
                   for key in ('worst_image_mm', 'worst_point_mm')),
                 f'{100 * (1 - sum(len(own["lost"]) for own in reports.values()) / total):.1f} %',
                 sum(len(own['wrong']) for own in reports.values()),
                 f'{np.mean([own["images_per_s"] for own in reports.values()]):.1f}'))
    columns = ('film', 'camera', 'images', 'points on the table off by, mm', 'worst image, mm',
               'worst point, mm', 'tracked', 'wrong images, not said', 'images a second')
    tables = [table(columns, rows), *(f'{number}: {own["refused"]}' for number, own in refused.items())]
    if memories:
        tables.append(table(('film, s', 'memory of `track` and its decoder at most, MB'),
                            [(f'{own["seconds"]:.0f}', f'{own["memory_mb"]:.0f}') for own in memories]))
    return '\n\n'.join(tables)


def main() -> None:
    """Conduct the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0].strip())
    which = parser.add_mutually_exclusive_group()
    which.add_argument('--films', type=int, nargs='+', default=range(FILMS), metavar='NUMBER')
    which.add_argument('--random', type=int, metavar='COUNT', help='that many random films')
    parser.add_argument('--folder', type=Path, help='of films and figures (default: a temporary one)')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        reports = {}
        films = options.films if options.random is None else range(FILMS, FILMS + options.random)
        for number in films:
            reports[number] = kept(folder / f'film{number}.json', partial(report, number, folder))
            print(number, reports[number], flush=True)
        memories = [kept(folder / f'memory{seconds:.0f}.json', partial(memory, folder, seconds))
                    for seconds in DURATIONS if options.random is None]
    text = text_of(reports, memories)
    print(text)
    size = scene(films[0]).camera.size
    how = (f'Rendered films of {size[0]} x {size[1]} pixels; all points that are seen, whose true height is '
           'that of a DLO on the table. A wrong image shows two points or more over '
           f'{1e3 * WRONG:.0f} mm from any part of the DLO. Images a second: to decode, to find the board, '
           'the tags and the DLO.')
    if memories:
        how += ' For the memory, the first film plays to and fro.'
    which_films = (f' --random {options.random}' if options.random is not None
                   else '' if len(films) == FILMS else f' --films {" ".join(map(str, films))}')
    command = f'python benchmark/film.py{which_films}'
    name = 'film' if options.random is None else 'film_random'
    (HERE / 'results' / f'{name}.md').write_text(
        f'# {name}\n\n`{command}`\n\n{how} {machine()}\n\n{text}\n', encoding='utf-8')


if __name__ == '__main__':
    main()
