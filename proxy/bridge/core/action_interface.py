"""Interface of a service or an action: the services and topics that it consists of in a ROS graph.

Sans-I/O.
Source: the ROS 2 design article on actions: an action is three services and two topics under ``<action>/_action/``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from gdp.ros_names import ACTION_INFIX
from proxy.endpoints.core.endpoint import GraphEntity, RosEndpoint
from proxy.endpoints.core.qos import default
from proxy.serial.serializer import Encoding
from proxy.wire.service import Exchange

GOAL: Final = 0  # the parts of an action
CANCEL: Final = 1
RESULT: Final = 2  # answers when the goal has ended, without a time limit
# of feedback and status, as rcl_action sets them
PROFILES: Final = (default(depth=100), default(latched=True, depth=1))
_SEND_GOAL: Final = "_SendGoal"


@dataclass(frozen=True, slots=True)
class ActionInterface:
    """Local names and types of the services, then of the topics; their indices are the part numbers."""

    services: tuple[tuple[str, str], ...]
    topics: tuple[tuple[str, str], ...] = ()

    @classmethod
    def of(cls, kind: str, name: str, type_name: str) -> ActionInterface:
        """Return the parts of a service or an action."""
        if kind != "action":
            return cls(((name, type_name),))
        at = name + ACTION_INFIX
        services = (
            (f"{at}send_goal", f"{type_name}_SendGoal"),
            (f"{at}cancel_goal", "action_msgs/srv/CancelGoal"),
            (f"{at}get_result", f"{type_name}_GetResult"),
        )
        topics = (
            (f"{at}feedback", f"{type_name}_FeedbackMessage"),
            (f"{at}status", "action_msgs/msg/GoalStatusArray"),
        )
        return cls(services, topics)

    def known(self, endpoint: RosEndpoint, encoding: Encoding) -> Exchange:
        """Return the descriptions of all parts, as the endpoint's machine has them.

        Raises:
            LocalError: it does not know one of them.
        """
        services = tuple(endpoint.service(*part) for part in self.services)
        return Exchange(encoding, services, tuple(endpoint.channel(*part) for part in self.topics))


def is_part(name: str) -> bool:
    """Return whether a local name is a hidden part of an action."""
    return ACTION_INFIX in name


def action_of(end: GraphEntity) -> tuple[str, str] | None:
    """Return name and type of the action whose ``send_goal`` service this entity is; None for any other entity."""
    name, infix, part = end.name.partition(ACTION_INFIX)
    if not infix or part != "send_goal" or not end.type_name.endswith(_SEND_GOAL):
        return None
    return name, end.type_name[: -len(_SEND_GOAL)]
