# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Compare parameters from rendered photographs with the true ones.

    python benchmark/from_photographs.py [--draws N] [--seed S]

Each calibration begins with photographs of 12 megapixels, one before and one after each action, of the
reference objects (of DLO_DATA; left out where it is absent) and of the rope of msg_samples/photographs.
The printed board lies beside the DLO; the camera is held by hand, up to 35 degrees from the vertical; its
lens, the colours, the ground and the light are random.  Ends and bends are clicked on, 10 pixels beside.
The way and the speed of the hand are known; the place where it opened is known exactly in the first table,
and to a millimetre in the second, as from a sticker on the real table.  Board, tracer, chains, trials and
search are those of the capture page.  The tables are printed, and written to
benchmark/results/from_photographs.md.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
import io
import math
import multiprocessing
import os
from pathlib import Path
import sys
import tempfile
from typing import Any, Iterator

from figures import HERE, machine, table
import numpy as np

sys.path.insert(0, str(HERE.parent / 'test' / 'support'))

import cv2  # noqa: E402
from discretisation import DATA, exact_trials  # noqa: E402
from laid_board import LaidBoard  # noqa: E402
import make_photographs as sample  # noqa: E402
from photographed_trials import drafted  # noqa: E402
from photographs import Camera, Look, photograph  # noqa: E402
from PIL import Image  # noqa: E402
from rendered_scenes import clicks, COLOURS  # noqa: E402
from scipy.interpolate import CubicSpline  # noqa: E402

from dlo_calibration import Action, calibrate, Chain, Options, Trial  # noqa: E402
from dlo_calibration.calibration.engines import make_simulator  # noqa: E402
from dlo_calibration.model.parameters import BY_NAME  # noqa: E402

SIZE = (4000, 3000)  # px
OFF = 10.0  # px, of each click from the middle line
#: Standard deviation of x and y of the place where the hand opened [m] -> how it is known.
MARKED = {0.0: 'exactly', 0.001: 'to 1 mm'}
ACTIONS = ('place_end', 'drag_quarter', 'place_three_quarters')  # after which the DLO lies on the table
TRUTH = {'flexibility': 'EI', 'elasticity': 'EA', 'friction': 'mu'}


@dataclass(frozen=True)
class Manipulated:
    """
    A DLO with known properties, and what was done with it.

    :param truth: values on the scale from 0 to 100.
    :param trials: with exact chains.
    """

    name: str
    radius: float
    mass: float
    truth: dict[str, float]
    trials: tuple[Trial, ...]


def manipulated() -> Iterator[Manipulated]:
    """Yield the DLOs."""
    for path in sorted(DATA.glob('object*.json')):
        properties, trials = exact_trials(path.stem)
        truth = {name: BY_NAME[name].value(properties[of]) for name, of in TRUTH.items()}
        yield Manipulated(path.stem, properties['radius'], properties['mass'], truth,
                          tuple(trial for trial in trials if trial.name in ACTIONS))
    yield Manipulated('sample', sample.RADIUS, sample.MASS, sample.TRUTH, sample.exact_trials())


def scene(generator: np.random.Generator, radius: float, low: np.ndarray, high: np.ndarray) -> dict[str, Any]:
    """Draw what the photographs of a trial share: the lens, the look, and where the board lies."""
    colour, ground = COLOURS[generator.integers(len(COLOURS))]
    look = {'ground': str(generator.choice(['plain', 'wood', 'cloth'])), 'ground_colour': ground,
            'colour': colour, 'second_colour': tuple(0.6 * np.array(colour) + 0.1),
            'pattern': str(generator.choice(['plain', 'striped', 'braided'])),
            'ground_contrast': generator.uniform(0.06, 0.15), 'pitch': generator.uniform(2, 5) * 2 * radius,
            'highlight': generator.uniform(0, 0.6), 'shadow': generator.uniform(0.3, 0.6),
            'lamp': (generator.uniform(-np.pi, np.pi), generator.uniform(0.7, 1.2)),
            'noise': generator.uniform(1, 3), 'blur': generator.uniform(0.6, 1.5)}
    k1 = generator.uniform(-0.03, 0.03)
    return {'look': look, 'board': LaidBoard((high[0] + 0.04, (low[1] + high[1]) / 2 - 0.15),
                                             math.radians(generator.uniform(-8, 8))),
            'film': generator.uniform(24, 28), 'distortion': (k1, -k1, 0.0, 0.0, 0.0),
            'turn': generator.uniform(-np.pi, np.pi)}


