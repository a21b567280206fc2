# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Soak: hostile input and injected faults, an hour at most; prints a table of what was lost and what died.

A campaign is a module beside this one, with `FULL`, how much to try, and `conduct(amount, seed, folder)`,
which returns a `Tally`.

    python test/soak/soak.py [--seed S] [--amount N] [CAMPAIGN ...]
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
import importlib
from multiprocessing import get_context
from pathlib import Path
import sys
import tempfile
import time

FOLDER = Path(__file__).resolve().parent
sys.path += [str(FOLDER.parent / 'support'), str(FOLDER), str(FOLDER.parent)]

from tally import Tally  # noqa: E402

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
TITLE = """# Hostile input and injected faults

`make soak`. Refused: ended in one sentence, or was counted as dropped, or ended before there was a result.
Lost and died: what should not happen, as the modules in `test/soak` say. Silence: the longest time without an
answer, or until a command ended.
"""
HEAD = ('campaign', 'tried', 'refused', 'lost', 'died', 'peak memory', 'longest silence', 'minutes')


def main() -> int:
    """Conduct the campaigns; the exit code is 1 where something was lost or died."""
    parser = argparse.ArgumentParser(description='hostile input and injected faults')
    parser.add_argument('campaign', nargs='*', default=list(CAMPAIGNS), help=', '.join(CAMPAIGNS))
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--amount', type=int, help='how much each campaign tries; default: its own FULL')
    chosen = parser.parse_args()
    print(TITLE)
    print('\n'.join(f'| {" | ".join(row)} |' for row in (HEAD, ('---',) * len(HEAD))), flush=True)
    bad = False
    for name in chosen.campaign:
        # Each in a process of its own: the memory of a child is at least that of its parent.
        with ProcessPoolExecutor(1, get_context('spawn')) as executor:
            tally, minutes = executor.submit(conducted, name, chosen.amount, chosen.seed).result()
        print(f'| {" | ".join((name, *tally.row(), f"{minutes:.1f}"))} |', flush=True)
        bad = bad or tally.lost + tally.died > 0
    return int(bad)


def conducted(name: str, amount: int | None, seed: int) -> tuple[Tally, float]:
    """Conduct a campaign in a folder of its own; return its tally, and the minutes that it took."""
    campaign, begun = importlib.import_module(name), time.monotonic()
    with tempfile.TemporaryDirectory(prefix=f'soak_{name}_') as folder:
        tally = campaign.conduct(amount or campaign.FULL, seed, Path(folder))
    return tally, (time.monotonic() - begun) / 60


if __name__ == '__main__':
    sys.exit(main())
