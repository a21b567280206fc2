# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""Markers: show trials and their rollouts in RViz and Foxglove."""

from __future__ import annotations

from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import Any, Iterator, Sequence

import numpy as np

from dlo_calibration.calibration.result import CalibrationResult
from dlo_calibration.errors import InputError
from dlo_calibration.messages.codec import MessageTypes, OUTPUT_TYPES
from dlo_calibration.model.action import Hand, NO_ROTATION, rotation_matrix
from dlo_calibration.model.chain import Chain, Floats
from dlo_calibration.model.parameters import measured
from dlo_calibration.model.pose import Pose
from dlo_calibration.model.score import PointErrors, residuals
from dlo_calibration.model.trial import shown_goals, Trial
from dlo_calibration.planning.plan import Plan, PlannedAction
from dlo_calibration.report.drawing import hand_path
from dlo_calibration.report.obstacles import MOST_TRIANGLES, triangles_of
from dlo_calibration.simulation.scene import Obstacle, read_scene

# Types and actions of visualization_msgs/Marker.
CUBE, SPHERE, CYLINDER, LINE_STRIP, LINE_LIST, SPHERE_LIST, TEXT, TRIANGLE_LIST = 1, 2, 3, 4, 5, 7, 9, 11
ADD, DELETE_ALL = 0, 3

MOST_HANDS = 100  # drawn of a trial; a flood gives thousands, and drawing them would delay answers
MOST_POINTS = 200  # drawn of a chain or path; closer points cannot be distinguished on a screen

# Red, green and blue from 0 to 1: they differ in hue, and are bright enough for a dark background.
Colour = tuple[float, float, float]
INITIAL_COLOUR, GOAL_COLOUR, SIMULATED_COLOUR = (0.6, 0.6, 0.6), (0.25, 0.6, 1.0), (1.0, 0.55, 0.1)
TEXT_COLOUR, OBSTACLE_COLOUR = (0.9, 0.9, 0.9), (0.45, 0.45, 0.55)
HAND_COLOURS = ((0.2, 0.8, 0.3), (0.75, 0.45, 0.9), (0.75, 0.55, 0.4), (0.95, 0.5, 0.75))


def markers(types: MessageTypes, trials: Sequence[Trial], *, stamp: int, frame_id: str,
            result: CalibrationResult | None = None, pose: Pose | None = None,
            obstacles: Sequence[Obstacle] = ()) -> Any:
    """
    Build the message that shows trials; it replaces everything that earlier messages show.

    Namespaces are ``trial_1/initial``, ``/goal``, ``/simulated``, ``/error``, ``/hands``, ``/label``, and
    ``scene/obstacles``.
    An id follows from the index of a goal or a hand, so it is the same in every message.

    :param frame_id: of the session.
    :param pose: of that frame in the one of the trials; None: they are the same.
    :param result: its rollouts are shown with those of `trials` that it was calibrated on.
    :param obstacles: of the scene, in the frame of the trials.
    """
    header, back = types.header(stamp, frame_id), None if pose is None else pose.inverse
    built = [cleared(types, header), *_obstacle_markers(Brush(types, header, 'scene', 1.0, back), obstacles)]
    simulated = {} if result is None else {
        trial.name: (trial, chains) for trial, chains in zip(result.trials, result.chains, strict=True)}
    for k, trial in enumerate(trials):
        of_result, chains = simulated.get(trial.name, (trial, None))
        brush = Brush(types, header, f'trial_{k + 1}', 0.01 * trial.initial.length, back)
        built += _trial_markers(brush, trial, chains if _same(trial, of_result) else None, k)
    return types.build(OUTPUT_TYPES['markers'], markers=built)


def shown_obstacles(scene: str) -> tuple[Obstacle, ...]:
    """Return the obstacles in a URDF file; none where it cannot be read, as a request says why."""
    try:
        return _read(scene, Path(scene).stat().st_mtime_ns) if scene else ()
    except (OSError, ValueError, InputError):
        return ()


@lru_cache(1)
def _read(scene: str, _changed: int) -> tuple[Obstacle, ...]:
    return read_scene(scene)


