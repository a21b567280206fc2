# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Bending stiffness from one photograph each of real wires that hang in a loop.

    python benchmark/loop.py [--data FOLDER]

FOLDER (default: the folder adapteddlo_muj of DLO_DATA) has `black0.jpg`, `black0_data.pickle` and the same of
`red0` and `white0` from the public repository qj25/adapteddlo_muj (folder adapteddlo_muj/data/dlo_muj_real):
wires of 1.5 m between two horizontal clamps 0.12 m apart, and the pixels that its authors clicked along them.
They are not part of the package; a wire whose files are not there is left out, and the benchmark says so.
The pixels of each wire hung again (`black1_data.pickle` to `black4_data.pickle`, whose photographs the source
does not have) say how much EI differs from one time to the next.
Each is traced from 4 to 25 clicks along that annotation, exact or 40 pixels off; the two at the clamps are
always exact, as the picture shows these places.  EI is fitted to the line, to the annotation and to the
points of the line beside the annotation, with the clamps' direction from a click inside each, and to the line
without these clicks.  The tables are printed, and written to benchmark/results/loop.md.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
import os
from pathlib import Path
import pickle
from typing import Any

from figures import HERE, machine, table
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from dlo_calibration import calibrate, Options
from dlo_calibration.capture.hanging import COUNT, hanging_dlo, hanging_trial, NODES, straight_down, with_ends
from dlo_calibration.errors import InputError
from dlo_calibration.vision.middle_line import along_line, arc_lengths
from dlo_calibration.vision.photograph import read_photograph
from dlo_calibration.vision.pose import scale_from_length
from dlo_calibration.vision.tracer import Trace, Tracer

Floats = NDArray[np.float64]
Row = tuple[Any, ...]

LENGTH = 1.5  # m, from the source
POINTS = 51  # that the annotation has, and that are compared
OFF = 40.0  # px, a hundredth of the picture: how far a person's clicks are off
DRAWS = 5
HUNG = 5  # times that each wire was
ALLOWED = {('numpy.core.multiarray', '_reconstruct'), ('numpy', 'ndarray'), ('numpy', 'dtype')}


@dataclass(frozen=True)
class Wire:
    """
    A wire that hangs between two clamps.

    :param line_density: kg/m, from the source.
    :param clamps: (2, 2) px, on the wire's middle inside both clamps, at the first end and at the last one.
    """

    name: str
    line_density: float
    clamps: tuple[tuple[float, float], tuple[float, float]]


WIRES = (Wire('black', 0.081 / 2.98, ((1700.0, 431.0), (1400.0, 418.0))),
         Wire('red', 0.043 / 2.0, ((1700.0, 397.0), (1400.0, 392.0))),
         Wire('white', 0.087 / 5.0, ((1700.0, 258.0), (1400.0, 258.0))))


class Arrays(pickle.Unpickler):  # noqa: S301  # it makes arrays alone
    """Reads lists of arrays, and refuses all else that a pickle may hold."""

    def find_class(self, module: str, name: str) -> Any:
        """Return the class of an array."""
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f'{module}.{name} is no array')
        return super().find_class(module, name)


def annotation(path: Path) -> Floats:
    """Return the pixels (51, 2) that the authors clicked, evenly along the wire."""
    with path.open('rb') as stream:
        _, (pixels, start) = Arrays(stream).load()
    return np.asarray(pixels, float) + start


def evenly(line: Floats) -> Floats:
    """Return POINTS points evenly along a line (n, 2)."""
    along = arc_lengths(line)
    return along_line(line, along, np.linspace(0.0, along[-1], POINTS))


def stiffness(wire: Wire, trace: Trace, size: tuple[int, int], in_clamps: bool = True) -> tuple[float, ...]:
    """Return EI from a line, with the bounds of its interval [N m^2]."""
    scale = scale_from_length(trace.pixels, LENGTH, size)
    hangs = hanging_dlo(trace, scale, straight_down(scale, trace.pixels), COUNT,
                        clamps=wire.clamps if in_clamps else None)
    options = Options.of({'mass': with_ends(wire.line_density * LENGTH), 'nodes': NODES})
    result = calibrate([hanging_trial('trial 1', hangs.chain)], options)
    found = result.parameters['flexibility']
    return found.physical_value, found.physical_lower, found.physical_upper


def through(points: Floats) -> Trace:
    """Return the smooth line through points (n, 2) [px]."""
    along = arc_lengths(points)
    smooth = CubicSpline(along, points)(np.linspace(0.0, along[-1], 2000))
    return Trace(smooth, np.ones(len(smooth), dtype=bool), 0.0, ())


