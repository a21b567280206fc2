# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
The verb `trace`: finds a DLO's middle line in one photograph, and with a scale its chain.

Of a DLO that hangs between clamps, it also makes the trial.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import time

import numpy as np

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.capture.hanging import (
    COUNT as HANGING_COUNT,
)
from dlo_calibration.capture.hanging import (
    hanging_dlo,
    hanging_trial,
    HangingDlo,
    NODES,
    straight_down,
    with_ends,
)
from dlo_calibration.capture.trials import write_session
from dlo_calibration.cli.output import print_json, standard_output
from dlo_calibration.errors import InputError
from dlo_calibration.files.chain_file import write_chain
from dlo_calibration.model.chain import Chain, Floats, MOST_POINTS
from dlo_calibration.model.parameters import BY_NAME, SCALE
from dlo_calibration.vision.axis import axis_of, measured_diameter
from dlo_calibration.vision.board import find_board
from dlo_calibration.vision.lens import read_lens
from dlo_calibration.vision.middle_line import arc_lengths
from dlo_calibration.vision.photograph import Photograph, read_photograph
from dlo_calibration.vision.pose import scale_from_length, scale_from_points
from dlo_calibration.vision.scale import Scale
from dlo_calibration.vision.tracer import Trace, Tracer, write_picture

