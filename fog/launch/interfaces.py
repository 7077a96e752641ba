"""Exported interfaces of a launch file, such as ``services={"/plan": "nav_msgs/srv/GetPlan"}``.

Sans-I/O. The value may be a map with ``type`` and keys of the proxies' rules (docs/reference/configuration.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, TypeAlias

from fog.cluster import ExportedInterface
from gdp.errors import LocalError
from gdp.ros_names import Kind, fits_kind, is_name
from gdp.service.replication import Mode, Replication

Offered: TypeAlias = Mapping[str, str | Mapping[str, object]]
SomeReplication: TypeAlias = Replication | str | Mapping[str, object]

_BOTH_SIDES: Final = ("encoding", "max_bytes", "max_bits_s", "metadata", "priority", "weight")
_ROBOT_SIDE: Final[dict[Kind, tuple[str, ...]]] = {
    "topic": (),
    "service": ("on_timeout", "replication", "sign", "state", "timeout_s"),
    "action": ("on_timeout", "replication", "sign", "timeout_s"),
}
_MACHINE_SIDE: Final[dict[Kind, tuple[str, ...]]] = {
    "topic": ("deadline_ms", "max_hz", "repair"),
    "service": ("at_once", "readiness", "sign", "state", "state_node", "stop"),
    "action": ("readiness", "sign"),
}
_EXAMPLES: Final[dict[Kind, str]] = {
    "topic": "sensor_msgs/msg/Image",
    "service": "nav_msgs/srv/GetPlan",
    "action": "test_msgs/action/Fibonacci",
}


def carried(kind: Kind, offered: Offered, defaults: Mapping[str, object]) -> list[ExportedInterface]:
    """Return the interfaces that the proxies carry.

    Args:
        offered: full name -> type, or a map of ``type`` and further keys.
        defaults: keys of the robot's side for entries that do not set them; keys that a kind does not have are omitted.
    """
    return [_one(kind, name, said, defaults) for name, said in offered.items()]


def replication_rule(said: SomeReplication) -> dict[str, object]:
    """Return the value of the rule key ``replication``.

    Args:
        said: name of a mode, a map of ``mode``, ``copies`` and ``budget``, or a ``Replication``.
    """
    if isinstance(said, Replication):
        said = {"mode": said.mode.value, "copies": said.copies, "budget": said.budget}
        used = {"all": (), "some": ("copies",), "hedged": ("budget",), "nearest": ()}[str(said["mode"])]
        return {"mode": said["mode"], **{key: said[key] for key in used}}
    rule: dict[str, object] = {"mode": said} if isinstance(said, str) else dict(said)
    modes = [mode.value for mode in Mode]
    if rule.get("mode") not in modes:
        raise LocalError(f"replication: mode {rule.get('mode')!r}: expected {', '.join(modes)}")
    if unknown := sorted(rule.keys() - {"mode", "copies", "budget"}):
        raise LocalError(f"replication: {', '.join(unknown)}: expected mode, copies, budget")
    return rule


def _one(kind: Kind, name: str, said: str | Mapping[str, object], defaults: Mapping[str, object]) -> ExportedInterface:
    keys: dict[str, object] = {"type": said} if isinstance(said, str) else dict(said)
    type_name = keys.pop("type", "")
    if not is_name(name):
        raise LocalError(f"{kind} {name!r}: expected its full name, such as /plan")
    if not isinstance(type_name, str) or not fits_kind(type_name, kind):
        raise LocalError(f"{kind} {name}: type {type_name!r}: expected one such as {_EXAMPLES[kind]}")
    robot, machine = (*_ROBOT_SIDE[kind], *_BOTH_SIDES), (*_MACHINE_SIDE[kind], *_BOTH_SIDES)
    if unknown := sorted(keys.keys() - {*robot, *machine}):
        raise LocalError(f"{kind} {name}: {', '.join(unknown)}: expected type, {', '.join(sorted({*robot, *machine}))}")
    if "stop" in keys and keys.get("at_once") != 1:
        raise LocalError(f'{kind} {name}: stop goes with "at_once": 1, or it breaks off what another client asked for')
    if isinstance(replication := keys.get("replication"), str | Mapping | Replication):
        keys["replication"] = replication_rule(replication)
    own = {"replication"} if keys.get("state") == "ordered" else set()  # all replicas then receive every request
    keys = {**{key: value for key, value in defaults.items() if key in robot and key not in own}, **keys}
    options = {key: keys[key] for key in robot if key in keys}
    return ExportedInterface(kind, name, type_name, options, {key: keys[key] for key in machine if key in keys})
