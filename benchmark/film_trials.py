# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
From rendered films to parameters: the path of a hand from its tag, and whether intervals hold the truth.

Each object is a rope with parameters of its own; in each of its films, a hand with a tag moves it twice.

    python benchmark/film_trials.py [--objects N] [--films N] [--width PX] [--folder FOLDER]

FOLDER keeps films, sessions and figures, so that a run goes on where another was interrupted; remove from it
what shall be made anew.
"""

import argparse
import functools
import json
import math
from pathlib import Path
import subprocess
import sys
import tempfile

from figures import kept, machine, table
import numpy as np
from scipy.spatial.transform import Rotation

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / 'test' / 'support'))

from filmed_trials import BOARD, clicks, film_camera, filmed_trials, MASS, Move, TRUTH  # noqa: E402
from films import write_film  # noqa: E402

from dlo_calibration import read_session  # noqa: E402

RATE = 15.0  # images in a second
BLUE = (0.10, 0.24, 0.55)
NAMES, KEYS = ('flexibility', 'friction', 'elasticity', 'self_collision'), ('value', 'lower', 'upper')
DELAYS = np.arange(-0.1, 0.101, 0.005)  # s


def truth(number):
    """Return the parameters of an object."""
    generator = np.random.default_rng(number)
    return {**TRUTH, 'flexibility': generator.uniform(61.9, 82.7), 'friction': generator.uniform(50.0, 80.0)}


def moves(generator):
    """Return two movements, near one end and near the other."""
    return tuple(Move(int(generator.integers(*nodes)), (generator.uniform(*x), generator.uniform(0.08, 0.18)),
                      turn=sign * generator.uniform(20, 50))
                 for nodes, x, sign in (((4, 20), (0.0, 0.08), 1), ((44, 58), (-0.12, -0.04), -1)))


def command(*words):
    """Return what a verb prints."""
    done = subprocess.run([sys.executable, '-m', 'dlo_calibration', *map(str, words), '--json'],
                          capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def path_errors(film, report, folder):
    """Return for each trial the error of the hand's path [mm], of its turn [deg], and its delay [ms]."""
    rows = []
    grips = BOARD.seen_from(film.grips)
    for trial, found in zip(read_session(folder / 'session.mcap').trials, report['trials'], strict=True):
        hand = trial.hands[0]
        times = hand.times - hand.times[0] + found['hands'][0]['closes_s']

        def away(delay, hand=hand, times=times):
            there = np.stack([np.interp(times - delay, film.times, axis) for axis in grips.T], axis=1)
            return hand.positions - there
        turns = Rotation.from_quat(hand.orientations)
        turned = (turns * turns[0].inv()).magnitude()
        true = np.interp(times, film.times, film.turns)
        spread = [np.linalg.norm(away(delay) - away(delay).mean(axis=0), axis=1).mean() for delay in DELAYS]
        rows.append({
            'path_mm': 1e3 * float(np.linalg.norm(away(0.0), axis=1).mean()),
            'path_without_mean_mm': 1e3 * float(spread[len(DELAYS) // 2]),
            'turn_deg': float(np.abs(np.rad2deg(turned) - np.abs(true - true[0])).mean()),
            'delay_ms': 1e3 * float(DELAYS[int(np.argmin(spread))]),
            'place_error': min(
                (abs(found['hands'][0]['grip_fraction'] - node / 60) for closes, _, node in film.holds
                 if abs(closes - found['hands'][0]['closes_s']) < 1.5), default=None)})
    return rows


def tracked(number, take, width, folder):
    """Return what `track` finds in a film of an object; its session lies in a folder of its own."""
    camera = film_camera((width, width * 9 // 16))
    film = filmed_trials(moves(np.random.default_rng((number, take))), RATE, truth(number), seed=take)
    path, out = folder / f'{number}_{take}.mp4', folder / f'{number}_{take}'
    if not path.exists():
        part = path.with_stem(f'part_{number}_{take}')
        write_film(part, film.images(camera, exposed=1, seed=take, colour=BLUE), RATE)
        part.rename(path)
    points = ' '.join(f'{u:.0f},{v:.0f}' for u, v in clicks(film, camera, seed=take))
    found = command('track', path, '--points', points, '--board', '--output', out)
    return {'trials': len(found['trials']), 'tracked': found['tracked'] / found['frames'],
            'hands': path_errors(film, found, out) if found['trials'] else [], 'problems': found['problems']}


def fitted(number, takes, folder):
    """Return what `fit` finds in all films of an object: name -> truth, value, lower, upper, verdict."""
    sessions = [folder / f'{number}_{take}' / 'session.mcap' for take in takes]
    result = command('fit', *sessions, '--mass', MASS, '--output', folder / f'fitted_{number}')
    true, found = truth(number), result['parameters']
    return {'mean_error_mm': 1e3 * result['mean_error_m'], 'parameters': {
        name: {'true': true[name], **{key: found[name][key] for key in KEYS}} for name in NAMES
        if found[name]['identifiable']}}


def text_of(films, fits):
    """Return the tables of films, (object, film) -> `tracked`, and of fits, object -> `fitted`."""
    rows = []
    for (number, take), own in films.items():
        hands = own['hands']
        worst = [max((abs(hand[key]) for hand in hands if hand[key] is not None), default=math.nan)
                 for key in ('path_mm', 'path_without_mean_mm', 'turn_deg', 'delay_ms', 'place_error')]
        rows.append((number, take, f'{own["trials"]} of 2', f'{100 * own["tracked"]:.1f} %',
                     f'{worst[0]:.1f}', f'{worst[1]:.1f}', f'{worst[2]:.1f}', f'{worst[3]:.0f}',
                     f'{100 * worst[4]:.1f}'))
    columns = ('object', 'film', 'trials', 'tracked', 'path of the hand, mm', 'without its mean, mm',
               'turn, degrees', 'delay, ms', 'place that it holds, % of the length')
    first = table(columns, rows)
    rows, held = [], []
    for number, own in fits.items():
        cells = {}
        for name, found in own['parameters'].items():
            holds = found['lower'] <= found['true'] <= found['upper']
            text = f'{found["value"]:.1f} [{found["lower"]:.1f}, {found["upper"]:.1f}] ({found["true"]:.1f})'
            cells[name] = text if holds else f'**{text}**'
            held.append(holds)
        rows.append((number, *(cells.get(name, '') for name in NAMES), f'{own["mean_error_mm"]:.2f}'))
    columns = ('object', *(f'{name}: found [interval] (truth)' for name in NAMES), 'fitted, mm')
    return (f'{first}\n\n{table(columns, rows)}\n\n{sum(held)} of {len(held)} intervals of identifiable '
            'parameters contain the truth; those that do not are bold.')


def main():
    """Conduct the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0].strip())
    parser.add_argument('--objects', type=int, default=5)
    parser.add_argument('--first', type=int, default=0, help='number of the first object')
    parser.add_argument('--films', type=int, default=2, help='of each')
    parser.add_argument('--width', type=int, default=1920, help='of the images [px]')
    parser.add_argument('--folder', type=Path, help='of films and figures (default: a temporary one)')
    options = parser.parse_args()
    films, fits = {}, {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for number in range(options.first, options.first + options.objects):
            for take in range(options.films):
                films[number, take] = kept(folder / f'{number}_{take}.json', functools.partial(
                    tracked, number, take, options.width, folder))
                print(number, take, films[number, take], flush=True)
            takes = [take for take in range(options.films) if films[number, take]['trials']]
            if takes:
                fits[number] = kept(folder / f'fitted_{number}.json', functools.partial(
                    fitted, number, takes, folder))
                print(number, fits[number], flush=True)
    text = text_of(films, fits)
    print(text)
    words = ['python benchmark/film_trials.py', *(
        f'--{name} {getattr(options, name)}' for name in ('objects', 'first', 'films', 'width')
        if getattr(options, name) != parser.get_default(name))]
    how = (f'Rendered films {options.width} pixels wide, {RATE:.0f} images a second. In the first table,'
           ' each figure is the worse one of the trials. The intervals and verdicts are those that the '
           'calibration finds.')
    (HERE / 'results' / 'film_trials.md').write_text(
        f'# film_trials\n\n`{" ".join(words)}`\n\n{how} {machine()}\n\n{text}\n', encoding='utf-8')


if __name__ == '__main__':
    main()