LARGEST_DIAMETER = 0.2  # m
COUNTS = (3, MOST_POINTS)  # of a chain's points
COUNT = 21  # of these, if the user does not say; of one that hangs, HANGING_COUNT
FEWEST_HANGING = 9  # points of a chain that hangs, four of which are in the clamps
LARGEST_MASS = 1000.0  # kg
ONLY_HANGING = {'clamps': '--clamps', 'plumb': '--plumb', 'mass': '--mass'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument('photograph', metavar='PHOTO', type=Path, help='a JPEG or PNG file')
    parser.add_argument('--points', metavar='"u,v u,v ..."', required=True,
                        help='two or more pixels along the DLO, in order, from one end to the other')
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument('--scale', metavar='"u,v=x,y ..."',
                       help='four or more pixels and where they are on the table [m]')
    scale.add_argument('--board', action='store_true', help='the printed board lies beside the DLO')
    scale.add_argument('--length', type=float, metavar='M',
                       help='of the DLO along the line [m], if the photograph looks squarely at its plane')
    scale.add_argument('--gap', type=float, metavar='M',
                       help='distance between the ends of the line [m], likewise')
    parser.add_argument('--hanging', nargs='?', type=float, const=0.0, metavar='M',
                        help='the DLO hangs from clamps at both ends, before a plane that stands, like a '
                             'wall; M: its distance from the plane of the scale [m] (default: 0)')
    parser.add_argument('--clamps', metavar='"u,v u,v"',
                        help='a pixel in each clamp, on the middle of the DLO (default: the clamps have the '
                             "direction of the line's ends)")
    parser.add_argument('--plumb', metavar='"u,v u,v"',
                        help='a higher and a lower pixel of something vertical (default: down in the '
                             'photograph; with --scale, y points up)')
    parser.add_argument('--mass', type=float, metavar='KG',
                        help='of the DLO that hangs, from clamp to clamp [kg]; recorded with the trial')
    parser.add_argument('--camera', metavar='FILE', type=Path,
                        help='YAML of a ROS camera calibration, against lens distortion')
    parser.add_argument('--count', type=int, metavar='N',
                        help=f'points of the chain (default: {COUNT}; if it hangs: {HANGING_COUNT})')
    parser.add_argument('--diameter', type=float, metavar='M',
                        help='of the DLO [m] (default: measured in the photograph)')
    parser.add_argument('--output', metavar='FILE', type=Path,
                        help='write the chain as .csv or .xml, or the trial of a DLO that hangs as .mcap')
    parser.add_argument('--picture', metavar='FILE.png', type=Path, help='draw the line over the photograph')
    parser.add_argument('--json', action='store_true', help='print one JSON document')


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    clicks = pixels_of(chosen.points, '--points')
    _check(chosen)
    photograph = read_photograph(chosen.photograph, f'photograph {chosen.photograph}')
    begin = time.perf_counter()
    trace = Tracer(photograph.pixels).trace(clicks, clamped=chosen.hanging is not None)
    seconds = time.perf_counter() - begin
    scale = _scale(chosen, photograph, trace)
    chain, diameter, length, shown = None, None, None, None
    if scale is not None:
        diameter = chosen.diameter or measured_diameter(trace, scale)
        if chosen.hanging is not None:
            hangs = _hanging(chosen, trace, scale)
            chain, shown = hangs.chain, hangs.scale.to_pixels(hangs.chain.points[1:-1])
            length = float(arc_lengths(scale.to_table(trace.pixels, chosen.hanging))[-1])
        else:
            above = {k: crossing.first_above for k, crossing in enumerate(trace.crossings)
                     if crossing.first_above is not None}
            axis = axis_of(trace, scale, diameter, chosen.count, above)
            chain, length = axis.chain(np.linspace(0.0, 1.0, chosen.count)), axis.length
            shown = scale.to_pixels(chain.points)
        if chosen.output is not None:
            _write(chosen, chain, diameter)
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


def check_count(count: int, fewest: int = COUNTS[0]) -> None:
    """Refuse a number of points that no chain has."""
    if not fewest <= count <= COUNTS[1]:
        raise InputError('--count', str(count), f'{fewest} to {COUNTS[1]}', 'choose a number')


def _check(chosen: argparse.Namespace) -> None:
    """Refuse values that are out of range, and those without what they need; complete the count."""
    hangs, scaled = chosen.hanging is not None, _has_scale(chosen)
    if chosen.count is None:
        chosen.count = HANGING_COUNT if hangs else COUNT
    check_count(chosen.count, FEWEST_HANGING if hangs else COUNTS[0])
    if chosen.diameter is not None and not 0 < chosen.diameter <= LARGEST_DIAMETER:
        raise InputError('--diameter', f'{chosen.diameter:g} m', f'above 0, at most {LARGEST_DIAMETER:g} m',
                         'give it in metres')
    if chosen.mass is not None and not 0 < chosen.mass <= LARGEST_MASS:
        raise InputError('--mass', f'{chosen.mass:g} kg', f'above 0, at most {LARGEST_MASS:g} kg',
                         'give it in kilograms')
    if hangs and not 0 <= chosen.hanging <= 1:
        raise InputError('--hanging', f'{chosen.hanging:g} m', '0 to 1 m', 'give the distance in metres')
    if (hangs or chosen.output is not None) and not scaled:
        raise InputError('--hanging' if hangs else '--output', 'no scale', 'a chain in metres',
                         'give --scale, --board, --length or --gap')
    for name, flag in ONLY_HANGING.items():
        if getattr(chosen, name) is not None and not hangs:
            raise InputError(flag, 'no --hanging', 'a DLO that hangs between clamps', 'add --hanging')
    if chosen.output is not None and chosen.output.suffix.lower() == '.mcap' and not hangs:
        raise InputError(f'--output {chosen.output}', 'no --hanging', 'a DLO that hangs between clamps: '
                         'only that is a trial by itself', 'add --hanging, or write a .csv or .xml')


def _has_scale(chosen: argparse.Namespace) -> bool:
    return chosen.board or any(given is not None for given in (chosen.scale, chosen.length, chosen.gap))


def _scale(chosen: argparse.Namespace, photograph: Photograph, trace: Trace) -> Scale | None:
    """Return the scale that the command line asks for."""
    lens = None if chosen.camera is None else read_lens(chosen.camera)
    if chosen.length is not None:
        return scale_from_length(trace.pixels, chosen.length, photograph.size, lens, photograph.focal_length)
    if chosen.gap is not None:
        return scale_from_length(trace.pixels[[0, -1]], chosen.gap, photograph.size, lens,
                                 photograph.focal_length)
    if chosen.board:
        pixels, table = find_board(photograph.pixels)
    elif chosen.scale:
        pixels, table = places_of(chosen.scale)
    else:
        return None
    return scale_from_points(pixels, table, photograph.size, lens, photograph.focal_length)


def _hanging(chosen: argparse.Namespace, trace: Trace, scale: Scale) -> HangingDlo:
    """Return the DLO that hangs between clamps."""
    if chosen.scale is not None and chosen.plumb is None:
        down = np.array([0.0, -1.0])
    else:
        down = straight_down(scale, trace.pixels, _two(chosen.plumb, '--plumb'))
    return hanging_dlo(trace, scale, down, chosen.count, chosen.hanging, _two(chosen.clamps, '--clamps'))


def _write(chosen: argparse.Namespace, chain: Chain, diameter: float) -> None:
    """Write the chain, or the trial of one that hangs."""
    if chosen.output.suffix.lower() != '.mcap':
        write_chain(chosen.output, chain)
        return
    radius = BY_NAME['self_collision'].value(diameter / 2)
    options = {'mass': 0.0 if chosen.mass is None else with_ends(chosen.mass), 'nodes': NODES,
               'self_collision': min(max(radius, 0.0), SCALE)}
    write_session(chosen.output, [hanging_trial('trial 1', chain)], Options.of(options).flat())


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


def _two(text: str | None, option: str) -> Floats | None:
    """Return the two pixels (2, 2) of an option; None: it is not given."""
    if text is None:
        return None
    pixels = pixels_of(text, option)
    if len(pixels) != 2:
        raise InputError(option, f'{len(pixels)} pixels', 'two', 'write "u,v u,v"')
    return pixels


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
            stream.write('no chain in metres: give --scale, --board, --length or --gap\n')
            return
        stream.write(f'DLO {1000 * length:.1f} mm long, {1000 * diameter:.1f} mm thick; '
                     f'scale within {1000 * scale.residual:.2f} mm\n')
        for warning in scale.warnings:
            stream.write(f'{warning}\n')
