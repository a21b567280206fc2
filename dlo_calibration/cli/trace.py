# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `trace`: finds a DLO's middle line in one photograph, and with a scale its chain."""

from __future__ import annotations

import argparse
from pathlib import Path
import time

import numpy as np

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.cli.output import print_json, standard_output
from dlo_calibration.errors import InputError
from dlo_calibration.files.chain_file import write_chain
from dlo_calibration.model.chain import Floats, MOST_POINTS
from dlo_calibration.vision.axis import axis_of, measured_diameter
from dlo_calibration.vision.board import find_board
from dlo_calibration.vision.lens import read_lens
from dlo_calibration.vision.photograph import Photograph, read_photograph
from dlo_calibration.vision.pose import scale_from_points
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.tracer import Trace, Tracer, write_picture

LARGEST_DIAMETER = 0.2  # m
COUNTS = (3, MOST_POINTS)  # of a chain's points


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument('photograph', metavar='PHOTO', type=Path, help='a JPEG or PNG file')
    parser.add_argument('--points', metavar='"u,v u,v ..."', required=True,
                        help='two or more pixels along the DLO, in order, from one end to the other')
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument('--scale', metavar='"u,v=x,y ..."',
                       help='four or more pixels and where they are on the table [m]')
    scale.add_argument('--board', action='store_true', help='the printed board lies beside the DLO')
    parser.add_argument('--camera', metavar='FILE', type=Path,
                        help='YAML of a ROS camera calibration, against lens distortion')
    parser.add_argument('--count', type=int, default=21, metavar='N',
                        help='points of the chain (default: 21)')
    parser.add_argument('--diameter', type=float, metavar='M',
                        help='of the DLO [m] (default: measured in the photograph)')
    parser.add_argument('--output', metavar='FILE', type=Path, help='write the chain as .csv or .xml')
    parser.add_argument('--picture', metavar='FILE.png', type=Path, help='draw the line over the photograph')
    parser.add_argument('--json', action='store_true', help='print one JSON document')


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    clicks = pixels_of(chosen.points, '--points')
    _check(chosen)
    photograph = read_photograph(chosen.photograph, f'photograph {chosen.photograph}')
    scale = _scale(chosen, photograph)
    begin = time.perf_counter()
    trace = Tracer(photograph.pixels).trace(clicks)
    seconds = time.perf_counter() - begin
    chain, diameter, length, shown = None, None, None, None
    if scale is not None:
        diameter = chosen.diameter or measured_diameter(trace, scale)
        above = {k: crossing.first_above for k, crossing in enumerate(trace.crossings)
                 if crossing.first_above is not None}
        axis = axis_of(trace, scale, diameter, chosen.count, above)
        chain, length = axis.chain(np.linspace(0.0, 1.0, chosen.count)), axis.length
        shown = scale.to_pixels(chain.points)
        if chosen.output is not None:
            write_chain(chosen.output, chain)
    if chosen.picture is not None:
        write_picture(chosen.picture, photograph.pixels, trace, shown)
    if chosen.json:
        print_json({'pixels': trace.pixels.tolist(),
                    'points': None if chain is None else chain.points.tolist(),
                    'length_m': length, 'width_px': trace.width, 'diameter_m': diameter,
                    'crossings': [list(crossing.pixel) for crossing in trace.crossings],
                    'sure': trace.sure.tolist(),
                    'residual_m': None if scale is None else scale.residual,
                    'notes': [] if scale is None else list(scale.warnings), 'seconds': seconds})
    else:
        _print(trace, scale, length, diameter)
    return 0


def check_count(count: int) -> None:
    """Refuse a number of points that no chain has."""
    if not COUNTS[0] <= count <= COUNTS[1]:
        raise InputError('--count', str(count), f'{COUNTS[0]} to {COUNTS[1]}', 'choose a number')


def _check(chosen: argparse.Namespace) -> None:
    """Refuse values that are out of range, and an output without a scale."""
    check_count(chosen.count)
    if chosen.diameter is not None and not 0 < chosen.diameter <= LARGEST_DIAMETER:
        raise InputError('--diameter', f'{chosen.diameter:g} m', f'above 0, at most {LARGEST_DIAMETER:g} m',
                         'give it in metres')
    if chosen.output is not None and not (chosen.scale or chosen.board):
        raise InputError('--output', 'no scale', 'a chain in metres', 'give --scale or --board')


def _scale(chosen: argparse.Namespace, photograph: Photograph) -> Scale | None:
    """Return the scale that the command line asks for."""
    lens = None if chosen.camera is None else read_lens(chosen.camera)
    if chosen.board:
        pixels, table = find_board(photograph.pixels)
    elif chosen.scale:
        pixels, table = places_of(chosen.scale)
    else:
        return None
    return scale_from_points(pixels, table, photograph.size, lens, photograph.focal_length)


def places_of(text: str) -> tuple[Floats, Floats]:
    """Return pixels (k, 2) and places on the table (k, 2) [m] of the option --scale."""
    pairs = [word.partition('=') for word in text.split()]
    for pair in pairs:
        if not pair[1]:
            raise InputError('--scale', repr(pair[0]), 'u,v=x,y',
                             'write e.g. "100,200=0,0 900,210=0.3,0 ..."')
    pixels, table = (np.array([_pair(pair[k], '--scale', 'u,v=x,y') for pair in pairs]) for k in (0, 2))
    return pixels, table


def pixels_of(text: str, option: str) -> Floats:
    """Return the pixels (k, 2) of an option "u,v u,v ..."."""
    return np.array([_pair(word, option, 'u,v') for word in text.split()]).reshape(-1, 2)


def _pair(word: str, option: str, form: str) -> tuple[float, float]:
    try:
        first, second = map(float, word.split(','))
    except ValueError as error:
        raise InputError(option, repr(word), f'numbers {form}', 'separate the points by blanks') from error
    if not max(abs(first), abs(second)) < 1e6:
        raise InputError(option, repr(word), 'finite numbers below a million', 'correct them')
    return first, second


def _print(trace: Trace, scale: Scale | None, length: float | None, diameter: float | None) -> None:
    """Print the trace as text."""
    with standard_output() as stream:
        crossings = len(trace.crossings)
        stream.write(f'line of {len(trace.pixels)} pixels, {trace.width:.1f} px wide, sure along '
                     f'{100 * trace.sure.mean():.0f} %, with {crossings} '
                     f'crossing{"" if crossings == 1 else "s"}\n')
        if scale is None or length is None or diameter is None:
            stream.write('no chain in metres: give --scale or --board\n')
            return
        stream.write(f'DLO {1000 * length:.1f} mm long, {1000 * diameter:.1f} mm thick; '
                     f'scale within {1000 * scale.residual:.2f} mm\n')
        for warning in scale.warnings:
            stream.write(f'{warning}\n')