def photograph_of(generator: np.random.Generator, shared: dict[str, Any], chain: Chain, radius: float,
          low: np.ndarray, high: np.ndarray) -> tuple[bytes, np.ndarray]:
    """Return a photograph of a chain as a file, and what a person clicks on."""
    board: LaidBoard = shared['board']
    count = round(chain.length / 0.001) + 1
    curve = CubicSpline(np.linspace(0, 1, len(chain)), chain.points)(np.linspace(0, 1, count))
    focal = shared['film'] * math.hypot(*SIZE) / math.hypot(36, 24)
    target = np.array([low[0] + high[0] + 0.25, low[1] + high[1]]) / 2
    turn = shared['turn'] + math.radians(generator.uniform(-10, 10))
    tilt = math.radians(generator.uniform(5, 35))
    corners = np.array([(*low, 0), (*high, 0), (low[0], high[1], 0), (high[0], low[1], 0)])
    sheet = np.array(board.corner) + [[-0.02, -0.03], [0.25, -0.03], [-0.02, 0.33], [0.25, 0.33]]
    shown = np.concatenate([corners, np.column_stack([sheet, np.zeros(4)])])
    distance = 0.4
    while True:  # nearer, the DLO and the board do not fit into the picture
        camera = Camera(SIZE, focal, tilt, turn, math.radians(generator.uniform(-3, 3)), distance,
                        (float(target[0]), float(target[1])), shared['distortion'])
        seen = camera.project(shown)
        if (seen > 0).all() and (seen < SIZE).all():
            break
        distance *= 1.04
    look = Look(**shared['look'], sheets=(board.sheet,))
    pixels = photograph(camera, curve, radius, look, int(generator.integers(2**31)))
    exif, stream = Image.Exif(), io.BytesIO()
    exif.get_ifd(0x8769)[0xa405] = round(shared['film'])  # FocalLengthIn35mmFilm
    Image.fromarray(pixels).save(stream, 'JPEG', quality=92, exif=exif)
    return stream.getvalue(), clicks(generator, camera, curve, OFF)


def steps(trial: Trial, board: LaidBoard, error: np.ndarray) -> list[dict[str, Any]]:
    """
    Return what the hand did, as a person says it: its way over the table, seen from the board.

    :param error: (2,) of the place where it opened [m].
    """
    hand = trial.hands[0]
    fraction = hand.grips[0] / (len(trial.initial) - 1)
    way = board.seen_from(hand.positions)[1:]
    last = np.linalg.norm(way[:, :2] - way[-1, :2], axis=1) < 1e-9
    way[last, :2] += error
    return [{'kind': 'path', 'fraction': fraction,
             'waypoints': [[x, y, max(z - hand.positions[0, 2], 0.0)] for x, y, z in way.tolist()]}]


def timed(trial: Trial, exact: Trial) -> Trial:
    """Return a trial whose hand has the speeds that it really had."""
    return replace(trial, actions=tuple(
        Action(tuple(replace(hand, times=true.times) for hand, true in zip(
            action.hands, other.hands, strict=True)))
        for action, other in zip(trial.actions, exact.actions, strict=True)))


def judge(dlo: Manipulated, seed: int) -> dict[float, dict[str, Any]]:
    """Calibrate from photographs; return the figures for each error of the marked place [m]."""
    cv2.setNumThreads(1)
    generator = np.random.default_rng(seed)
    photographs, exact, boards = {}, {}, []
    for trial in dlo.trials:
        points = np.concatenate([trial.initial.points, trial.goals[0].chain.points])[:, :2]
        low, high = points.min(axis=0), points.max(axis=0)
        shared = scene(generator, dlo.radius, low, high)
        boards.append(shared['board'])
        for name, chain in (('start', trial.initial), ('goal', trial.goals[0].chain)):
            photographs[f'{trial.name} {name}'] = photograph_of(
                generator, shared, chain, dlo.radius, low, high)
            exact[f'{trial.name} {name}'] = shared['board'].seen_from(chain.points)
    errors = generator.standard_normal((len(dlo.trials), 2))
    return {marked: calibrated(dlo, seed, photographs, exact, [
        {'start': f'{trial.name} start', 'goal': f'{trial.name} goal',
         'steps': steps(trial, board, marked * error)}
        for trial, board, error in zip(dlo.trials, boards, errors, strict=True)]) for marked in MARKED}


