"""Conversion of EC2 instances and spot requests to machines, by tags that replace a journal.

Sans-I/O.
Source: EC2 user guide, "Instance lifecycle" and "Spot request status": a spot instance is marked for termination two
minutes before it ends. Tag keys use only characters that instance metadata supports.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from fog.hardware import Hardware, Offer
from fog.machine import Machine, MachineSpec, MachineState
from gdp.errors import LocalError

if TYPE_CHECKING:
    from types_boto3_ec2.type_defs import InstanceTypeDef, SpotInstanceRequestTypeDef

CLUSTER: Final = "fog-cluster"
MACHINE: Final = "fog-machine"
DRAIN: Final = "fog-drain"
_HARDWARE: Final = "fog-hardware"
_PRICE: Final = "fog-usd-per-hour"

NOTICE_S: Final = 120.0

_STATES: Final = {
    "pending": MachineState.BOOTING,
    "running": MachineState.RUNNING,
    "stopping": MachineState.LEAVING,  # still billed, so not gone
    "stopped": MachineState.LEAVING,
    "shutting-down": MachineState.GONE,
    "terminated": MachineState.GONE,
}


def tags_of(spec: MachineSpec) -> dict[str, str]:
    """Return the tags of a machine, which ``machine_of`` reads."""
    offer = spec.offer
    return {
        "Name": f"{spec.cluster}-{spec.name}",
        CLUSTER: spec.cluster,
        MACHINE: spec.name,
        _HARDWARE: offer.hardware.to_text(),
        _PRICE: repr(offer.usd_per_hour),
    }


def machine_of(region: str, instance: InstanceTypeDef, request: SpotInstanceRequestTypeDef | None = None) -> Machine:
    """Return the machine of a tagged instance; ``request``: spot request of a spot instance.

    EC2 reports that a machine runs, not that its programs do; the RIB knows that.

    Raises:
        LocalError: the tags were changed and are invalid.
    """
    tags = {tag["Key"]: tag["Value"] for tag in instance.get("Tags", [])}
    status = request.get("Status", {}) if request else {}
    code = status.get("Code", "")
    name = instance["State"]["Name"]
    state = _STATES.get(name, MachineState.BOOTING)
    reason, leaves_at, since = "", None, None
    if state is MachineState.GONE:
        reason = _why_gone(code, instance)
    elif code.startswith("marked-for-"):
        state, reason = MachineState.LEAVING, code
        if marked := status.get("UpdateTime"):
            since = marked.timestamp()
            leaves_at = since + NOTICE_S
    elif state is MachineState.LEAVING:
        reason = name
    elif DRAIN in tags:
        state, reason = MachineState.LEAVING, "drained"
    return Machine(
        f"{region}/{instance['InstanceId']}",
        _spec_of(region, instance, tags),
        state,
        instance["LaunchTime"].timestamp(),
        address=instance.get("PublicIpAddress") or instance.get("PrivateIpAddress") or "",
        leaves_at_unix_s=leaves_at,
        reason=reason,
        since_unix_s=since,
    )


def _spec_of(region: str, instance: InstanceTypeDef, tags: Mapping[str, str]) -> MachineSpec:
    hardware = Hardware.from_text(tags.get(_HARDWARE, "cpu:1"))
    try:
        usd = float(tags.get(_PRICE, "0"))
    except ValueError as error:
        raise LocalError(f"aws: {region}/{instance['InstanceId']}: tag {_PRICE} is no number") from error
    is_spot = instance.get("InstanceLifecycle") == "spot"
    offer = Offer("aws", region, instance["InstanceType"], hardware, is_spot=is_spot, usd_per_hour=usd)
    return MachineSpec(tags[CLUSTER], tags.get(MACHINE, instance["InstanceId"]), offer)


def _why_gone(code: str, instance: InstanceTypeDef) -> str:
    if code.startswith("instance-terminated-"):
        return code
    return instance.get("StateReason", {}).get("Message", "") or instance.get("StateTransitionReason", "")
