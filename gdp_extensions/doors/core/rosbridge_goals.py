"""Goals of one rosbridge client: ``send_action_goal`` and ``cancel_action_goal`` of the rosbridge v2 protocol.

Sans-I/O. Source: the ROS 2 design article on actions: three services and a topic of feedback below the action's name.
A goal continues when its client has gone, as with rosbridge_suite.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import orjson

from gdp.errors import GdpError, LocalError
from gdp.ros_names import ACTION_INFIX, resolved
from gdp_extensions.doors.core.client_fields import Fields, identifier, ros2_type, text_of, word, wrong
from gdp_extensions.doors.core.client_queue import ClientQueue, Pending
from gdp_extensions.doors.core.hub import REASON_MAX, DoorSession, Hub, Publication
from proxy.serial.channel import Channel, Service
from proxy.serial.rosbridge_json import codec_of

GOALS_MAX: Final = 256
_SEND, _RESULT, _CANCEL = "send_goal", "get_result", "cancel_goal"
SENDS: Final = f"{ACTION_INFIX}{_SEND}"
_FEEDBACK: Final = f"{ACTION_INFIX}feedback"
_ID: Final = slice(4, 20)  # of the goal, behind the encapsulation of its feedback
_UNKNOWN: Final = 0  # action_msgs/msg/GoalStatus


@dataclass(slots=True, eq=False)
class _Goal:
    action: str  # as the client writes it
    name: str
    number: object  # the client's id
    goal_id: bytes
    key: int  # of its feedback in the client's queue
    wants_feedback: bool
    is_cancelling: bool = False
    feedback: Channel | None = None

    @property
    def uuid(self) -> dict[str, list[int]]:
        """Return its id as a client writes it."""
        return {"uuid": list(self.goal_id)}


@dataclass(frozen=True, slots=True)
class GoalStep:
    """A request of a goal, to one of the action's services."""

    goal: _Goal
    part: str
    service: Service