def calibrated(dlo: Manipulated, seed: int, photographs: dict[str, tuple[bytes, np.ndarray]],
               exact: dict[str, np.ndarray], said: list[dict[str, Any]]) -> dict[str, Any]:
    """
    Calibrate from photographs; return the figures.

    :param exact: name of a photograph -> chain (21, 3) in the board's frame [m].
    :param said: the trials, as a document has them.
    """
    begun = os.times().user
    with tempfile.TemporaryDirectory() as folder:
        read, ids = drafted(Path(folder) / 'project', photographs, said, {'mass': dlo.mass})
    unusable = [str(trial.plain['warnings']) for trial in read.trials if trial.trial is None]
    shown = {name: read.photographs[photograph_id] for name, photograph_id in ids.items()}
    unusable += [f'{name}: {photo.plain["trace_problem"]}' for name, photo in shown.items()
                 if photo.axis is None]
    if unusable:
        return {'problem': '; '.join(unusable)}
    trials = tuple(timed(trial, true) for trial, true in zip(read.complete, dlo.trials, strict=True))
    seen, true = ([chain for trial in some for chain in (trial.initial, trial.goals[0].chain)]
                  for some in (trials, dlo.trials))
    off = [np.linalg.norm(chain.points - points, axis=1)
           for chain, points in zip(seen, exact.values(), strict=True)]
    lengths = [chain.length / other.length - 1 for chain, other in zip(seen, true, strict=True)]
    reading = os.times().user - begun
    options = Options.of({**read.options, 'engine': 'compiled', 'workers': 1, 'seed': seed})
    result = calibrate(trials, options, make_simulator=make_simulator)
    return {'parameters': result.parameters, 'mean': 1e3 * np.mean(off), 'worst': 1e3 * np.max(off),
            'length': 100 * np.mean(lengths), 'diameter': 1e3 * (read.diameter or 0.0), 'reading': reading,
            'whole': os.times().user - begun, 'fit': 1e3 * result.errors.mean}


def row(dlo: Manipulated, seed: int, figures: dict[str, Any], inside: list[bool]) -> tuple[object, ...]:
    """Return the row of one calibration, and add to `inside` whether intervals contain the truth."""
    if 'problem' in figures:
        inside.append(False)
        return (dlo.name, seed, figures['problem'], *[''] * 7)
    cells = []
    for name in TRUTH:
        estimate, true = figures['parameters'][name], dlo.truth[name]
        holds = estimate.lower <= true <= estimate.upper
        text = f'{estimate.value:.1f} [{estimate.lower:.1f}, {estimate.upper:.1f}] ({true:.1f})'
        identifiable = estimate.verdict == 'identifiable'
        cells.append((text if holds else f'**{text}**') + ('' if identifiable else f' {estimate.verdict}'))
        inside += [holds] * identifiable
    return (dlo.name, seed, *cells, f'{figures["mean"]:.2f}, {figures["worst"]:.2f}',
            f'{figures["length"]:+.2f}', f'{figures["diameter"]:.1f} ({2e3 * dlo.radius:.1f})',
            f'{figures["fit"]:.2f}',
            f'{figures["reading"]:.1f}, {figures["whole"]:.1f}')


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0].strip())
    parser.add_argument('--draws', type=int, default=2, help='of each DLO')
    parser.add_argument('--seed', type=int, default=1, help='of the first draw')
    parser.add_argument('--workers', type=int, default=2)
    parser.add_argument('--only', default='', help='name of one DLO; nothing is written then')
    options = parser.parse_args()
    rows: dict[float, list[tuple[object, ...]]] = {marked: [] for marked in MARKED}
    inside: dict[float, list[bool]] = {marked: [] for marked in MARKED}
    cases = [(dlo, seed) for dlo in manipulated() if options.only in ('', dlo.name)
             for seed in range(options.seed, options.seed + options.draws)]
    with ProcessPoolExecutor(options.workers, multiprocessing.get_context('spawn')) as executor:
        judged = executor.map(judge, *zip(*cases, strict=True))
        for (dlo, seed), calibrations in zip(cases, judged, strict=True):
            for marked, figures in calibrations.items():
                rows[marked].append(row(dlo, seed, figures, inside[marked]))
                print(marked, rows[marked][-1], flush=True)
    columns = ('DLO', 'seed', *(f'{name}: found [interval] (truth)' for name in TRUTH),
               'chains, mean and worst point, mm', 'length, %', 'diameter (truth), mm', 'fitted, mm',
               'reading, whole, s')
    text = '\n\n'.join(
        f'The place where the hand opened is known {how}:\n\n{table(columns, rows[marked])}\n\n'
        f'{sum(inside[marked])} of {len(inside[marked])} intervals of identifiable parameters contain the '
        'truth; those that do not are bold.' for marked, how in MARKED.items())
    print(text)
    if not options.only:
        command = f'python benchmark/from_photographs.py --draws {options.draws} --seed {options.seed}'
        how = ('Rendered photographs of 12 megapixels, two for each of two or three trials; seconds of one '
               'core. The intervals and verdicts are those that the calibration finds.')
        (HERE / 'results' / 'from_photographs.md').write_text(
            f'# from_photographs\n\n`{command}`\n\n{how} {machine()}\n\n{text}\n', encoding='utf-8')


if __name__ == '__main__':
    main()
