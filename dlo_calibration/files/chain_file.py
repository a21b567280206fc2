# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Chain file: one chain as CSV with rows x,y,z [m], or as an XML document with a point chain."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dlo_calibration.errors import InputError
from dlo_calibration.files.xml import add_points, document, new_root, parse, read_chain, read_octets
from dlo_calibration.model.chain import Chain
from dlo_calibration.model.parameters import exact
from dlo_calibration.writing import write_file

WHAT, ROOT = 'chain', 'point_chain'
LARGEST_CSV = 2**20  # bytes; a chain has far fewer
LONGEST_ROW = 200  # characters


def chain_csv(chain: Chain) -> bytes:
    """Return a chain as CSV, with nan for points that were not seen; the annotations are left out."""
    return ''.join(f'{",".join(map(exact, point))}\n' for point in chain.observed.tolist()).encode()


def chain_xml(chain: Chain) -> bytes:
    """Return a chain as an XML document."""
    root = new_root(ROOT, version=1)
    add_points(root, chain)
    return document(root)


def write_chain(path: str | Path, chain: Chain) -> None:
    """
    Write a chain to a file: an XML document where its name ends in ``.xml``, else CSV.

    :raises InputError: where the file cannot be written.
    """
    write_file(path, chain_xml(chain) if Path(path).suffix.lower() == '.xml' else chain_csv(chain))


def read_chain_file(path: str | Path) -> Chain:
    """
    Read a chain from a CSV file or an XML document.

    :raises InputError: where it cannot be read, or is no chain.
    """
    where = f'{WHAT} {path}'
    octets = read_octets(path, WHAT, 'a CSV file with rows x,y,z, or an XML document with a point chain')
    if Path(path).suffix.lower() == '.xml':
        return read_chain(where, parse(octets, where, ROOT))
    if len(octets) > LARGEST_CSV:
        raise InputError(where, f'more than {LARGEST_CSV} bytes', 'rows x,y,z of one chain, in metres',
                         'name the file of one chain')
    rows = []
    for number, line in enumerate(octets.splitlines(), start=1):
        text = line[:LONGEST_ROW].decode('utf-8', 'replace').strip()
        if not text:
            continue
        try:
            x, y, z = map(float, text.split(','))
        except ValueError as error:
            raise InputError(f'{where}, line {number}', repr(text), 'a row x,y,z in metres',
                             'correct the file') from error
        rows.append((x, y, z))
    try:
        return Chain(np.array(rows).reshape(-1, 3))
    except InputError as error:
        raise InputError(where, error.came, error.expected, error.remedy) from error
