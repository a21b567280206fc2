# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
PlannerSession: the state of the node `planner`, and its reactions to messages, requests and time.

It imports no rclpy: it reaches ROS through a `NodeInterface`, which the node implements.
Every error is reported in the log and in ``~/status``, and the node goes on working.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
import json
import time
from typing import Any, Callable, Mapping, Union

from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import declared, MACHINE, Options, SIMULATION
from dlo_calibration.errors import DEFECT, InputError
from dlo_calibration.files.result import Description, read_description
from dlo_calibration.messages.codec import action_trajectory, ChainMessage, MessageTypes, NANOSECONDS, read
from dlo_calibration.messages.encoder import action_message
from dlo_calibration.model.pose import Pose
from dlo_calibration.planning.options import PlanOptions
from dlo_calibration.planning.plan import plain_plan, Plan
from dlo_calibration.planning.planner import checked, plan, PlanProgress
from dlo_calibration.report.sentences import outcome
from dlo_calibration.ros.diagnostics import DONE, plan_progress, planner_status, PLANNING, WAITING
from dlo_calibration.ros.markers import plan_markers, shown_obstacles
from dlo_calibration.ros.node_session import NodeInterface, NodeSession, NodeState, refusal_text
from dlo_calibration.workspace.worker import Background, Failure

RATE = 5.0  # messages read in a second, out of a stream that may be of any rate
BURST = 10  # read at once, after a pause


class Newest:
    """
    The newest message of a topic that could be used.

    A few messages are read as they come.  Of a stream, the newest one waits, and is read at RATE.

    :param read: returns the content of a message's bytes; an InputError refuses it.
    """

    def __init__(self, read: Callable[[bytes], Any]) -> None:
        self.content: Any = None
        self.came = float('-inf')  # when the content came [s]
        self._read = read
        self._waiting: tuple[bytes, float] | None = None
        self._allowed, self._last = float(BURST), float('-inf')

    def hear(self, octets: bytes, now: float) -> None:
        """Take the bytes of a message that came at the time `now` [s]; they replace those that wait."""
        self._waiting = octets, now

    def due(self, now: float) -> bool:
        """Return whether a message waits that may be read at the time `now` [s]."""
        if self._waiting is None:
            return False
        self._allowed = min(BURST, self._allowed + RATE * (now - self._last))
        self._last = now
        return self._allowed >= 1.0

    def read(self) -> bool:
        """
        Read the message that waits; return whether there was one.

        :raises InputError: if it cannot be used; the content does not change.
        """
        if self._waiting is None:
            return False
        (octets, came), self._waiting = self._waiting, None
        self._allowed -= 1.0
        self.content = self._read(octets)
        self.came = came
        return True


PLAN, PUBLISH = 'plan', 'publish'  # modes


@dataclass(frozen=True)
class PlannerOptions(PlanOptions):
    """Everything that a user of the node can set, with what a plan alone does not have."""

    description: str = declared(
        '', 'path of the result.xml of the DLO, relative to the working directory, which the node then '
        'publishes on ~/dlo_description; empty: the document that comes there', of=MACHINE)
    mode: str = declared(
        PLAN, 'what the node does: plan makes plans; publish only serves the description on '
        '~/dlo_description, latched, as robot_description is served', choices=(PLAN, PUBLISH), of=MACHINE)
    frame_pose: str = declared(
        '', "pose of the chains' frame in the table's frame, whose z is up: x y z [m] and a quaternion qx qy "
        'qz qw; plans are in the frame of the chains, too, while reach and no_go are in that of the table; '
        'empty: that of the description, with which the calibrator read the chains', of=MACHINE)
    simulation: tuple[str, ...] = declared(
        (), "options of the simulation that replace those of the description, each 'name=value', e.g. "
        f"'table_height=0.72'; the names are {', '.join(SIMULATION)}", of=MACHINE)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.frame_pose:
            Pose.of(self.frame_pose)
        self.replacing()

    def replacing(self) -> Mapping[str, Any]:
        """
        Return the options that replace those of the description, by name.

        :raises InputError: for an unknown name or a bad value.
        """
        declarations = {declaration.name: declaration for declaration in Options.declarations()
                        if declaration.name in SIMULATION}
        values: dict[str, Any] = {}
        for text in self.simulation:
            name, equals, value = text.partition('=')
            if not equals or name not in declarations:
                raise InputError('parameter simulation', repr(text), "'name=value' with a name out of "
                                 f'{", ".join(SIMULATION)}', 'correct it')
            values[name] = declarations[name].read(value)
        Options.of(values)
        return {**values, 'frame_pose': self.frame_pose} if self.frame_pose else values

    def check_together(self) -> None:
        """
        Check options that depend on one another.

        :raises InputError: if there is nothing to publish.
        """
        if self.mode == PUBLISH and not self.description:
            raise InputError('parameter description', 'an empty text', 'a path, in the mode publish',
                             'name the result.xml to publish')


