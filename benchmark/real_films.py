# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Track ropes and a cable in real films of a public repository, which a hand pushes or lifts.

    python benchmark/real_films.py FOLDER [--pictures FOLDER]

FOLDER is a checkout of https://github.com/Jianghanxiao/phystwin-web, whose films (H.264, 30 images a second)
show a table on their left half, 848 pixels wide.  The table's scale is a guess from the lines on it.
Nobody has measured where the ropes are: look at the pictures, which show every fifth image with its line.
"""

import argparse
from pathlib import Path
import sys

import cv2
from figures import machine, table
import numpy as np

from dlo_calibration.vision.film import read_film
from dlo_calibration.vision.pose import scale_from_points
from dlo_calibration.vision.tracker import Tracker

HERE = Path(__file__).resolve().parent
FILMS = 'src/videos/combine_rendering/{}/0_combine.mp4'
WIDTH, EVERY, SHOWN = 848, 5, (300, 40, 380, 320)  # px, images, px: left, top, width, height
TABLE = [(266, 393), (757, 388), (700, 180), (150, 180)]  # px
METRES = [(-0.277, 0.251), (0.589, 0.260), (0.701, 0.788), (-0.696, 0.788)]  # there
CLICKS = {
    'single_push_rope': ('a finger pushes a cream rope, taped beside its frayed ends',
                         [(362, 225), (420, 228), (500, 225), (598, 220)]),
    'single_push_rope_1': ('a finger pushes a brown rope, nearly of the colour of skin',
                           [(342, 253), (420, 248), (510, 258), (600, 240), (645, 246)]),
    'single_push_rope_4': ('a finger pushes a blue cable', [(325, 265), (400, 256), (500, 258), (627, 260)]),
    'single_lift_rope': ('a hand lifts an end of the cream rope',
                         [(370, 237), (440, 243), (520, 242), (600, 238)]),
}
LINE, LOST = (255, 220, 0), (0, 0, 255)  # blue, green, red


def followed(path, clicks):
    """Return how many images a film has, in how many the DLO is tracked, and some images with lines."""
    tracker, scale, before, tracked, pictures = Tracker(), None, None, 0, []
    for k, image in enumerate(read_film(path)):
        pixels = np.ascontiguousarray(image.pixels[:, :WIDTH])
        if before is None:
            scale = scale_from_points(np.array(TABLE, float), np.array(METRES), pixels.shape[1::-1], None)
            found = tracker.start(pixels, clicks, scale)
        else:
            found = tracker.next(pixels, image.time - before)
        before = image.time
        tracked += not found.lost
        if k % EVERY == 0:
            pictures.append(picture(pixels, found))
    return k + 1, tracked, pictures


def picture(pixels, found):
    """Return the part of an image with the DLO, and its line; a red frame where it is lost."""
    drawn = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    for begin, end in zip(found.pixels[:-1], found.pixels[1:], strict=True):
        if np.isfinite([*begin, *end]).all():
            cv2.line(drawn, np.rint(begin).astype(int), np.rint(end).astype(int), LINE, 2, cv2.LINE_AA)
    left, top, width, height = SHOWN
    part = np.ascontiguousarray(drawn[top:top + height, left:left + width])
    if found.lost:
        cv2.rectangle(part, (0, 0), (width - 1, height - 1), LOST, 6)
    return part


def sheet(pictures, columns=4):
    """Return pictures side by side."""
    empty = [np.zeros_like(pictures[0])] * (-len(pictures) % columns)
    every = [*pictures, *empty]
    return np.vstack([np.hstack(every[k:k + columns]) for k in range(0, len(every), columns)])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument('folder', type=Path)
    parser.add_argument('--pictures', type=Path, help='write a PNG of each film into this folder')
    chosen = parser.parse_args()
    if not (chosen.folder / FILMS.format('single_push_rope')).is_file():
        sys.exit(f'{chosen.folder} has no films of phystwin-web: nothing is measured')
    rows = []
    for name, (what, clicks) in CLICKS.items():
        count, tracked, pictures = followed(chosen.folder / FILMS.format(name), clicks)
        rows.append((name, what, len(clicks), f'{tracked} of {count}'))
        if chosen.pictures is not None:
            chosen.pictures.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(chosen.pictures / f'{name}.png'), sheet(pictures))
    text = table(('film', 'what it shows', 'clicks', 'images tracked'), rows)
    print(text)
    (HERE / 'results' / 'real_films.md').write_text(
        f'# real_films\n\n`python benchmark/real_films.py FOLDER`\n\nFilms of '
        f'https://github.com/Jianghanxiao/phystwin-web, 848 x 480 pixels. {machine()}\n\n{text}\n',
        encoding='utf-8')


if __name__ == '__main__':
    main()
