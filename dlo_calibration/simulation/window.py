# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Window: shows simulated motions in PyBullet's window, in real time.

The window has a process of its own, because PyBullet ends its process if there is no screen, and when
the window is closed.
"""

from __future__ import annotations

from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
import os
import time
from typing import Callable, Mapping, Sequence

import numpy as np

from dlo_calibration.errors import DloCalibrationError
from dlo_calibration.model.chain import Floats, interpolation_matrix
from dlo_calibration.model.trial import Trial
from dlo_calibration.simulation.bullet import add_obstacle, IDENTITY, pybullet
from dlo_calibration.simulation.motion import hands_at, Motion
from dlo_calibration.simulation.scene import read_scene

FRAME_RATE = 30  # 1/s
MOST_FRAMES = 3000  # of a motion; a longer motion has fewer frames per second
PAUSE = 1.0  # s from the end of a motion to the start of the next
MOST_BEADS = 300  # spheres that the DLO is drawn with
HAND = 0.008  # m, half the edge of the cube that stands for a hand
ROPE_COLOUR, TABLE_COLOUR, OPEN = (0.84, 0.37, 0.0, 1.0), (0.93, 0.93, 0.9, 1.0), 0.35
Colour = tuple[float, ...]


@dataclass(frozen=True)
class ShownMotion:
    """
    A motion to show.

    :param name: shown beside it.
    :param times: (k,) [s], increasing.
    :param beads: (k, b, 3) [m] closely spaced points along the DLO.
    :param hands: for each hand its colour (red, green, blue: 0 to 1), its (k, 3) positions [m], and (k,)
        whether it is closed.
    """

    name: str
    times: Floats
    beads: Floats
    hands: tuple[tuple[Colour, Floats, tuple[bool, ...]], ...]

    @classmethod
    def of(cls, name: str, trial: Trial, motion: Motion, colours: Mapping[str, str],
           radius: float) -> ShownMotion:
        """
        Return the film of a simulated motion.

        :param colours: of the hands of the trial, by name: ``#rrggbb``.
        :param radius: of the DLO [m].
        """
        places = trial.initial.arc_lengths()
        count = int(np.clip(places[-1] / radius, 2, MOST_BEADS))
        weights = interpolation_matrix(places, np.linspace(0.0, places[-1], count))
        states = [hands_at(trial, float(time)) for time in motion.times]
        return cls(name, motion.times, weights @ motion.chains, tuple(
            (tuple(channel / 255 for channel in bytes.fromhex(colours[hand][1:])),
             np.array([state[hand][0] for state in states]),
             tuple(state[hand][1] for state in states)) for hand in states[0]))


def show(films: Sequence[ShownMotion], radius: float, table: float | None, scene: str = '',
         on_open: Callable[[], None] = lambda: None) -> None:
    """
    Show motions, one after the other and again, until the user closes the window.

    :param radius: of the DLO [m].
    :param table: height of the table [m]; None: there is none.
    :param scene: path of a URDF file with fixed obstacles; empty: none.
    :param on_open: called when the window is open.
    :raises DloCalibrationError: if no window can be opened.
    """
    spawn = get_context('spawn')
    here, there = spawn.Pipe()
    process = spawn.Process(target=_show, args=(there, films, radius, table, scene), daemon=True)
    process.start()
    there.close()  # so that each process notices the end of the other
    try:
        try:
            here.recv()
        except EOFError as error:
            raise DloCalibrationError(
                "PyBullet's window: no screen that it can open a window on; expected one with OpenGL; "
                'start the command on a desktop, or write an animation with --output') from error
        on_open()
        process.join()
    finally:
        here.close()
        process.terminate()
        process.join()


def _show(parent: Connection, films: Sequence[ShownMotion], radius: float, table: float | None, scene: str,
          clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep) -> None:
    """Open the window and show the films; this process ends with the window."""
    nowhere = os.open(os.devnull, os.O_WRONLY)  # PyBullet and OpenGL print what they find
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    client = pybullet.connect(pybullet.GUI, options='--width=1200 --height=800')
    if client < 0:
        return
    parent.send(None)
    try:
        stage = _Stage(client, films, radius, table)
        for obstacle in read_scene(scene) if scene else ():
            add_obstacle(client, obstacle)
        while films:
            for film in films:
                if not stage.show(film, clock, sleep, parent.poll):
                    return
    except (pybullet.error, KeyboardInterrupt):  # the window was closed, or the command is interrupted
        pass


class _Stage:
    """The bodies in the window, enough for every film, because adding or removing a body takes a frame."""

    def __init__(self, client: int, films: Sequence[ShownMotion], radius: float, table: float | None) -> None:
        self._client = client
        points = np.concatenate([film.beads.reshape(-1, 3) for film in films])
        low, high = points.min(axis=0), points.max(axis=0)
        self._extent = max(0.1, float((high - low).max()))
        self._place = np.array([*(low + high)[:2] / 2, low[2] if table is None else table])
        # Without rendering, bodies are made much faster.
        for what in (pybullet.COV_ENABLE_GUI, pybullet.COV_ENABLE_RENDERING):
            pybullet.configureDebugVisualizer(what, 0, physicsClientId=client)
        pybullet.resetDebugVisualizerCamera(self._extent, 0, -50, self._place.tolist(),
                                            physicsClientId=client)
        if table is not None:
            half = 0.75 * self._extent
            self._bodies([self._place - (0, 0, 0.005)], TABLE_COLOUR, pybullet.GEOM_BOX,
                         halfExtents=[half, half, 0.005])
        self._beads = self._bodies(np.zeros((max(film.beads.shape[1] for film in films), 3)), ROPE_COLOUR,
                                   pybullet.GEOM_SPHERE, radius=radius)
        self._hands = self._bodies(np.zeros((max(len(film.hands) for film in films), 3)), TABLE_COLOUR,
                                   pybullet.GEOM_BOX, halfExtents=[HAND] * 3)
        self._name = -1
        pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_RENDERING, 1, physicsClientId=client)

    def _bodies(self, places: Sequence[Floats] | Floats, colour: Sequence[float], kind: int,
                **sizes: object) -> Sequence[int]:
        """Add bodies of one shape that are drawn and never collide; return their ids."""
        shape = pybullet.createVisualShape(kind, rgbaColor=list(colour), physicsClientId=self._client,
                                           **sizes)
        bodies: Sequence[int] = pybullet.createMultiBody(
            0, baseVisualShapeIndex=shape, batchPositions=np.asarray(places).tolist(),
            physicsClientId=self._client)
        return bodies

    def show(self, film: ShownMotion, clock: Callable[[], float], sleep: Callable[[float], None],
             should_stop: Callable[[], bool]) -> bool:
        """Show a motion in real time; return whether to go on."""
        self._name = pybullet.addUserDebugText(
            film.name, (self._place + (0, 0.6 * self._extent, 0.02)).tolist(), textColorRGB=[0, 0, 0],
            replaceItemUniqueId=self._name, physicsClientId=self._client)
        times, begun, shown = film.times - film.times[0], clock(), -1
        while (now := clock() - begun) < times[-1] + PAUSE:
            frame = int(np.searchsorted(times, now, side='right')) - 1
            if frame != shown:
                self._show_frame(film, frame, shown)
                shown = frame
            if should_stop():  # the other process has ended
                return False
            sleep(0.5 / FRAME_RATE)
        return True

    def _show_frame(self, film: ShownMotion, frame: int, before: int) -> None:
        """Show a frame; `before` is the index of the previous frame, or -1."""
        points = film.beads[frame].tolist()
        for k, body in enumerate(self._beads):
            self._move(body, points[min(k, len(points) - 1)])  # surplus beads hide in the last one
        for k, body in enumerate(self._hands):
            if k >= len(film.hands):
                self._move(body, [0.0, 0.0, -1e3])
                continue
            colour, positions, closed = film.hands[k]
            self._move(body, positions[frame].tolist())
            if before < 0 or closed[frame] != closed[before]:
                pybullet.changeVisualShape(body, -1, physicsClientId=self._client,
                                           rgbaColor=[*colour, 1.0 if closed[frame] else OPEN])

    def _move(self, body: int, place: Sequence[float]) -> None:
        pybullet.resetBasePositionAndOrientation(body, place, IDENTITY, physicsClientId=self._client)
