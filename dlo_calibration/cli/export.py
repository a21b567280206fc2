# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""The verb `export`: writes a calibrated DLO as a file for another simulator."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Callable, Mapping

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.cli.arguments import add_options, given_options
from dlo_calibration.cli.output import print_message
from dlo_calibration.errors import InputError, one_of
from dlo_calibration.export import export_mjcf, export_sdf, export_usd, sdf_meshes
from dlo_calibration.export.draws import drawn_dlos, draws_table
from dlo_calibration.export.mjcf import FORMS as MJCF_FORMS
from dlo_calibration.export.rope import ExportedRope
from dlo_calibration.export.usd import FORMS as USD_FORMS
from dlo_calibration.files.chain_file import read_chain_file
from dlo_calibration.files.result import read_result
from dlo_calibration.writing import make_folder, write_file

DRAWS_TABLE = 'draws.csv'
UNDETERMINED = ('keep', 'vary')
USED = ('nodes', 'table', 'table_height', 'scene')  # options
#: Format -> what makes its text, and the names of its forms, the first one by default.
FORMATS: Mapping[str, tuple[Callable[..., str], tuple[str, ...]]] = {
    'mjcf': (export_mjcf, MJCF_FORMS), 'usd': (export_usd, USD_FORMS), 'sdf': (export_sdf, ())}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    forms = '; '.join(f'of {name}: {", ".join(names)}' for name, (_, names) in FORMATS.items() if names)
    parser.add_argument('result', metavar='RESULT.xml', type=Path, help='the calibrated DLO')
    parser.add_argument('--format', required=True, choices=tuple(FORMATS), help=(
        'mjcf: MuJoCo 3 and 4; usd: Newton and Isaac Lab; sdf: Gazebo'))
    parser.add_argument('--from', dest='start', metavar='CHAIN', type=Path, required=True, help=(
        'where the DLO lies: a CSV file with rows x,y,z [m], first point to last, or an XML document'))
    parser.add_argument('--output', metavar='FILE', type=Path, required=True, help='the file to write')
    parser.add_argument('--form', metavar='NAME', help=f'form of the format ({forms}; default: the first)')
    parser.add_argument('--draws', metavar='N', type=int, help=(
        'write N files, FILE_1 and so on, with parameters drawn from the posterior, and draws.csv'))
    parser.add_argument('--seed', metavar='S', type=int, default=1,
                        help='random seed of the draws; default 1')
    parser.add_argument('--undetermined', choices=UNDETERMINED, default=UNDETERMINED[0], help=(
        'what draws do with a parameter that the trials do not determine: keep its value (default), or vary '
        'it over the range that the trials allow'))
    add_options(parser, USED, title='options of the DLO (default: those of the result)')


def act(chosen: argparse.Namespace, make_simulator: SimulatorFactory) -> int:
    """Execute the verb; return the exit code."""
    export, forms = FORMATS[chosen.format]
    if chosen.form is not None and chosen.form not in forms:
        raise InputError('--form', repr(chosen.form), one_of(forms, chosen.form) if forms else
                         f'no form: {chosen.format} has only one', 'correct it')
    description = read_result(chosen.result)
    for warning in description.file_options.warnings:
        print_message(warning)
    recorded = {name: value for name, value in description.file_options.values.items() if name in USED}
    options = replace(description.file_options, values=recorded).options(given_options(chosen))
    chain = read_chain_file(chosen.start)
    form = {} if chosen.form is None else {'form': chosen.form}
    texts, drawn = {chosen.output: ''}, [description]
    if chosen.draws is None:
        if chosen.undetermined != UNDETERMINED[0]:
            raise InputError('--undetermined', 'no draws', '--draws N', 'say how many')
        texts[chosen.output] = export(description, chain, options=options, **form)
    else:
        drawn = drawn_dlos(description, chain, options, chosen.draws, chosen.seed,
                           vary=chosen.undetermined == 'vary')
        texts = {chosen.output.with_stem(f'{chosen.output.stem}_{k}'):
                 export(dlo, chain, options=options, **form)
                 for k, dlo in enumerate(drawn, start=1)}
    make_folder(chosen.output.parent)
    for name, content in sdf_meshes(options).items() if chosen.format == 'sdf' else ():
        write_file(chosen.output.parent / name, content)
    for path, text in texts.items():
        write_file(path, text)
    if chosen.draws is not None:
        write_file(chosen.output.parent / DRAWS_TABLE, draws_table(drawn, [path.name for path in texts]))
    for warning in ExportedRope.of(drawn[0], chain, options).warnings:
        print_message(warning)
    first, *_, last = *texts, *texts
    print_message(f'the DLO is in {chosen.output}' if chosen.draws is None else
                  f'{chosen.draws} draws of the DLO are in {first} to {last.name}, and their values in '
                  f'{DRAWS_TABLE}')
    return 0