def _obstacle_markers(brush: Brush, obstacles: Sequence[Obstacle]) -> Iterator[Any]:
    """Show obstacles; a capsule is a cylinder and two spheres."""
    numbers = count()
    for obstacle in obstacles:
        shape, sizes, position = obstacle.shape, obstacle.sizes, obstacle.position
        if shape == 'mesh':
            yield brush.marker('obstacles', next(numbers), TRIANGLE_LIST, group=3, most=3 * MOST_TRIANGLES,
                               points=triangles_of(obstacle).reshape(-1, 3), colours=[OBSTACLE_COLOUR])
            continue
        width = 2 * sizes[-1]
        bodies = [{'box': (CUBE, position, sizes), 'sphere': (SPHERE, position, np.full(3, width))}.get(
            shape, (CYLINDER, position, np.array([width, width, sizes[0]])))]
        if shape == 'capsule':
            half = rotation_matrix(obstacle.turn)[:, 2] * sizes[0] / 2
            bodies += [(SPHERE, position + side * half, np.full(3, width)) for side in (-1, 1)]
        for kind, at, lengths in bodies:
            yield brush.marker('obstacles', next(numbers), kind, at=at, turn=obstacle.turn, sizes=lengths,
                               colours=[OBSTACLE_COLOUR])


def cleared(types: MessageTypes, header: Any) -> Any:
    """Build the marker that removes all others: the first one of each message."""
    return Brush(types, header, '', 1.0).marker('', 0, SPHERE, action=DELETE_ALL)


def error_colour(share: float) -> Colour:
    """
    Return the colour of a point error: green for none, yellow for 1.5 % of the length, red from 3 % on.

    :param share: the error divided by the DLO's length.
    """
    red = min(max(share / 0.03, 0.0), 1.0)
    return min(2 * red, 1.0), min(2 - 2 * red, 1.0), 0.1


def alike(trials: Sequence[Trial], others: Sequence[Trial]) -> bool:
    """Return whether trials look the same: only the mean of a stream that goes on may differ."""
    return len(trials) == len(others) and all(
        len(trial.actions) == len(other.actions) and _same(trial, other)
        and np.array_equal(trial.initial.points, other.initial.points)
        for trial, other in zip(trials, others, strict=True))


def _same(trial: Trial, other: Trial) -> bool:
    """Return whether two trials have the same goals; a tracker that goes on changes the mean of a stream."""
    return trial is other or len(trial.goals) == len(other.goals) and all(
        min(goal.count, shown.count) > 1 and goal.time == shown.time or goal.chain is shown.chain
        or np.array_equal(goal.chain.points, shown.chain.points)
        for goal, shown in zip(trial.goals, other.goals, strict=True))


def _trial_markers(brush: Brush, trial: Trial, chains: Floats | None, k: int) -> Iterator[Any]:
    yield brush.line('initial', 0, trial.initial.points, INITIAL_COLOUR)
    for goal in shown_goals(len(trial.goals)):
        chain = trial.goals[goal].chain
        yield brush.spheres('goal', 2 * goal, chain.points[chain.seen], [GOAL_COLOUR], 1.2)
        yield brush.line('goal', 2 * goal + 1, chain.points, GOAL_COLOUR, 0.5)
        if chains is not None:
            yield brush.line('simulated', goal, chains[goal], SIMULATED_COLOUR)
            yield from _error_markers(brush, goal, chain.points[chain.seen], chains[goal][chain.seen],
                                      trial.initial.length)
    for place, hand in enumerate(trial.hands[:MOST_HANDS]):
        yield from hand_markers(brush, 3 * place, hand, trial.initial)
    text = trial.name
    if chains is not None:
        errors = PointErrors.of(residuals(trial, chains))
        text += f': mean error {measured(errors.mean, "m")}, max {measured(errors.max, "m")}'
    # Labels are stacked, because trials happen in the same place.
    above = [0.0, 0.0, brush.thickness * (6 + 5 * k)]
    yield brush.label('label', 0, trial.initial.points[0] + above, text)


def _error_markers(brush: Brush, goal: int, points: Floats, simulated: Floats,
                   length: float) -> Iterator[Any]:
    """Show each point's error: a sphere at the simulated point, and a line to the measured one."""
    colours = [error_colour(float(error) / length)
               for error in np.linalg.norm(simulated - points, axis=1)]
    yield brush.spheres('error', 2 * goal, simulated, colours, 1.7)
    pairs = np.stack([points, simulated], axis=1).reshape(-1, 3)
    yield brush.marker('error', 2 * goal + 1, LINE_LIST, points=pairs, scale=0.4, group=2,
                       colours=[colour for colour in colours for _ in range(2)])


