# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Track DLOs in rendered films whose truth is known, and compare.

A film shows a simulated rope and a hand that moves it (`film_scenes`), at 30 images a second, with shadows,
blur, noise and compression: the first ten at 1920 x 1080 pixels, random ones at 1280 x 720.

    python benchmark/film.py [--films NUMBER ... | --random COUNT] [--folder FOLDER]

The first ten take some two hours.  FOLDER keeps them and the figures of each, so that a run goes on where
another was interrupted; remove from it what shall be made anew.
"""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
import subprocess
import sys
import tempfile
import time
from typing import Any, Iterator, Mapping, Sequence

from figures import kept, machine, table
from film_scenes import camera, events, FILMS, Moment, RATE, Scene, scene
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / 'test' / 'support'))

from films import Instant, Renderer, write_film  # noqa: E402
from laid_board import LaidBoard  # noqa: E402
from photographs import Hand  # noqa: E402

from dlo_calibration.errors import InputError  # noqa: E402
from dlo_calibration.model.chain import Chain, Floats  # noqa: E402
from dlo_calibration.vision.film import Film, read_film  # noqa: E402
from dlo_calibration.vision.observer import FilmWriter, Observer  # noqa: E402
from dlo_calibration.vision.view import BoardFinder, film_lens  # noqa: E402

EXPOSURE, SUBFRAMES = 0.008, 3  # s; instants that are averaged
COUNT = 21  # points that are compared
WRONG = 0.008  # m: farther from the DLO than its diameter is wrong
LIFTED = 0.002  # m above the table, from where on a point is not on it
DURATIONS = (15.0, 45.0)  # s, of films whose memory is measured
BOARD = LaidBoard((0.42, -0.30), -0.1)
SHEETS = (BOARD.sheet,)


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
