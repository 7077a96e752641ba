"""Configuration files of a member machine, as ``gdp join`` and ``gdp domain create`` write them.

I/O; writes files. All paths in them are relative, so a directory can be made under another name and renamed.
"""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from gdp.config.config import LISTEN_DEFAULT
from gdp.enrolment.member_files import MEMBER_FILE
from gdp.links.endpoint_files import RECORD_SUFFIX
from gdp.names import Name
from gdp.stores.files import public, read_public, write_all
from gdp.stores.keyring import DELEGATIONS
from gdp.trust.join_token import HOLDER_FOLDER

LISTEN_PORT: Final = LISTEN_DEFAULT  # of WireGuard; of the enrolment server the TCP port of this number
RELAY_PORT: Final = 443
RELAY_FILE: Final = "relay.yaml"
WATCH_IFACE: Final = "watch0"  # of a border: from there a launcher sees which replicas serve
_CAPSULES: Final = "capsules"
_BORDERS: Final = re.compile(r"^borders:\n(?:[ \t].*\n)*", re.MULTILINE)
_FOLDERS: Final = ("peers", "revocations", "inbox", "state/switch", "state/rib", "state/proxy", "proxy.yaml.d")


@dataclass(frozen=True, slots=True, kw_only=True)
class MachinePlan:
    """What the configuration files of a machine say.

    Args:
        role: ``robot``, ``switch``, ``leaf`` or ``border``.
        servers: of enrolment, ``host:port``.
        listen: UDP port of the tunnels; 0: any.
        public: UDP endpoints at which the tunnels can be reached from everywhere.
        uplinks: devices that each get a tunnel; none: routing decides.
        relay_port: TCP port at which a border relays; 0: it does not.
        handover: socket of the enrolment server that takes connections of the relay's port; empty: none.
        relays: of each border, ``host:port`` of its relay, for networks that block UDP.
    """

    label: str
    role: str
    servers: Sequence[str]
    listen: int
    public: Sequence[str] = ()
    uplinks: Sequence[str] = ()
    relay_port: int = 0
    handover: str = ""
    relays: Mapping[Name, Sequence[str]] = field(default_factory=dict)
    has_proxy: bool = True
    has_store: bool = False
    has_rib: bool = False

    @property
    def has_relay(self) -> bool:
        """Return whether a relay runs next to the switch."""
        return bool(self.relay_port or any(self.relays.values()))


def write_configuration(directory: Path, plan: MachinePlan, trusts: Sequence[str]) -> None:
    """Write the YAML files and make the folders that they name.

    Args:
        trusts: file names of other domains' roots, in ``directory``.

    Raises:
        LocalError: a file exists already, or the system refuses.
    """
    for folder in _FOLDERS:
        write_all(directory / folder, {})
    write_all(directory / "proxy" / DELEGATIONS if plan.has_proxy else directory / "inbox", {})
    texts = {MEMBER_FILE: _member(plan, trusts), "switch.yaml": _switch(plan, trusts)}
    if plan.has_proxy:
        texts["proxy.yaml"] = _proxy(trusts)
    if plan.has_store:
        write_all(directory / HOLDER_FOLDER / DELEGATIONS, {})
        write_all(directory / _CAPSULES, {})
        texts["store.yaml"] = _node(HOLDER_FOLDER, trusts) + f"iface: store0\nholds: {{folder: {_CAPSULES}}}\n"
    if plan.has_relay:
        texts[RELAY_FILE] = _relay(plan, trusts)
    if plan.has_rib:
        texts["rib.yaml"] = _node("rib", trusts) + "iface: rib0\nstate: state/rib\n"
    write_all(directory, {name: public(text.encode()) for name, text in texts.items()})


def update_relays(directory: Path, relays: Mapping[Name, Sequence[str]]) -> bool:
    """Write where the relays of borders are now into ``relay.yaml``; return whether that changed something.

    Only the key ``borders`` is replaced. A machine without the file runs no relay, and a change to no relay at all
    leaves what there is.

    Raises:
        LocalError: the file cannot be written.
    """
    path = directory / RELAY_FILE
    if not path.exists() or not any(relays.values()):
        return False
    before = read_public(path).decode()
    after, count = _BORDERS.subn(_borders({name: each for name, each in relays.items() if each}), before)
    if not count or after == before:
        return False
    write_all(directory, {RELAY_FILE: public(after.encode())}, force=True)
    return True


def record_file_name(name: Name) -> str:
    """Return the name of a switch's file in a folder of peers."""
    return f"{name.to_text()}{RECORD_SUFFIX}"


def _member(plan: MachinePlan, trusts: Sequence[str]) -> str:
    lines = [f"label: {json.dumps(plan.label)}", f"role: {plan.role}", _domain("switch", trusts), "switch: switch"]
    lines += ["proxy: proxy"] if plan.has_proxy else []
    lines += [f"store: {HOLDER_FOLDER}"] if plan.has_store else []
    lines += ["rib: rib"] if plan.has_rib else []
    return "\n".join([*lines, "peers: peers", f"servers: {json.dumps(list(plan.servers))}", ""])


def _switch(plan: MachinePlan, trusts: Sequence[str]) -> str:
    attach = ["rib0"] if plan.has_rib else []
    attach += ["proxy0"] if plan.has_proxy else []
    attach += ["store0"] if plan.has_store else []
    attach += [WATCH_IFACE] if plan.has_rib else []
    links = {"listen": plan.listen, "peers": "peers"}
    public_line = f"  public: {json.dumps(list(plan.public))}\n" if plan.public else ""
    uplinks_line = f"  uplinks: {json.dumps(list(plan.uplinks))}\n" if plan.uplinks else ""
    return (
        _node("switch", trusts)
        + f"attach: {json.dumps(attach)}\n"
        + "revocations: revocations\nstate: state/switch\n"
        + ("relay: true\n" if plan.has_relay else "")
        + "links:\n"
        + "".join(f"  {key}: {value}\n" for key, value in links.items())
        + public_line
        + uplinks_line
    )


def _relay(plan: MachinePlan, trusts: Sequence[str]) -> str:
    enrolment = f", enrolment: {plan.handover}" if plan.handover else ""
    lines = [f"server: {{port: {plan.relay_port}{enrolment}}}"] if plan.relay_port else []
    text = _node("switch", trusts) + "revocations: revocations\n" + "\n".join([*lines, ""])
    return text + _borders({name: each for name, each in plan.relays.items() if each})


def _borders(relays: Mapping[Name, Sequence[str]]) -> str:
    lines = ["borders:"] if relays else []
    for name, endpoints in relays.items():
        lines += [f'  - peer: "{name.to_text()}"', f"    endpoints: {json.dumps(list(endpoints))}"]
    return "\n".join([*lines, ""])


def _proxy(trusts: Sequence[str]) -> str:
    return (
        _node("proxy", trusts)
        + f"delegations: proxy/{DELEGATIONS}\niface: proxy0\nstate: state/proxy\n"
        + f"ros: {{endpoint: {_ros_endpoint()}}}\n"
    )


def _ros_endpoint() -> str:
    """Return how the proxy takes part in ROS: through rclpy where it is installed, else through Cyclone DDS."""
    return "ros2" if importlib.util.find_spec("rclpy") is not None else "dds"


def _node(folder: str, trusts: Sequence[str]) -> str:
    return f"identity: {folder}\n{_domain(folder, trusts)}\n"


def _domain(folder: str, trusts: Sequence[str]) -> str:
    more = f", trusts: {json.dumps(list(trusts))}" if trusts else ""
    return f"domain: {{root: {folder}/root.crt{more}}}"
