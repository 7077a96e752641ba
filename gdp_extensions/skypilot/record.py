"""Conversion of SkyPilot's records to machines: one cluster of one node, its labels and its state.

Sans-I/O.
Source: SkyPilot 0.14, ``ClusterStatus`` and ``StatusResponse``. Some clouds allow only lowercase letters, digits, ``-``
and ``_`` in a label, at most 63. Other values are therefore written in hexadecimal digits, and prices in millionths.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, Protocol

from fog.hardware import Hardware, Offer
from fog.machine import Machine, MachineSpec, MachineState
from gdp.errors import LocalError

LAUNCH: Final = "sky.launch"
_PREFIX: Final = "fog"
_CLUSTER: Final = "fog-cluster"
_MACHINE: Final = "fog-machine"
_PLACE: Final = "fog-place"
_TYPE: Final = "fog-type"
_HARDWARE: Final = "fog-hardware"
_PRICE: Final = "fog-micro-usd"
_SPOT: Final = "fog-spot"
_MILLIONTHS: Final = 1_000_000
_LABEL_MAX: Final = 63

_STATES: Final = {
    "INIT": MachineState.BOOTING,
    "PENDING": MachineState.BOOTING,
    "UP": MachineState.RUNNING,
    "STOPPED": MachineState.LEAVING,  # still billed, so not gone
    "AUTOSTOPPING": MachineState.LEAVING,
}


class Named(Protocol):
    """Member of a SkyPilot enumeration."""

    @property
    def value(self) -> str:
        """Return the value of the member."""


class Status(Protocol):
    """Used fields of a ``StatusResponse``."""

    @property
    def name(self) -> str:
        """Return the cluster's name at SkyPilot."""

    @property
    def status(self) -> Named:
        """Return the state of the cluster."""

    @property
    def launched_at(self) -> int:
        """Return when the cluster was launched, in unix seconds."""

    @property
    def labels(self) -> Mapping[str, str] | None:
        """Return the labels that the cluster was launched with."""

    @property
    def init_kind(self) -> str | None:
        """Return what a cluster in INIT waits for."""

    @property
    def init_status_reason(self) -> str | None:
        """Return why a cluster is in INIT."""

    @property
    def handle(self) -> object:
        """Return SkyPilot's handle of the cluster's machines."""


class Request(Protocol):
    """Used fields of a ``RequestPayload``: an unfinished request of the API server."""

    @property
    def name(self) -> str:
        """Return the kind of the request."""

    @property
    def cluster_name(self) -> str | None:
        """Return the name of the request's cluster."""

    @property
    def created_at(self) -> float:
        """Return when the request was made, in unix seconds."""


def cluster_name(spec: MachineSpec) -> str:
    """Return SkyPilot's cluster name for a machine."""
    return f"{_PREFIX}-{spec.cluster}-{spec.name}"


def labels_of(spec: MachineSpec) -> dict[str, str]:
    """Return the labels of a machine, which ``machine_of`` reads. Raises ``LocalError``: a name is too long."""
    offer = spec.offer
    labels = {
        _CLUSTER: _hex(spec.cluster),
        _MACHINE: _hex(spec.name),
        _PLACE: _hex(offer.region),
        _TYPE: _hex(offer.type_name),
        _HARDWARE: _hex(offer.hardware.to_text()),
        _PRICE: str(round(offer.usd_per_hour * _MILLIONTHS)),
        _SPOT: str(int(offer.is_spot)),
    }
    if too_long := [key for key, value in labels.items() if len(value) > _LABEL_MAX]:
        raise LocalError(f"skypilot: {cluster_name(spec)}: too long for a label: {', '.join(too_long)}")
    return labels


def machine_of(status: Status, cluster: str) -> Machine | None:
    """Return the machine of a record; None: it belongs to another cluster.

    SkyPilot reports that a machine is set up, not that its programs serve; the RIB knows that.
    """
    labels = status.labels or {}
    if labels.get(_CLUSTER) != _hex(cluster):
        return None
    state, reason = _STATES.get(status.status.value, MachineState.BOOTING), ""
    if status.init_kind == "unhealthy":
        state, reason = MachineState.LEAVING, status.init_status_reason or "not as SkyPilot left it"
    elif state is MachineState.LEAVING:
        reason = status.status.value.lower()
    address = getattr(status.handle, "head_ip", None)
    try:
        spec = _spec_of(cluster, labels)
    except (KeyError, ValueError) as error:
        raise LocalError(f"skypilot: {status.name}: its labels make no sense: {error!r}") from error
    return Machine(
        status.name,
        spec,
        state,
        float(status.launched_at),
        address=str(address or ""),
        leaves_at_unix_s=None,
        reason=reason,
    )


def being_made(requests: Sequence[Request], cluster: str, known: Sequence[str]) -> list[Machine]:
    """Return the requested machines of a cluster that have no record yet; their offers are unknown."""
    prefix = f"{_PREFIX}-{cluster}-"
    found = {}
    for request in requests:
        name = request.cluster_name or ""
        machine = name.removeprefix(prefix)
        # a machine's name has no hyphen, so "fog-a-b-m1" belongs to cluster "a-b", not to "a"
        if request.name == LAUNCH and name.startswith(prefix) and "-" not in machine and name not in known:
            offer = Offer("skypilot", "", "", Hardware(), is_spot=False, usd_per_hour=0.0)
            spec = MachineSpec(cluster, machine, offer)
            found[name] = Machine(name, spec, MachineState.BOOTING, request.created_at)
    return list(found.values())


def _spec_of(cluster: str, labels: Mapping[str, str]) -> MachineSpec:
    place, type_name, hardware, name = (
        bytes.fromhex(labels[key]).decode() for key in (_PLACE, _TYPE, _HARDWARE, _MACHINE)
    )
    usd = int(labels[_PRICE]) / _MILLIONTHS
    offer = Offer(
        "skypilot", place, type_name, Hardware.from_text(hardware), is_spot=labels[_SPOT] == "1", usd_per_hour=usd
    )
    return MachineSpec(cluster, name, offer)


def _hex(text: str) -> str:
    return text.encode().hex()
