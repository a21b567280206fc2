# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Figures: measures times side by side, and writes tables."""

from __future__ import annotations

import json
import os
from pathlib import Path
import platform
import re
import time
from typing import Any, Callable, Iterable, Mapping, Sequence

HERE = Path(__file__).resolve().parent
SAMPLES = HERE.parent / 'msg_samples'


def side_by_side(benchmark: Any, calls: Mapping[str, Callable[[], object]], rounds: int,
                 clock: Callable[[], float] = time.process_time) -> dict[str, float]:
    """
    Return the shortest time [s] of each call; the calls take turns, so that disturbances affect all.

    :param benchmark: pytest-benchmark's fixture, which shows the last of the calls.
    :param clock: `process_time`, which other programs do not affect; `perf_counter` if several
        processes work.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}

    def take(name: str) -> None:
        begun = clock()
        calls[name]()
        times[name].append(clock() - begun)

    *others, last = calls
    benchmark.pedantic(take, (last,), setup=lambda: [take(name) for name in others] and None, rounds=rounds)
    shortest = {name: min(durations) for name, durations in times.items()}
    benchmark.extra_info.update({f'{name} [s]': seconds for name, seconds in shortest.items()})
    return shortest


def table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table in Markdown."""
    return '\n'.join(f'| {" | ".join(map(str, row))} |' for row in (columns, ['---'] * len(columns), *rows))


def kept(path: Path, make: Callable[[], Any]) -> Any:
    """Return the plain values of a file that an interrupted run has written; else make and write them."""
    if not path.exists():
        part = path.with_suffix('.part')
        part.write_text(json.dumps(make()), encoding='utf-8')
        part.rename(path)
    return json.loads(path.read_text(encoding='utf-8'))


def machine() -> str:
    """Describe the machine, its Python and its load."""
    model = re.search(r'model name\s*: (.*)', Path('/proc/cpuinfo').read_text(encoding='utf-8'))
    name = model[1] if model else platform.processor() or platform.machine()
    return (f'{name}, {len(os.sched_getaffinity(0))} cores, Python {platform.python_version()}; load average '
            f'of the last minute {os.getloadavg()[0]:.1f}.')


def write(name: str, command: str, how: str, text: str) -> None:
    """
    Write results/NAME.md, and the same text between the markers of that name in README.md.

    :param command: the command that makes the figures.
    :param how: how they were measured, in one or two sentences.
    """
    target = HERE / 'results' / f'{name}.md'
    target.parent.mkdir(exist_ok=True)
    target.write_text(f'# {name}\n\n`{command}`\n\n{how} {machine()}\n\n{text}\n', encoding='utf-8')
    readme = HERE / 'README.md'
    before = readme.read_text(encoding='utf-8')
    after, count = re.subn(rf'(<!-- {name} begins -->\n).*?(<!-- {name} ends -->)',
                           lambda match: f'{match[1]}\n{text}\n\n{match[2]}', before, flags=re.DOTALL)
    assert count == 1, f'README.md has {count} places for {name}'
    readme.write_text(after, encoding='utf-8')
    print(f'\n{text}')
