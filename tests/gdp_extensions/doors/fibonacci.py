"""Definitions of the parts of ``example_interfaces/action/Fibonacci``, as a ROS machine has them."""

from __future__ import annotations

from typing import Final

from tests.proxy.bridge import known

__all__ = ["FEEDBACK", "FIBONACCI", "ID", "RULE", "SERVICES", "STATUS", "TIME"]

FIBONACCI: Final = "example_interfaces/action/Fibonacci"
STATUS: Final = "action_msgs/msg/GoalStatusArray"
RULE: Final = "=" * 80
ID: Final = f"{RULE}\nMSG: unique_identifier_msgs/UUID\nuint8[16] uuid\n"
_INFO: Final = (
    f"{RULE}\nMSG: action_msgs/GoalInfo\nunique_identifier_msgs/UUID goal_id\nbuiltin_interfaces/Time stamp\n"
)
TIME: Final = f"{RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"


def _nested(part: str, fields: str) -> str:
    return f"{RULE}\nMSG: example_interfaces/Fibonacci_{part}\n{fields}\n"


SERVICES: Final = {
    "send_goal": known.service(
        f"{FIBONACCI}_SendGoal",
        f"unique_identifier_msgs/UUID goal_id\nexample_interfaces/Fibonacci_Goal goal\n{ID}"
        + _nested("Goal", "int32 order"),
        f"bool accepted\nbuiltin_interfaces/Time stamp\n{TIME}",
    ),
    "cancel_goal": known.service(
        "action_msgs/srv/CancelGoal",
        f"action_msgs/GoalInfo goal_info\n{_INFO}{ID}{TIME}",
        f"int8 return_code\naction_msgs/GoalInfo[] goals_canceling\n{_INFO}{ID}{TIME}",
    ),
    "get_result": known.service(
        f"{FIBONACCI}_GetResult",
        f"unique_identifier_msgs/UUID goal_id\n{ID}",
        "int8 status\nexample_interfaces/Fibonacci_Result result\n" + _nested("Result", "int32[] sequence"),
    ),
}
FEEDBACK: Final = known.custom(
    f"{FIBONACCI}_FeedbackMessage",
    f"unique_identifier_msgs/UUID goal_id\nexample_interfaces/Fibonacci_Feedback feedback\n{ID}"
    + _nested("Feedback", "int32[] sequence"),
)
