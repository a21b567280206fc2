# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
PlannerSession: what the node `planner` knows, and what it does with a message, a request or time that passes.

It imports no rclpy: it reaches ROS through a `Graph`, which the node implements.
Every error is reported in the log and in ``~/status``, and the node goes on working.
"""

from __future__ import annotations

import json
import time
from typing import Any, Callable, Mapping, Protocol, Union

from dlo_calibration.calibration.background import Background, Failure
from dlo_calibration.calibration.engines import SimulatorFactory
from dlo_calibration.calibration.options import Options
from dlo_calibration.errors import DEFECT, DloCalibrationError, InputError, told
from dlo_calibration.files.result import Description, read_description
from dlo_calibration.messages.codec import action_trajectory, ChainMessage, MessageTypes, NANOSECONDS, read
from dlo_calibration.messages.encoder import action_message
from dlo_calibration.messages.refusals import Refusals
from dlo_calibration.model.pose import Pose
from dlo_calibration.planning.checks import checked
from dlo_calibration.planning.plain import plain_plan
from dlo_calibration.planning.plan import Plan
from dlo_calibration.planning.planner import plan as find_plan
from dlo_calibration.planning.planner import PlanProgress
from dlo_calibration.report.plan_sentences import outcome
from dlo_calibration.ros.graph import decoded, Graph, why
from dlo_calibration.ros.newest import Newest
from dlo_calibration.ros.planner_diagnostics import (
    DONE,
    FAILED,
    plan_progress,
    planner_status,
    PLANNING,
    WAITING,
)
from dlo_calibration.ros.planner_markers import plan_markers
from dlo_calibration.ros.planner_options import PlannerOptions

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
PROGRESS_PERIOD = 0.1  # s between two messages; nobody reads faster
FIRST = 'the first actions are simulated'
PATIENCE = 0.5  # s that closing waits for the planning thread

Event = Union[PlanProgress, Plan, Failure]


class PlanFunction(Protocol):
    """Finds actions, as `dlo_calibration.planning.planner.plan` does."""

    def __call__(self, found: Description, start: Any, goal: Any, options: PlannerOptions, *,
                 simulation: Options, on_progress: Callable[[PlanProgress], None],
                 should_stop: Callable[[], bool], make_simulator: SimulatorFactory) -> Plan:
        """Return the plan."""


class PlannerSession:
    """
    Keeps the newest chain, goal and description, plans on request, and publishes the plan.

    It is not thread-safe.

    :param types: the message classes that `graph` encodes.
    :param make_simulator: builds the engine, in the planning thread.
    :param plan: finds the actions.
    :param clock: a monotonic clock [s].
    """

    status_period = 1.0  # s between two messages about no more than refusals

    def __init__(self, graph: Graph[PlannerOptions], types: MessageTypes, make_simulator: SimulatorFactory, *,
                 plan: PlanFunction = find_plan,
                 clock: Callable[[], float] = time.monotonic) -> None:
        self._graph, self._types, self._clock = graph, types, clock
        self._find = plan
        self._make_simulator = make_simulator
        self._background: Background[Event] = Background('plan')
        self._chains = {kind: Newest(lambda octets, kind=kind: self._chain(kind, octets))  # type: ignore[misc]
                        for kind in (CHAIN, GOAL)}
        self._descriptions = Newest(self._described)
        self._found: Description | None = None
        self._origin = ''  # of the description
        self._state, self._detail, self._last_refusal = WAITING, '', ''
        self._refusals = Refusals()
        self._status: dict[str, Any] = {}  # content of the last message
        self._told = float('-inf')  # when it was sent [s]
        self._progress: PlanProgress | None = None  # the newest, if it was not sent
        self._sent = float('-inf')  # when the last progress was sent [s]
        self._plan: Plan | None = None
        self._plans, self._under_way = 0, False
        self._frame_id = ''  # of the chains that are planned with
        self._back: Pose | None = None  # of the table's frame in that of the chains
        self._report()

    @property
    def planning(self) -> bool:
        """Tell whether a plan is under way."""
        return self._under_way

    def hear(self, kind: str, octets: bytes) -> None:
        """Take a message that came on an input topic; of a stream, not each one is read."""
        self._newest(kind).hear(octets, self._clock())
        self._read_due(kind)

    def describe(self, found: Description, origin: str) -> None:
        """
        Plan with this description from now on.

        :param origin: where it came from, in words.
        """
        self._found, self._origin = found, origin
        for problem in found.problems:
            self._graph.warn(f'{origin}: {problem}')
        self._graph.info(f'description from {origin}: a DLO of {found.length:.3g} m')
        self._report()

    def refuse(self, text: str) -> None:
        """Tell why something was refused, in the log and in ``~/status``; a repeated reason not each time."""
        self._last_refusal = self._refusals.add(told(text))
        self._tell_refusals()

    def request(self, name: str) -> tuple[bool, str]:
        """Serve a request `plan` or `stop`; return whether that succeeded, and the answer."""
        try:
            answer = {'plan': self._begin, 'stop': self._stop}[name]()
        except Exception as error:
            answer = str(error) if isinstance(error, DloCalibrationError) else f'{error!r}; {DEFECT}'
            self.refuse(answer)
            return False, answer
        self._report()
        return True, answer

    def tick(self) -> None:
        """Do what is due now; the node calls this many times a second."""
        for kind in INPUT_TYPES:
            self._read_due(kind)
        for event in self._background.waiting_events():
            self._take(event)
        if self._progress is not None and self._clock() - self._sent >= PROGRESS_PERIOD:
            self._send_progress()
        self._tell_refusals()
        self._report()

    def fail(self, text: str, *log: str) -> None:
        """Report a failure in ``~/status`` and in the log; `log` has the lines of the log if they differ."""
        self._state, self._detail = FAILED, told(text)
        for line in log or (text,):
            self._graph.error(line)
        self._report()

    def close(self) -> None:
        """End a plan under way, without publishing it."""
        self._background.stop()
        self._background.join(PATIENCE)
        for text in self._refusals.rest():
            self._graph.warn(text)

    # Messages

    def _newest(self, kind: str) -> Newest[Any]:
        return self._descriptions if kind == DESCRIPTION else self._chains[kind]

    def _read_due(self, kind: str) -> None:
        if self._newest(kind).due(self._clock()):
            self._read(kind)

    def _read(self, kind: str) -> None:
        """Read the message that waits, if there is one; a bad one is refused, and changes nothing."""
        try:
            new = self._newest(kind).read()
        except Exception as error:  # a defect of this package must not end the session
            self.refuse(why(error, kind))
            return
        if new and kind == DESCRIPTION and self._descriptions.content is not None:
            self.describe(self._descriptions.content, f'~/{DESCRIPTION}')

    def _chain(self, kind: str, octets: bytes) -> ChainMessage:
        message = read(kind, decoded(self._graph, kind, INPUT_TYPES[kind], octets))
        assert isinstance(message, ChainMessage)
        return message

    def _described(self, octets: bytes) -> Description:
        if len(octets) > LARGEST_DESCRIPTION:
            raise InputError(DESCRIPTION, f'{len(octets)} bytes', f'at most {LARGEST_DESCRIPTION}',
                             'check what publishes it')
        return read_description(decoded(self._graph, DESCRIPTION, INPUT_TYPES[DESCRIPTION], octets).data)

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
        start, goal, found = self._chains[CHAIN].content, self._chains[GOAL].content, self._found
        assert start is not None and goal is not None and found is not None
        if goal.frame_id != start.frame_id:
            raise InputError(str(goal), f'frame_id {goal.frame_id!r}',
                             f'that of the chain, {start.frame_id!r}', 'send both in one frame')
        options = self._graph.options()
        simulation = _simulation(found, options)
        pose = simulation.pose
        begin, end = (chain.chain if pose is None else pose.chain(chain.chain) for chain in (start, goal))
        checked(found, begin, end, simulation, options)

        def work(should_stop: Callable[[], bool]) -> Event:
            return self._find(found, begin, end, options, simulation=simulation,
                              on_progress=self._background.events.put, should_stop=should_stop,
                              make_simulator=self._make_simulator)

        self._background.join()  # it has put its last event, so it ends now
        self._background.begin(work)
        self._state, self._detail, self._frame_id, self._under_way = PLANNING, FIRST, start.frame_id, True
        self._plan, self._progress, self._plans = None, None, self._plans + 1
        self._back = None if pose is None else pose.inverse
        age = self._clock() - self._chains[CHAIN].came
        return f'plan {self._plans} begins, from the {start}, which came {age:.1f} s ago, to the {goal}'

    def _stop(self) -> str:
        if not self.planning:
            raise InputError('~/stop', 'no plan under way', 'one', 'call ~/plan first')
        self._background.stop()
        return 'the search ends now; the best plan so far is published'

    def _missing(self) -> list[str]:
        """Return the names of the inputs that have not come."""
        return [*(kind for kind, newest in self._chains.items() if newest.content is None),
                *([] if self._found else [DESCRIPTION])]

    # Events of the planning thread

    def _take(self, event: Event) -> None:
        if isinstance(event, PlanProgress):
            self._progress = event
            self._detail = '' if self._detail == FIRST else self._detail
        elif isinstance(event, Failure):
            self._under_way = False
            self.fail(event.text, f'no plan: {event.text}', *filter(None, [event.details]))
        else:
            self._under_way = False
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
                                           pose=self._back))
        if plan.actions:
            # With use_sim_time and no /clock, the node's time is 0, which is no stamp of an action.
            message = action_message(sent.actions[0].action.hands, stamp or NANOSECONDS, self._frame_id)
            self._send(ACTION, action_trajectory(self._types, message))
        self._state, self._plan = DONE, plan
        self._detail = outcome(plan) if plan.reached else f'{outcome(plan)} The search: {plan.stop_reason}.'
        self._graph.info(f'plan {self._plans}: {self._detail}')
        for remark in plan.remarks:
            self._graph.warn(remark)
        self._report()

    # Messages of the node

    def _send_progress(self) -> None:
        assert self._progress is not None
        self._send('progress', plan_progress(self._types, self._progress, self._graph.stamp()))
        self._progress, self._sent = None, self._clock()

    def _report(self) -> None:
        """Send the status if it differs from the last one."""
        missing, detail = self._missing(), self._detail
        if self._state == WAITING:
            detail = f'for {", ".join(f"~/{name}" for name in missing or ["plan"])}'
        content: dict[str, Any] = {
            'state': self._state, 'detail': detail, 'missing': missing, 'last_refusal': self._last_refusal,
            'description': self._origin, 'plans': self._plans}
        changed = {name for name, value in content.items() if value != self._status.get(name, content)}
        # A stream that is refused changes its count with each message.
        if changed and (changed != {'last_refusal'} or self._clock() - self._told >= self.status_period):
            self._status, self._told = content, self._clock()
            self._send('status', planner_status(self._types, stamp=self._graph.stamp(), plan=self._plan,
                                                **content))

    def _tell_refusals(self) -> None:
        if texts := self._refusals.due(self._clock()):
            for text in texts:
                self._graph.warn(text)
            self._report()

    def _send(self, name: str, message: Any) -> None:
        self._graph.publish(name, self._graph.encode(name, message))


def _simulation(found: Description, options: PlannerOptions) -> Options:
    """
    Return the options with which the DLO is simulated: those of its calibration, unless others replace them.

    :raises InputError: if it has a scene that cannot be used.
    """
    replacing = options.replacing()
    if found.refusal is not None and 'scene' not in replacing:
        raise InputError(DESCRIPTION, f'a scene that cannot be used ({found.refusal.came})', 'one that can',
                         "set the parameter description to a result.xml beside its scene, or 'scene=PATH' in "
                         'the parameter simulation')
    return Options.of({**found.options, **replacing})