class RosbridgeGoals:
    """The goals under way of one connection.

    Args:
        next_key: returns a key of the queue that nothing else uses.
        new_id: returns 16 random bytes.
    """

    def __init__(
        self,
        hub: Hub,
        session: DoorSession,
        queue: ClientQueue,
        next_key: Callable[[], int],
        new_id: Callable[[], bytes],
    ) -> None:
        self._hub = hub
        self._session = session
        self._queue = queue
        self._next_key = next_key
        self._new_id = new_id
        self._goals: dict[int, _Goal] = {}  # by key

    def call(self, fields: Fields, now_ns: int) -> None:
        """Send a goal. Raises ``GdpError``: the message is malformed."""
        action, number = word(fields, "action"), identifier(fields, None)
        type_name = ros2_type(word(fields, "action_type", is_optional=True), "action")
        goal = _Goal(action, resolved(action), number, self._new_id(), self._next_key(), fields.get("feedback") is True)
        self._goals[goal.key] = goal
        try:
            if len(self._goals) > GOALS_MAX:
                raise LocalError(f"{action}: more than {GOALS_MAX} goals are under way")
            if number is not None and sum(each.number == number for each in self._goals.values()) > 1:
                raise LocalError(f"{action}: a goal with this id is under way")
            self._request(goal, _SEND, {"goal_id": goal.uuid, "goal": fields.get("args") or {}}, type_name, now_ns)
        except GdpError as error:
            self._fail(goal, str(error))

    def cancel(self, fields: Fields) -> None:
        """Cancel a goal. Raises ``GdpError``: no such goal is under way, or its server cannot be reached."""
        name, number = resolved(word(fields, "action")), identifier(fields, None)
        found = [each for each in self._goals.values() if (each.name, each.number) == (name, number)]
        if not found:
            raise LocalError(f"cancel_action_goal {name}: no goal with this id is under way")
        for goal in found:
            if not goal.is_cancelling:
                self._request(goal, _CANCEL, {"goal_info": {"goal_id": goal.uuid}})
                goal.is_cancelling = True

    def queue_feedback(self, publication: Publication, stamp_ns: int, raw: bytes) -> None:
        """Queue feedback of the client's goals; ignore any other message."""
        topic = publication.channel.topic
        if not self._goals or not topic.endswith(_FEEDBACK):
            return
        for goal in self._goals.values():
            if goal.wants_feedback and raw[_ID] == goal.goal_id and topic == goal.name + _FEEDBACK:
                goal.feedback = publication.channel
                self._queue.put(goal.key, stamp_ns, raw)

    def encode(self, pending: Pending) -> str | None:
        """Return ``action_feedback``; None: the message is of a subscription."""
        goal = self._goals.get(pending.key)
        if goal is None or goal.feedback is None:
            return None
        try:
            values = _read(goal.feedback, pending.raw).get("feedback", {})
        except GdpError as error:
            return text_of(op="status", level="error", msg=f"{goal.action}: {error}"[:REASON_MAX])
        return text_of(goal.number, op="action_feedback", action=goal.action, values=values)

    def pass_answer(self, step: GoalStep, raw: bytes) -> None:
        """Go on with a goal, by the response of its server."""
        goal = step.goal
        if step.part == _CANCEL:
            goal.is_cancelling = False  # what it brings about is the result
            return
        if goal.key not in self._goals:
            return
        try:
            answer = _read(step.service.response, raw)
            if step.part == _RESULT:
                self._end(goal, answer.get("result", {}), answer.get("status", _UNKNOWN), result=True)
            elif answer.get("accepted") is True:
                self._request(goal, _RESULT, {"goal_id": goal.uuid})
            else:
                self._fail(goal, f"{goal.action}: its server rejected the goal")
        except GdpError as error:
            self._fail(goal, str(error))

    def pass_refusal(self, step: GoalStep, reason: str) -> None:
        """End a goal whose server does not respond; a cancellation may be tried again."""
        if step.part == _CANCEL:
            step.goal.is_cancelling = False
            message = f"cancel_action_goal {step.goal.action}: {reason}"[:REASON_MAX]
            self._queue.put_control(text_of(step.goal.number, op="status", level="error", msg=message))
        elif step.goal.key in self._goals:
            self._fail(step.goal, reason)

    def _request(self, goal: _Goal, part: str, fields: Fields, type_name: str = "", now_ns: int = 0) -> None:
        name = f"{goal.name}{ACTION_INFIX}{part}"
        handle = self._hub.server_of(name)
        if handle is None:
            reason = self._hub.rights().may_call(goal.name, "action")
            raise LocalError(f"{goal.action}: {reason or 'no server is reachable'}")
        service = self._hub.services[handle]
        if type_name and service.type_name != f"{type_name}_SendGoal":
            raise LocalError(f"{goal.action}: its type is {service.type_name.removesuffix('_SendGoal')}")
        raw = codec_of(service.request).to_raw(fields, now_ns)
        self._hub.request(self._session, handle, GoalStep(goal, part, service), raw)

    def _fail(self, goal: _Goal, reason: str) -> None:
        self._end(goal, reason[:REASON_MAX], _UNKNOWN, result=False)

    def _end(self, goal: _Goal, values: object, status: object, *, result: bool) -> None:
        """Send the result, behind the feedback that waits."""
        for each in filter(None, map(self.encode, self._queue.forget(goal.key))):
            self._queue.put_control(each)
        del self._goals[goal.key]
        self._queue.put_control(
            text_of(goal.number, op="action_result", action=goal.action, values=values, status=status, result=result)
        )


def _read(channel: Channel, raw: bytes) -> dict[str, object]:
    """Return a message of an action. Raises ``GdpError``: it does not fit the description of its server."""
    tree = orjson.loads(codec_of(channel).to_json(raw))
    if not isinstance(tree, dict):
        raise wrong(f"{channel.type_name} is no structure")
    return tree