def clicks(truth: Floats, count: int, off: float, seed: int) -> Floats:
    """Return places (count, 2) along an annotation; all but both outer ones lie beside it by `off` [px]."""
    angles = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, count)
    moved = off * np.column_stack([np.cos(angles), np.sin(angles)])
    moved[[0, -1]] = 0.0
    along = arc_lengths(truth)
    return along_line(truth, along, np.linspace(0.0, along[-1], count)) + moved


def compare(wire: Wire, folder: Path) -> tuple[list[Row], list[Row], str]:
    """Return the rows of both tables, and a sentence, about a wire."""
    photograph = read_photograph(folder / f'{wire.name}0.jpg', 'photograph')
    truth = annotation(folder / f'{wire.name}0_data.pickle')
    metres = LENGTH / arc_lengths(truth)[-1]
    tracer = Tracer(photograph.pixels)
    rows, lines = [], {}
    for count in (4, 9, 25):
        for off in (0.0, OFF):
            distances = []
            for draw in range(DRAWS if off else 1):
                try:
                    trace = tracer.trace(clicks(truth, count, off, draw), clamped=True)
                except InputError as error:
                    return [], [], f'The {wire.name} wire is refused ("{error}").'
                lines.setdefault((count, off), trace)
                distances.append(np.linalg.norm(evenly(trace.pixels) - truth, axis=1) * metres)
            worst = max(each.mean() for each in distances)
            rows.append((wire.name, count, f'{off:g}', f'{1e3 * np.mean(distances):.2f}',
                         f'{1e3 * worst:.2f}', f'{1e3 * np.max(distances):.1f}'))
    middle = lines[4, 0.0].pixels
    nearest = np.linalg.norm(truth[:, None] - middle, axis=2)
    beside = nearest.min(axis=1)
    fits = []
    for name, line in (('the annotation', through(truth)), ('4 exact clicks', lines[4, 0.0]),
                       ("the annotation, each point moved to the line's nearest one",
                        through(middle[nearest.argmin(axis=1)])),
                       (f'4 clicks {OFF:g} px off', lines[4, OFF]),
                       (f'25 clicks {OFF:g} px off', lines[25, OFF])):
        fits.append((name, *stiffness(wire, line, photograph.size)))
    name = '4 exact clicks, none inside the clamps'
    fits.append((name, *stiffness(wire, lines[4, 0.0], photograph.size, in_clamps=False)))
    for k in range(1, HUNG):
        if (again := folder / f'{wire.name}{k}_data.pickle').exists():
            fits.append((f'the annotation of the wire hung again ({k})',
                         *stiffness(wire, through(annotation(again)), photograph.size)))
    first = fits[0][1]
    return rows, [(wire.name, name, f'{value:.3g}', f'{lower:.3g} to {upper:.3g}',
                   f'{100 * (value / first - 1):+.1f} %') for name, value, lower, upper in fits], (
        f'The {wire.name} wire is {lines[4, 0.0].width:.0f} px wide; its annotation lies '
        f'{beside.mean():.1f} px beside the traced line on average, {beside.max():.1f} px at most.')


def main() -> None:
    """Make the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0].strip())
    data = Path(os.environ.get('DLO_DATA', HERE.parent.parent / 'shared' / 'data')) / 'adapteddlo_muj'
    parser.add_argument('--data', type=Path, default=data, help='folder of photographs and annotations')
    folder = parser.parse_args().data
    rows: list[Row] = []
    fits: list[Row] = []
    sentences = ['Photographs of real wires; points are compared evenly along both lines, end to end.']
    for wire in WIRES:
        files = folder / f'{wire.name}0.jpg', folder / f'{wire.name}0_data.pickle'
        if not all(file.exists() for file in files):
            print(f'skipped: {files[0].name} and {files[1].name} of qj25/adapteddlo_muj are not in {folder}')
            continue
        traced, fitted, sentence = compare(wire, folder)
        rows += traced
        fits += fitted
        sentences.append(sentence)
    if not rows:
        return
    text = '\n\n'.join([
        table(('wire', 'clicks', 'off, px', 'mean distance to the annotation, mm', 'of the worst draw, mm',
               'worst point, mm'), rows),
        table(('wire', 'EI fitted to', 'N m^2', '90 % interval, N m^2', 'relative to the annotation'), fits)])
    (HERE / 'results' / 'loop.md').write_text(
        f'# loop\n\n`python benchmark/loop.py`\n\n{" ".join(sentences)} {machine()}\n\n{text}\n',
        encoding='utf-8')
    print(text)


if __name__ == '__main__':
    main()
