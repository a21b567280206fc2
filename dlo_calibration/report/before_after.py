# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Before and after: a trial with the default and with the found parameters beside each other, moving."""

from __future__ import annotations

from base64 import b64encode
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Callable, Mapping, Sequence

import numpy as np

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import SimulationError
from dlo_calibration.evaluation.evaluation import with_hands
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import HANDS, measured, of_session
from dlo_calibration.model.score import PointErrors, residuals
from dlo_calibration.model.trial import Trial
from dlo_calibration.report.drawing import hand_colours, write_numbered
from dlo_calibration.report.figure import BEFORE, OBSERVED, Panel, SIMULATED
from dlo_calibration.simulation.motion import hands_at, Motion, simulated_motion
from dlo_calibration.writing import write_file

SIDE, GAP, HEAD = 360, 20, 24  # px: width of a view, distance between views, height of a caption
FRAMES = 60  # of a film, for its size
LONGEST, HOLD = 10.0, 1.5  # s: a longer motion is shown faster; how long the end is shown


def films(result: CalibrationResult, trials: Sequence[int], options: Options,
          make_simulator: SimulatorFactory, should_stop: Callable[[], bool] = lambda: False
          ) -> dict[int, Panel]:
    """
    Simulate trials of a result with the default and with the found parameters, and return their films.

    :param trials: their indices; those that cannot be simulated have no film.
    """
    space, drawn = result.space, dict[int, Panel]()
    found = result.physical()
    default = {**space.physical(space.values(space.default_point()), result.length),
               **{name: value for name, value in found.items() if name in HANDS}}
    with closing(make_simulator(options)) as simulator:
        for k in trials:
            if should_stop():
                break
            here = of_session(found, result.trials[k].session)
            trial = with_hands(result.trials[k], here)
            try:
                motions = [simulated_motion(trial, simulator, values) for values in (
                    of_session(default, trial.session), here)]
            except SimulationError:
                continue
            drawn[k] = film(trial, *motions)
    return drawn


def film(trial: Trial, before: Motion, after: Motion) -> Panel:
    """
    Return a film as an animated SVG image: from above, and below it from the side.

    :param before: the motion with the default parameters, on the left; `after` with the found ones.
    """
    errors = [PointErrors.of(residuals(trial, motion.ends)).mean for motion in (before, after)]
    words = [f'{what}: {measured(error, "m")} from the measurement' for what, error in zip(
        ('default parameters', 'found parameters'), errors, strict=True)]
    svg = _svg(trial, (before, after), words)
    return Panel(f'data:image/svg+xml;base64,{b64encode(svg.encode()).decode()}',
                 f'{trial.name}, moving; left with {words[0]}; right with {words[1]}')


def svg_of(panel: Panel) -> bytes:
    """Return the document of a film."""
    from base64 import b64decode

    return b64decode(panel.source.partition(',')[2])


def write_films(drawn: Mapping[int, Panel], folder: Path, note: Callable[[str], None],
                numbers: Sequence[int]) -> list[Path]:
    """
    Write ``trial_1.svg``, ... into a folder, which is created.

    :param numbers: of all trials.
    :raises DloCalibrationError: if files cannot be written; the others are.
    """
    def write(panel: Panel, path: Path) -> None:
        write_file(path, svg_of(panel))

    return write_numbered((partial(write, panel) for panel in drawn.values()), folder, '.svg', note,
                          [numbers[k] for k in drawn])