CHAIN, GOAL, DESCRIPTION = 'chain', 'goal_chain', 'dlo_description'
ACTION, STEPS = 'action', 'steps'
INPUT_TYPES: Mapping[str, str] = {
    CHAIN: 'sensor_msgs/msg/PointCloud2',
    GOAL: 'sensor_msgs/msg/PointCloud2',
    DESCRIPTION: 'std_msgs/msg/String',
}
OUTPUT_TYPES: Mapping[str, str] = {
    'progress': 'diagnostic_msgs/msg/DiagnosticArray',
    'status': 'diagnostic_msgs/msg/DiagnosticArray',
    'markers': 'visualization_msgs/msg/MarkerArray',
    ACTION: 'trajectory_msgs/msg/MultiDOFJointTrajectory',
    STEPS: 'std_msgs/msg/String',
}
LARGEST_DESCRIPTION = 10**6  # bytes; a DLO of 10,000 points needs less, and it is read within 0.2 s
PROGRESS_PERIOD = 0.1  # s between two messages, which people read
FIRST = 'the first actions are simulated'
PATIENCE = 0.5  # s that closing waits for the planning thread

Event = Union[PlanProgress, Plan, Failure]


class PlannerSession(NodeSession[PlannerOptions]):
    """
    Keeps the newest chain, goal and description, plans on request, and publishes the plan.

    It is not thread-safe.

    :param types: the message classes that `graph` encodes.
    :param make_simulator: builds the engine, in the planning thread.
    :param clock: a monotonic clock [s].
    """

    def __init__(self, graph: NodeInterface[PlannerOptions], types: MessageTypes,
                 make_simulator: SimulatorFactory, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(graph, types, INPUT_TYPES, NodeState(WAITING), clock)
        self.requests = {'plan': self._begin, 'stop': self._stop}
        self._make_simulator = make_simulator
        self._background: Background[Event] = Background('plan')
        self._newest = {
            CHAIN: Newest(partial(self._chain, CHAIN)), GOAL: Newest(partial(self._chain, GOAL)),
            DESCRIPTION: Newest(self._described)}
        self._description: Description | None = None
        self._origin = ''  # of the description
        self._progress: PlanProgress | None = None  # the newest, if it was not sent
        self._sent = float('-inf')  # when the last progress was sent [s]
        self._plan: Plan | None = None
        self._plans, self.planning = 0, False  # whether a plan is under way
        self._frame_id = ''  # of the chains that are planned with
        self._scene = ''  # that is planned with
        self._back: Pose | None = None  # of the table's frame in that of the chains
        self._report()

    def hear(self, kind: str, octets: bytes) -> None:
        """Take a message that came on an input topic; of a stream, only some are read."""
        self._newest[kind].hear(octets, self._clock())
        self._read_due(kind)

    def describe(self, description: Description, origin: str) -> None:
        """
        Plan with this description from now on.

        :param origin: where it came from, in words.
        """
        self._description, self._origin = description, origin
        for warning in description.file_options.warnings:
            self._graph.warn(f'{origin}: {warning}')
        self._graph.info(f'description from {origin}: a DLO of {description.length:.3g} m')
        self._report()

    def tick(self) -> None:
        """Do what is due now; the node calls this many times a second."""
        for kind in INPUT_TYPES:
            self._read_due(kind)
        for event in self._background.waiting_events():
            self._take(event)
        if self._progress is not None and self._clock() - self._sent >= PROGRESS_PERIOD:
            self._send_progress()
        self._report_refusals()
        self._report()

    def close(self) -> None:
        """End a plan under way, without publishing it."""
        self._background.stop()
        self._background.join(PATIENCE)
        for text in self._state.counted.rest():
            self._graph.warn(text)

    # Messages

    def _read_due(self, kind: str) -> None:
        if self._newest[kind].due(self._clock()):
            self._read(kind)

    def _read(self, kind: str) -> None:
        """Read the message that waits, if any; a refused one changes nothing."""
        try:
            new = self._newest[kind].read()
        except Exception as error:  # a defect of this package must not end the session
            self.refuse(refusal_text(error, kind))
            return
        if new and kind == DESCRIPTION:
            self.describe(self._newest[kind].content, f'~/{DESCRIPTION}')

    def _chain(self, kind: str, octets: bytes) -> ChainMessage:
        message = read(kind, self._decoded(kind, octets))
        assert isinstance(message, ChainMessage)
        return message

    def _described(self, octets: bytes) -> Description:
        if len(octets) > LARGEST_DESCRIPTION:
            raise InputError(DESCRIPTION, f'{len(octets)} bytes', f'at most {LARGEST_DESCRIPTION}',
                             'check what publishes it')
        return read_description(self._decoded(DESCRIPTION, octets).data)

    # Requests

    def _begin(self) -> str:
        if self.planning:
            raise InputError('~/plan', 'a plan under way', 'none', 'wait for it, or call ~/stop first')
        self._graph.hear_waiting()  # messages sent before the request belong to this plan
        for kind in INPUT_TYPES:
            self._read(kind)
        if missing := self._missing():
            raise InputError('~/plan', f'no {", no ".join(missing)}', 'one of each',
                             'send it, then call ~/plan again')
        start, goal, description = self._newest[CHAIN].content, self._newest[GOAL].content, self._description
        assert description is not None
        if goal.frame_id != start.frame_id:
            raise InputError(str(goal), f'frame_id {goal.frame_id!r}',
                             f'that of the chain, {start.frame_id!r}', 'send both in one frame')
        options = self._graph.options()
        simulation = _simulation(description, options)
        pose = simulation.pose
        begin, end = (chain.chain if pose is None else pose.chain(chain.chain) for chain in (start, goal))
        checked(description, begin, end, simulation, options)

        def work(should_stop: Callable[[], bool]) -> Event:
            return plan(description, begin, end, options, simulation=simulation,
                        on_progress=self._background.events.put, should_stop=should_stop,
                        make_simulator=self._make_simulator)

        self._background.join()  # it has put its last event, so it ends now
        self._background.begin(work)
        self._state.name, self._state.detail = PLANNING, FIRST
        self._frame_id, self._scene, self.planning = start.frame_id, simulation.scene, True
        self._plan, self._progress, self._plans = None, None, self._plans + 1
        self._back = None if pose is None else pose.inverse
        age = self._clock() - self._newest[CHAIN].came
        return f'plan {self._plans} begins, from the {start}, which came {age:.1f} s ago, to the {goal}'

    def _stop(self) -> str:
        if not self.planning:
            raise InputError('~/stop', 'no plan under way', 'one', 'call ~/plan first')
        self._background.stop()
        return 'the search ends now; the best plan so far is published'

    def _missing(self) -> list[str]:
        """Return the names of the inputs that have not come."""
        return [*(kind for kind in (CHAIN, GOAL) if self._newest[kind].content is None),
                *([] if self._description else [DESCRIPTION])]

    # Events of the planning thread

    def _take(self, event: Event) -> None:
        if isinstance(event, PlanProgress):
            self._progress = event
            if self._state.detail == FIRST:
                self._state.detail = ''
        elif isinstance(event, Failure):
            self.planning = False
            self.fail(event.text, f'no plan: {event.text}', *filter(None, [event.details]))
        else:
            self.planning = False
            try:
                self._finish(event)
            except Exception as error:  # it could not be published
                self.fail(f'{error!r}; {DEFECT}')

    def _finish(self, plan: Plan) -> None:
        if self._progress is not None:
            self._send_progress()
        stamp, sent = self._graph.stamp(), plan if self._back is None else plan.moved(self._back)
        self._send(STEPS, self._types.build(OUTPUT_TYPES[STEPS], data=json.dumps(plain_plan(sent))))
        self._send('markers', plan_markers(self._types, plan, stamp=stamp, frame_id=self._frame_id,
                                           pose=self._back, obstacles=shown_obstacles(self._scene)))
        if plan.actions:
            # With use_sim_time and no /clock, the node's time is 0, which is no stamp of an action.
            message = action_message(sent.actions[0].action.hands, stamp or NANOSECONDS, self._frame_id)
            self._send(ACTION, action_trajectory(self._types, message))
        detail = outcome(plan) if plan.reached else f'{outcome(plan)} The search: {plan.stop_reason}.'
        self._state.name, self._state.detail, self._plan = DONE, detail, plan
        self._graph.info(f'plan {self._plans}: {detail}')
        for warning in plan.warnings:
            self._graph.warn(warning)
        self._report()

    # Messages of the node

    def _send_progress(self) -> None:
        assert self._progress is not None
        self._send('progress', plan_progress(self._types, self._progress, self._graph.stamp()))
        self._progress, self._sent = None, self._clock()

    def _report(self) -> None:
        """Send the status if it differs from the last one."""
        state, missing = self._state, self._missing()
        detail = state.detail
        if state.name == WAITING:
            detail = f'for {", ".join(f"~/{name}" for name in missing or ["plan"])}'
        content: dict[str, Any] = {
            'state': state.name, 'detail': detail, 'missing': ' '.join(missing),
            'last_refusal': state.last_refusal, 'description': self._origin, 'plans': self._plans}
        # A stream that is refused changes its count with each message.
        if self._status_is_due(content, 'last_refusal'):
            self._send('status', planner_status(self._types, self._graph.stamp(), content, self._plan))

    def _send(self, name: str, message: Any) -> None:
        self._graph.publish(name, self._graph.encode(name, message))


def _simulation(description: Description, options: PlannerOptions) -> Options:
    """
    Return the options with which the DLO is simulated: those of its calibration, unless others replace them.

    :raises InputError: if it has a scene that cannot be used.
    """
    replacing = options.replacing()
    refusal = description.file_options.refusal
    if refusal is not None and 'scene' not in replacing:
        raise InputError(DESCRIPTION, f'a scene that cannot be used ({refusal.came})',
                         'one that can', 'set the parameter description to a result.xml beside its scene, '
                         "or 'scene=PATH' in the parameter simulation")
    return Options.of({**description.file_options.values, **replacing})
