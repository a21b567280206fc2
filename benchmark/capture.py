# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Measure the tracer on rendered photographs, whose truth is known.

    python benchmark/capture.py [--amount N] [--seed S]

Each photograph has 12 megapixels and shows a DLO of 0.6 m, 3 to 20 mm thick, on a plain, wooden, checked or
cloth ground, from up to 40 degrees from the vertical, through a lens with distortion; shapes, colours,
patterns, lamps, shadows, noise and hands are random.  Clicks are 10 pixels beside the middle line: both ends,
and one a bend.  The tables are printed, and written to benchmark/results/capture.md.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
import sys
from typing import Any

from figures import HERE, machine, table
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test' / 'support'))

from photographs import photograph  # noqa: E402
from rendered_scenes import distances, scene  # noqa: E402

from dlo_calibration.errors import InputError  # noqa: E402
from dlo_calibration.vision.tracer import Tracer  # noqa: E402

FAR = 0.002  # m; a line that is further off should say that it is not sure


def seconds() -> float:
    """Return the processor time that this process has used [s]; programs beside it do not count."""
    return os.times().user


def judge(seed: int) -> dict[str, Any]:
    """Trace one photograph; return its figures."""
    drawn = scene(seed)
    pixels = photograph(drawn.camera, drawn.curve, drawn.radius, drawn.look, seed)
    figures: dict[str, Any] = {'name': drawn.name, 'clicks': len(drawn.clicks)}
    try:
        begun = seconds()
        tracer = Tracer(pixels)
        trace = tracer.trace(drawn.clicks)
        figures['first'] = seconds() - begun
        again = drawn.clicks.copy()
        again[len(again) // 2] += 1.0
        begun = seconds()
        tracer.trace(again)
        figures['again'] = seconds() - begun
    except InputError as error:
        return {**figures, 'refused': str(error)}
    points, off = distances(drawn, trace.pixels)
    return {**figures, 'mean': 1e3 * points.mean(), 'worst': 1e3 * points.max(), 'off': off,
            'sure': trace.sure, 'inner': 1e3 * points[1:-1].mean(), 'across': 1e3 * off.mean()}


def tables(figures: list[dict[str, Any]]) -> str:
    """Return the summary and the table of all photographs."""
    good = [shown for shown in figures if 'refused' not in shown]
    off, sure = (np.concatenate([shown[name] for shown in good]) for name in ('off', 'sure'))
    means = np.array([shown['mean'] for shown in good])
    bad = off > FAR
    rows = [
        ('photographs, traced', f'{len(figures)}, {len(good)}'),
        ('mean distance of 21 points from the truth, mm', f'{means.mean():.2f}'),
        ('median photograph, worst photograph, mm', f'{np.median(means):.2f}, {means.max():.2f}'),
        ('worst point, mm', f'{max(shown["worst"] for shown in good):.2f}'),
        ('mean distance of the line from the DLO, across it, mm', f'{1e3 * off.mean():.2f}'),
        ('share of the line that says it is not sure', f'{100 * (~sure).mean():.1f}%'),
        (f'share off by more than {1e3 * FAR:g} mm, and of this not sure',
         f'{100 * bad.mean():.1f}%, {100 * (~sure[bad]).mean() if bad.any() else 100:.0f}%'),
        ('not sure where it is nearer than that', f'{100 * (~sure[~bad]).mean():.1f}%'),
        ('first trace with preparation, mean and longest, s of one core',
         f'{np.mean([shown["first"] for shown in good]):.2f}, {max(shown["first"] for shown in good):.2f}'),
        ('after another click, mean and longest, s of one core',
         f'{np.mean([shown["again"] for shown in good]):.2f}, {max(shown["again"] for shown in good):.2f}')]
    photographs = []
    for shown in figures:
        if 'refused' in shown:
            photographs.append((shown['name'], shown['clicks'], 'refused', '', '', '', '', ''))
        else:
            distance = (f'{shown[name]:.2f}' for name in ('mean', 'worst', 'across'))
            unsure = f'{100 * (~shown["sure"]).mean():.0f}%'
            times = (f'{shown[name]:.2f}' for name in ('first', 'again'))
            photographs.append((shown['name'], shown['clicks'], *distance, unsure, *times))
    columns = ('photograph', 'clicks', 'mean, mm', 'worst point, mm', 'across, mm', 'not sure', 'first, s',
               'again, s')
    return f'{table(("figure", "value"), rows)}\n\n{table(columns, photographs)}'


def main() -> None:
    """Make the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0].strip())
    parser.add_argument('--amount', type=int, default=40, help='of photographs')
    parser.add_argument('--seed', type=int, default=100, help='of the first photograph')
    options = parser.parse_args()
    import cv2

    cv2.setNumThreads(1)
    judge(0)  # loads libraries
    text = tables([judge(options.seed + k) for k in range(options.amount)])
    how = ('Rendered photographs of 12 megapixels.  An end that is seen obliquely looks longer than the '
           'axis, by up to half a radius.')
    (HERE / 'results' / 'capture.md').write_text(
        f'# capture\n\n`python benchmark/capture.py`\n\n{how} {machine()}\n\n{text}\n', encoding='utf-8')
    print(text)


if __name__ == '__main__':
    main()
