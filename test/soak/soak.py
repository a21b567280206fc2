# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Soak: hostile input and injected faults, an hour at most; prints a table of what was lost and what died.

A campaign is a module beside this one, with `SHORT` and `FULL` (how much to try, in `make test` and
here) and `conduct(amount, seed, folder)`, which returns a `Tally`.

    python test/soak/soak.py [--seed S] [--amount N] [CAMPAIGN ...]
"""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
import sys
import tempfile
import time

FOLDER = Path(__file__).resolve().parent
sys.path += [str(FOLDER.parent / 'support'), str(FOLDER), str(FOLDER.parent)]

CAMPAIGNS: tuple[str, ...] = (
    'bombs',
    'disk',
    'flood',
    'fuzz',
    'interrupt',
    'kill',
    'resume',
    'scenes',
)
HEAD = ('campaign', 'tried', 'refused', 'lost', 'died', 'peak memory', 'longest silence', 'minutes')


def main() -> int:
    """Conduct the campaigns; the exit code is 1 where something was lost or died."""
    parser = argparse.ArgumentParser(description='hostile input and injected faults')
    parser.add_argument('campaign', nargs='*', default=list(CAMPAIGNS), help=', '.join(CAMPAIGNS))
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--amount', type=int, help='how much each campaign tries; default: its own FULL')
    chosen = parser.parse_args()
    rows, bad = [HEAD, ('---',) * len(HEAD)], 0
    for name in chosen.campaign:
        campaign = importlib.import_module(name)
        begun = time.monotonic()
        with tempfile.TemporaryDirectory(prefix=f'soak_{name}_') as folder:
            tally = campaign.conduct(chosen.amount or campaign.FULL, chosen.seed, Path(folder))
        rows.append((name, *tally.row(), f'{(time.monotonic() - begun) / 60:.1f}'))
        bad += tally.lost + tally.died
        print(f'{name}: {tally}', file=sys.stderr, flush=True)
    print('\n'.join(f'| {" | ".join(row)} |' for row in rows))
    return min(bad, 1)


if __name__ == '__main__':
    sys.exit(main())
