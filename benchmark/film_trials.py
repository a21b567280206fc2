# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
From rendered films to parameters: the path of a hand from its tag, and whether intervals hold the truth.

Each object is a rope with parameters of its own; in each of its films, a hand with a tag moves it twice.

    python benchmark/film_trials.py [OBJECTS] [FILMS] [WIDTH]

OBJECTS (5) have FILMS (2) each, of WIDTH (1920) pixels.  A JSON document is printed for each film, and one
for the fit of all films of an object.
"""

import json
from pathlib import Path
import subprocess
import sys
import tempfile

import numpy as np
from scipy.spatial.transform import Rotation

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / 'test' / 'support'))

from filmed_trials import BOARD, clicks, film_camera, filmed_trials, MASS, Move, TRUTH  # noqa: E402
from films import write_film  # noqa: E402

from dlo_calibration import read_session  # noqa: E402

RATE = 15.0  # images in a second
BLUE = (0.10, 0.24, 0.55)
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


def main(arguments=None):
    """Conduct the benchmark."""
    given = [int(word) for word in (sys.argv[1:] if arguments is None else arguments)]
    objects, films, width = [*given, *(5, 2, 1920)[len(given):]]
    camera = film_camera((width, width * 9 // 16))
    held = asked = 0
    for number in range(objects):
        true, sessions = truth(number), []
        with tempfile.TemporaryDirectory() as folder:
            for take in range(films):
                film = filmed_trials(moves(np.random.default_rng((number, take))), RATE, true, seed=take)
                path, out = Path(folder) / f'{take}.mp4', Path(folder) / f'{take}'
                write_film(path, film.images(camera, exposed=1, seed=take, colour=BLUE), RATE)
                points = ' '.join(f'{u:.0f},{v:.0f}' for u, v in clicks(film, camera, seed=take))
                report = command('track', path, '--points', points, '--board', '--output', out)
                print(json.dumps({
                    'object': number, 'film': take, 'trials': len(report['trials']),
                    'tracked': report['tracked'] / report['frames'], 'fps': report['fps'],
                    'hands': path_errors(film, report, out) if report['trials'] else [],
                    'problems': report['problems']}), flush=True)
                sessions += [out / 'session.mcap'] * bool(report['trials'])
            if not sessions:
                continue
            result = command('fit', *sessions, '--mass', MASS, '--output', Path(folder) / 'fitted')
        found = result['parameters']
        rows = {name: (true[name], *(round(found[name][key], 1) for key in ('value', 'lower', 'upper')))
                for name in ('flexibility', 'friction', 'elasticity', 'self_collision')
                if found[name]['identifiable']}
        inside = sum(lower <= right <= upper for right, _, lower, upper in rows.values())
        held, asked = held + inside, asked + len(rows)
        print(json.dumps({'object': number, 'identifiable': rows,
                          'mean_error_mm': 1e3 * result['mean_error_m'],
                          'intervals_that_hold': f'{held} of {asked}'}), flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