def _svg(trial: Trial, motions: Sequence[Motion], captions: Sequence[str]) -> str:
    """Return the document; its lines end at rest, so that a picture that does not move shows the end."""
    goal, start = trial.goals[-1].chain.observed, trial.initial.points
    everything = np.concatenate([start, goal[np.isfinite(goal).all(axis=1)], *(
        chains.reshape(-1, 3) for motion in motions for chains in (motion.chains, motion.ends)),
        *(hand.positions for hand in trial.hands)])
    along = _direction(everything[:, :2])
    views = [np.array([[1.0, 0, 0], [0, 1.0, 0]]), np.array([[*along, 0], [0, 0, 1.0]])]
    ends = [[(everything @ view.T).min(axis=0), (everything @ view.T).max(axis=0)] for view in views]
    scale = (SIDE - 2 * GAP) / max(float((high - low)[0]) for low, high in ends)
    scale = min(scale, SIDE / max(float((high - low)[1]) for low, high in ends))
    heights = [scale * float((high - low)[1]) + 2 * GAP for low, high in ends]
    height = HEAD + sum(heights)
    lines = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * SIDE} {height:.0f}" '
             f'font-family="sans-serif" font-size="13"><rect width="100%" height="100%" fill="white"/>']
    colours, dense = hand_colours([trial]), list(trial.hands)
    names = list(dict.fromkeys(hand.name for hand in dense))
    for column, (motion, caption) in enumerate(zip(motions, captions, strict=True)):
        keep = np.unique(np.linspace(0, len(motion.times) - 1, FRAMES).round().astype(int))
        chains = np.concatenate([motion.chains[keep], motion.ends[-1:]])
        times = np.append(motion.times[keep], motion.times[-1])
        span = max(float(times[-1] - times[0]), 1e-6)
        seconds = min(span, LONGEST) + HOLD
        keys = np.append((times[:-1] - times[0]) / span * (seconds - HOLD) / seconds, 1.0)
        # The end is held from the last moment of the motion on.
        chains, keys = np.concatenate([chains[:-1], chains[-1:], chains[-1:]]), np.insert(
            keys, -1, min(float(keys[-2]) + 1e-3, 1.0))
        times = np.append(times, times[-1])
        lines.append(f'<text x="{column * SIDE + GAP}" y="17">{caption}</text>')
        top = float(HEAD)
        for view, (low, high), tall in zip(views, ends, heights, strict=True):
            left = column * SIDE + GAP + (SIDE - 2 * GAP - scale * float((high - low)[0])) / 2

            def flat(points: Floats, view: Floats = view, low: Floats = low, left: float = left,
                     bottom: float = top + tall - GAP) -> Floats:
                places = (points @ view.T - low) * scale
                return np.stack([left + places[..., 0], bottom - places[..., 1]], axis=-1)

            lines.append(f'<polyline points="{_pixels(flat(start))}" fill="none" stroke="{BEFORE}" '
                         'stroke-width="2"/>')
            lines += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="{OBSERVED}" fill-opacity=".6"/>'
                      for x, y in flat(goal) if np.isfinite(x)]
            lines.append(f'<polyline points="{_pixels(flat(chains[-1]))}" fill="none" stroke="{SIMULATED}" '
                         'stroke-width="3" stroke-linejoin="round">'
                         + _animated('points', [_pixels(flat(chain)) for chain in chains], keys, seconds)
                         + '</polyline>')
            for name in names:
                places = flat(np.stack([hands_at(trial, float(time))[name][0] for time in times]))
                lines.append(
                    f'<rect x="-4" y="-4" width="8" height="8" fill="{colours[name]}" '
                    f'transform="translate({places[-1][0]:.1f} {places[-1][1]:.1f})">'
                    f'<animateTransform attributeName="transform" type="translate" '
                    + _timing([f'{x:.1f} {y:.1f}' for x, y in places], keys, seconds) + '/></rect>')
            top += tall
    return ''.join([*lines, '</svg>'])


def _direction(places: Floats) -> Floats:
    """Return the unit vector along which (k, 2) places spread most."""
    _, axes = np.linalg.eigh(np.cov(places.T))
    axis = axes[:, -1]
    return np.asarray(axis * (1 if axis[np.abs(axis).argmax()] > 0 else -1))


def _pixels(points: Floats) -> str:
    return ' '.join(f'{x:.1f},{y:.1f}' for x, y in points)


def _animated(attribute: str, values: Sequence[str], keys: Floats, seconds: float) -> str:
    return f'<animate attributeName="{attribute}" {_timing(values, keys, seconds)}/>'


def _timing(values: Sequence[str], keys: Floats, seconds: float) -> str:
    return (f'values="{";".join(values)}" keyTimes="{";".join(f"{key:.4f}" for key in keys)}" '
            f'dur="{seconds:.2f}s" repeatCount="indefinite"')
