# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Animations: the simulated motion of a trial, as a GIF."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Callable, Iterator, Mapping, Sequence

import numpy as np
from PIL.Image import Dither, fromarray, Image

from dlo_calibration.evaluation.evaluation import with_hands
from dlo_calibration.model.chain import Floats
from dlo_calibration.model.parameters import number
from dlo_calibration.model.trial import Trial
from dlo_calibration.report.drawing import hand_colours, View, write_numbered
from dlo_calibration.report.figure import add_legend, as_text, blank_figure, OBSERVED, settings, SIMULATED
from dlo_calibration.simulation.motion import FRAME_RATE, hands_at, Motion, simulated_motion
from dlo_calibration.simulation.protocol import Simulator
from dlo_calibration.simulation.scene import Obstacle
from dlo_calibration.writing import whole

DOTS_PER_INCH = 80  # enough to read the legend; more makes a large file
PAUSE = 1600  # ms, to look at the end


@dataclass(frozen=True)
class Captions:
    """
    What the parts of an animation are called.

    :param title: begins the title.
    :param start: the initial chain.
    :param goal: the last goal chain; empty: it is not drawn.
    """

    title: str
    start: str = 'before the action, measured'
    goal: str = 'after the action, measured'


def write_animation(trial: Trial, motion: Motion, path: str | Path,
                    captions: Captions | None = None, obstacles: Sequence[Obstacle] = ()) -> None:
    """
    Write a GIF with the simulated motion and the goal, from above (left) and from the side (right).

    :param captions: None: the chains of the trial were measured.
    :param obstacles: of the scene.
    :raises InputError: if the file cannot be written.
    """
    speed = max(1.0, (motion.times[-1] - motion.times[0]) * FRAME_RATE / max(len(motion.times) - 1, 1))
    captions = captions or Captions(f'{trial.name}, simulated')
    with settings():
        scene = _Scene(trial, motion, speed, captions, obstacles)
        frames = [scene.frame(float(time), chain, f't = {time:.2f} s')  # of constant width
                  for time, chain in zip(motion.times, motion.chains, strict=True)]
        frames.append(scene.frame(float(motion.times[-1]), motion.ends[-1], 'at the end'))
    # All frames share a palette. To choose one for each frame takes twenty times as long.
    colours = frames[0].quantize(dither=Dither.NONE)
    first, *others = (frame.quantize(palette=colours, dither=Dither.NONE) for frame in frames)
    with whole(Path(path)) as new:
        first.save(new, 'GIF', save_all=True, append_images=others, loop=0,
                   duration=[*[1000 // FRAME_RATE] * len(others), PAUSE])


def write_animations(trials: Sequence[Trial], simulator: Simulator, physical: Mapping[str, float],
                     folder: Path, note: Callable[[str], None], numbers: Sequence[int],
                     obstacles: Sequence[Obstacle] = ()) -> list[Path]:
    """
    Simulate trials and write ``trial_1.gif``, ``trial_2.gif``, ... into a folder, which is created.

    :param physical: parameters by name (SI units).
    :param note: called with the path of each written file.
    :param numbers: of the trials.
    :raises DloCalibrationError: if files cannot be written; the others are.
    :raises SimulationError: if a trial cannot be simulated.
    """
    return write_numbered(
        (partial(write_animation, trial, simulated_motion(trial, simulator, physical), obstacles=obstacles)
         for trial in (with_hands(trial, physical) for trial in trials)),
        folder, '.gif', note, numbers)


class _Scene:
    """
    A figure in which only the simulated chain and the hands move.

    What does not move is drawn once, as that takes most of the time.
    """

    def __init__(self, trial: Trial, motion: Motion, speed: float, captions: Captions,
                 obstacles: Sequence[Obstacle]) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        self._figure = blank_figure(10.5, 4.8)
        self._figure.set_dpi(DOTS_PER_INCH)
        self._trial = trial
        self._captions = captions
        self._speed = '' if speed < 1.05 else f', {number(speed)} times as fast as in reality'
        self._colours = hand_colours([trial])
        self._moving: list[tuple[View, Any, Any, Mapping[str, Any]]] = []
        self._tracked = bool(captions.goal) and any(not goal.stable for goal in trial.goals)
        self._title = self._figure.suptitle(' ', fontweight='bold')
        axes = self._figure.subplots(1, 2)
        for subplot, above in zip(axes, (True, False), strict=True):
            view = View(subplot, trial, above=above)
            view.draw_obstacles(obstacles)
            self._moving.append(self._prepare(view, motion))
        add_legend(self._figure, list(axes), columns=3)
        for artist in self._artists():
            artist.set_animated(True)  # so that `draw` leaves it out
        canvas: Any = FigureCanvasAgg  # its methods have no types
        self._canvas = canvas(self._figure)
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(self._figure.bbox)

    def frame(self, time: float, chain: Floats, when: str) -> Image:
        """Return a picture of the chain and the hands at a time of the trial [s]; `when` is in the title."""
        self._show(time, chain, when)
        self._canvas.restore_region(self._still)
        for artist in self._artists():
            self._figure.draw_artist(artist)
        return fromarray(np.asarray(self._canvas.buffer_rgba())[:, :, :3])

    def _artists(self) -> Iterator[Any]:
        """Yield what moves, in the order in which it is drawn."""
        yield self._title
        for _, measured, line, hands in self._moving:
            yield from (measured, line, *hands.values())

    def _prepare(self, view: View, motion: Motion) -> tuple[View, Any, Any, Mapping[str, Any]]:
        view.draw_start(self._captions.start)
        goal = self._trial.goals[-1].chain.observed if self._captions.goal else np.full((1, 3), np.nan)
        measured, = view.axes.plot(
            *view.flat(goal), 'o', color=OBSERVED, markersize=4, alpha=0.5, linestyle='none', zorder=2,
            label='latest measured chain' if self._tracked else self._captions.goal or None)
        line, = view.axes.plot(*view.flat(motion.chains[0]), 'o-', color=SIMULATED, linewidth=2.5,
                               markersize=3, label='simulated', zorder=3)
        hands = {}
        for hand in self._trial.hands:
            if hand.name not in hands:
                hands[hand.name], = view.axes.plot(
                    *view.flat(hand.positions[:1]), 's', color=self._colours[hand.name], markersize=9,
                    linestyle='none', label=as_text(f'{hand.name} (hollow: open)'), zorder=4)
        everything = np.concatenate([*motion.chains, *motion.ends,
                                     *(hand.positions for hand in self._trial.hands)])
        view.axes.update_datalim(view.flat(everything).T)
        view.axes.autoscale_view()
        return view, measured, line, hands

    def _show(self, time: float, chain: Floats, when: str) -> None:
        self._title.set_text(as_text(f'{self._captions.title}: {when}{self._speed}'))
        current = hands_at(self._trial, time)
        seen = [goal.chain for goal in self._trial.goals if goal.time <= time] or [self._trial.initial]
        for view, measured, line, hands in self._moving:
            line.set_data(*view.flat(chain))
            if self._tracked:
                measured.set_data(*view.flat(seen[-1].observed))
            for name, (position, closed) in current.items():
                hands[name].set_data(*view.flat(position[None]))
                hands[name].set_markerfacecolor(self._colours[name] if closed else 'none')