def hand_markers(brush: Brush, first: int, hand: Hand, chain: Chain) -> Iterator[Any]:
    """
    Show a hand's path, the places that it grips, and the place where it opens.

    :param first: number of the first of three markers of a hand: 0, 3, 6...; it chooses the colour.
    :param chain: the DLO when the hand closes.
    """
    path, colour = hand_path(hand), HAND_COLOURS[first // 3 % len(HAND_COLOURS)]
    if np.ptp(path, axis=0).max() > 0:
        yield brush.line('hands', first, path, colour, 0.5)
    yield brush.spheres('hands', first + 1, chain.gripped(hand.grips, hand.offset), [colour], 2.2)
    yield brush.marker('hands', first + 2, CUBE, at=path[-1], colours=[colour], scale=2.0)


class Brush:
    """
    Draws the markers of one trial or plan.

    :param prefix: first part of all namespaces, e.g. ``trial_1``.
    :param thickness: of a line [m]; the `scale` of a marker is a multiple of it.
    :param pose: of the frame of what is drawn, in that of the header; None: they are the same.
    """

    def __init__(self, types: MessageTypes, header: Any, prefix: str, thickness: float,
                 pose: Pose | None = None) -> None:
        self._pose = pose or Pose(np.zeros(3), np.array(NO_ROTATION))
        self.thickness = thickness
        self._types = types
        self._header = header
        self._prefix = prefix
        build = types.build  # these are the same in all markers
        self._lifetime = build('builtin_interfaces/msg/Duration', sec=0, nanosec=0)
        self._texture = build('sensor_msgs/msg/CompressedImage', header=header, format='',
                              data=types.octets(b''))
        self._mesh = build('visualization_msgs/msg/MeshFile', filename='', data=types.octets(b''))

    def line(self, name: str, number: int, points: Floats, colour: Colour, scale: float = 1.0) -> Any:
        """Draw a line through (n, 3) points [m]."""
        return self.marker(name, number, LINE_STRIP, points=points, colours=[colour], scale=scale)

    def spheres(self, name: str, number: int, points: Floats, colours: Sequence[Colour],
                scale: float) -> Any:
        """Draw a sphere at each of (n, 3) points [m]; `colours` has one for all, or one for each."""
        return self.marker(name, number, SPHERE_LIST, points=points, colours=colours, scale=scale)

    def label(self, name: str, number: int, at: Floats, text: str) -> Any:
        """Write text at a position, (3,) [m]."""
        return self.marker(name, number, TEXT, at=at, colours=[TEXT_COLOUR], scale=4.0, text=text)

    def marker(self, name: str, number: int, kind: int, *, points: Floats | None = None,
               at: Floats | None = None, turn: Floats | None = None,
               colours: Sequence[Colour] = (TEXT_COLOUR,), scale: float = 1.0, sizes: Floats | None = None,
               text: str = '', group: int = 1, most: int = MOST_POINTS, action: int = ADD) -> Any:
        """
        Build a marker.

        :param points: (n, 3) [m] of a list or strip; a long one keeps only some groups of `group` points.
        :param at: (3,) [m] position; None: the origin.
        :param turn: (4,) orientation, quaternion x y z w; None: none.
        :param colours: one for the whole marker, or one per point.
        :param sizes: (3,) [m] along x, y and z, instead of `scale`.
        :param most: largest number of groups.
        """
        build, point = self._types.build, self._types.find('geometry_msgs/msg/Point')
        points = np.zeros((0, 3)) if points is None else points
        shown = _shown(len(points), group, most)
        x, y, z = self._pose.points(np.zeros(3) if at is None else at).tolist()
        turned = self._pose.orientation if turn is None else self._pose.orientations(turn)
        lengths = np.full(3, scale * self.thickness) if sizes is None else sizes
        # In `scale`, lines use only x, and texts only z.
        return build(
            'visualization_msgs/msg/Marker', header=self._header, ns=f'{self._prefix}/{name}' if name else '',
            id=number, type=kind, action=action,
            pose=build('geometry_msgs/msg/Pose', position=build('geometry_msgs/msg/Point', x=x, y=y, z=z),
                       orientation=build('geometry_msgs/msg/Quaternion',
                                         **dict(zip('xyzw', turned.tolist(), strict=True)))),
            scale=build('geometry_msgs/msg/Vector3', **dict(zip('xyz', lengths.tolist(), strict=True))),
            color=self._colour(colours[0]),
            lifetime=self._lifetime, frame_locked=False,
            points=[point(x=x, y=y, z=z) for x, y, z in points[shown].tolist()],
            colors=[self._colour(colours[k]) for k in shown] if len(colours) > 1 else [],
            texture_resource='', texture=self._texture, uv_coordinates=[], text=text, mesh_resource='',
            mesh_file=self._mesh, mesh_use_embedded_materials=False)

    def _colour(self, colour: Colour) -> Any:
        red, green, blue = colour
        return self._types.build('std_msgs/msg/ColorRGBA', r=red, g=green, b=blue, a=1.0)


def _shown(count: int, group: int, most: int) -> list[int]:
    """Return the indices of at most `most` groups, evenly spread over `count` points."""
    groups = count // group
    if groups <= most:
        return list(range(group * groups))
    chosen = np.linspace(0, groups - 1, most).round()
    return [group * int(k) + i for k in chosen for i in range(group)]


def plan_markers(types: MessageTypes, plan: Plan, *, stamp: int, frame_id: str,
                 pose: Pose | None = None, obstacles: Sequence[Obstacle] = ()) -> Any:
    """
    Build the message that shows a plan; it replaces everything that earlier messages show.

    Namespaces are ``plan/start``, ``/goal``, ``/label``, and for each action ``action_1/predicted``,
    ``/interval``, ``/hands``, ``/label``; and ``scene/obstacles``.  The colour of a prediction goes from that
    of the start to orange.  An interval is a cross at each point: the 90 % intervals of its coordinates.

    :param pose: of the plan's frame in that of `frame_id`; None: they are the same.
    :param obstacles: of the scene, in the plan's frame.
    """
    header = types.header(stamp, frame_id)
    thickness = 0.01 * plan.start.length
    brush = Brush(types, header, 'plan', thickness, pose)
    title = (f'{len(plan.actions)} action(s): mean error {measured(plan.error_before, "m")} before, '
             f'{measured(plan.error_after, "m")} after')
    built = [cleared(types, header), *_obstacle_markers(Brush(types, header, 'scene', 1.0, pose), obstacles),
             brush.line('start', 0, plan.start.points, INITIAL_COLOUR),
             brush.spheres('goal', 0, plan.goal.points, [GOAL_COLOUR], 1.2),
             brush.line('goal', 1, plan.goal.points, GOAL_COLOUR, 0.5),
             brush.label('label', 0, plan.goal.points[0] + [0.0, 0.0, 6 * thickness], title)]
    before = plan.start.points
    for k, action in enumerate(plan.actions):
        red, green, blue = np.add(np.multiply((k + 1) / len(plan.actions), SIMULATED_COLOUR),
                                  np.multiply(1 - (k + 1) / len(plan.actions), INITIAL_COLOUR)).tolist()
        brush = Brush(types, header, f'action_{k + 1}', thickness, pose)
        built += _action_markers(brush, action, before, k, (red, green, blue))
        before = action.predicted
    return types.build(OUTPUT_TYPES['markers'], markers=built)


def _action_markers(brush: Brush, action: PlannedAction, before: Floats, k: int,
                    colour: Colour) -> Iterator[Any]:
    """
    Show the k-th action.

    :param before: (n, 3) [m] the DLO when the hands close.
    """
    yield brush.line('predicted', 0, action.predicted, colour)
    yield brush.marker('interval', 0, LINE_LIST, points=_crosses(action), colours=[colour], scale=0.3,
                       group=6)
    for place, hand in enumerate(action.action.hands):
        yield from hand_markers(brush, 3 * place, hand, Chain(before))
    place = action.action.hands[0].positions[0]
    yield brush.label('label', 0, place + [0.0, 0.0, 6 * brush.thickness], f'{k + 1}. {action.name}')


def _crosses(action: PlannedAction) -> Floats:
    """Return the (6 n, 3) ends [m] of the three intervals of each point, axis by axis."""
    ends = np.repeat(action.predicted[:, None, None, :], 3, axis=1).repeat(2, axis=2)  # point, axis, end
    axes = np.arange(3)
    ends[:, axes, 0, axes], ends[:, axes, 1, axes] = action.lower, action.upper
    crosses: Floats = ends.reshape(-1, 3)
    return crosses
