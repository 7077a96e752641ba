"""Desired state of a cluster: its nodes, its machines and its exported interfaces.

Sans-I/O. A launch description is resolved into this plan, and the journal stores it as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import KW_ONLY, asdict, dataclass, field, replace
from typing import Literal

from fog.hardware import Hardware
from fog.scaling import ScalingPolicy, policy_from_keys
from gdp.errors import LocalError


@dataclass(frozen=True, slots=True)
class CloudNode:
    """ROS node that runs on every machine of the cluster.

    Args:
        package, executable: as ``ros2 run`` takes them; without such an installed package, the Python module
            ``package.executable``.
        arguments: after the executable, including ``--ros-args`` (name, namespace, parameters, remappings).
    """

    package: str
    executable: str
    arguments: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ExportedInterface:
    """Service, action or topic that the cluster's nodes offer to the robot.

    Args:
        type_name: in the notation of ROS 2.
        options: further keys of the rule on the robot's side, such as ``replication`` and ``timeout_s``.
        served: further keys of the rule on the machines' side, such as ``stop`` and ``at_once``.
    """

    kind: Literal["topic", "service", "action"]
    name: str
    type_name: str
    options: Mapping[str, object] = field(default_factory=dict)
    served: Mapping[str, object] = field(default_factory=dict)

    def salted(self, salt: str) -> ExportedInterface:
        """Return it with an unguessable part in its overlay name, unless its metadata have one."""
        more = self.options.get("metadata")
        metadata = {"salt": salt, **(more if isinstance(more, dict) else {})}
        given = {"metadata": metadata}
        return replace(self, options={**self.options, **given}, served={**self.served, **given})


@dataclass(frozen=True, slots=True)
class MachineRequest:
    """Request for the machine of one replica.

    Args:
        region: empty: chosen by the supervisor, a different one for each machine if possible.
        may_be_on_demand: of a spot machine: while none is to be had, one on demand takes its place.
    """

    hardware: Hardware
    region: str = ""
    is_spot: bool = False
    may_be_on_demand: bool = False

    def on_demand(self) -> MachineRequest:
        """Return the same machine on demand."""
        return replace(self, is_spot=False, may_be_on_demand=False)


@dataclass(frozen=True, slots=True)
class ClusterPlan:
    """Plan of a cluster.

    Args:
        idle_s: after this long without a call all machines are released; None: never.
        budget_usd: when its machines have cost this much, they are released; None: no limit.
        availability: share of time for which at least one machine is to serve; ``fog launch`` adds as many machines as
            that needs. None: ``machines`` is the full list.
        pushed_unix_s: machines that were requested before have earlier software, and are replaced; None: none is.
        scale: between which numbers of machines the cluster moves, beginning with ``machines``; None: it does not.
    """

    name: str
    nodes: tuple[CloudNode, ...]
    machines: tuple[MachineRequest, ...]
    carried: tuple[ExportedInterface, ...] = ()
    _: KW_ONLY
    idle_s: float | None = None
    budget_usd: float | None = None
    availability: float | None = None
    pushed_unix_s: float | None = None
    scale: ScalingPolicy | None = None

    def resized(self, count: int) -> tuple[MachineRequest, ...]:
        """Return so many machines: the first of the plan, and more like its last one in other regions."""
        more = max(count - len(self.machines), 0)
        return (*self.machines[:count], *[replace(self.machines[-1], region="")] * more)

    def salted(self, salt: str) -> ClusterPlan:
        """Return the plan with this unguessable part in the overlay names of its interfaces; empty: with none."""
        return replace(self, carried=tuple(each.salted(salt) for each in self.carried)) if salt else self

    def to_json(self) -> str:
        """Return the text that ``from_json`` reads."""
        scale = None if self.scale is None else self.scale.to_keys()
        return json.dumps({**asdict(self), "scale": scale}, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> ClusterPlan:
        """Read a plan. Raises ``LocalError``: the text is not a plan."""
        from pydantic import TypeAdapter, ValidationError  # a launch file that only makes a plan needs no such check

        from gdp.config.schema import first_fault

        try:
            items = json.loads(text)
            scale = None if items.get("scale") is None else policy_from_keys(items["scale"])
            return TypeAdapter(cls).validate_python({**items, "scale": scale})
        except json.JSONDecodeError as error:
            raise LocalError(f"line {error.lineno}: JSON is expected: {error.msg}") from error
        except ValidationError as error:
            raise LocalError(f"not the plan of a cluster: {first_fault(error)}") from error
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise LocalError(f"not the plan of a cluster: {error!r}") from error


@dataclass(frozen=True, slots=True)
class RobotNode:
    """Node of the robot's side; ``output``: destination of its output: ``screen``, ``both`` or ``log``."""

    node: CloudNode
    output: str = "screen"
