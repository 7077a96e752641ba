"""Programs of a member machine: which commands run for it, in which order they start, and what each may do.

I/O; it looks at the files of the machine and at the installed packages.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.enrolment.member_files import MemberFiles
from gdp.enrolment.member_setup import RELAY_FILE

__all__ = ["MachineProgram", "missing_ros", "programs_of"]

_NET: Final = ("CAP_NET_RAW", "CAP_NET_ADMIN")
_AWAIT_S: Final = "60"
_ROS_VARIABLES: Final = (
    "PYTHONPATH", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "ROS_DISTRO", "ROS_DOMAIN_ID", "RMW_IMPLEMENTATION",
    "ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE", "CYCLONEDDS_URI",
)  # fmt: skip
_ROS: Final = ("rclpy", "cyclonedds")


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineProgram:
    """A program that runs as long as the machine is a member.

    Args:
        title: for people; ``name`` is part of the unit's name.
        argv: the command.
        capabilities: those that it needs at its start.
        environment: variables that a unit has to set: those of ROS, as ``setup.bash`` exports them.
    """

    name: str
    title: str
    argv: tuple[str, ...]
    capabilities: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()


def programs_of(files: MemberFiles) -> list[MachineProgram]:
    """Return the programs of a machine, in the order in which they start."""
    directory = files.directory.absolute()
    found = [
        MachineProgram(
            name="switch",
            title="GDP switch: forwards frames by 256-bit names",
            argv=_module("gdp.cli.switch", "--config", directory / "switch.yaml"),
            capabilities=(*_NET, "CAP_BPF", "CAP_PERFMON"),
        )
    ]
    if (directory / RELAY_FILE).exists():
        argv = _module("gdp.cli.relay", "--config", directory / RELAY_FILE)
        needed = ("CAP_NET_ADMIN", "CAP_NET_RAW", "CAP_NET_BIND_SERVICE")
        title = "GDP relay: carries frames through TLS where UDP is blocked"
        found.append(MachineProgram(name="relay", title=title, argv=argv, capabilities=needed))
    if files.config.rib is not None:
        argv = _module("gdp.cli.rib", "--config", directory / "rib.yaml", "--await-iface", _AWAIT_S)
        found.append(MachineProgram(name="rib", title="GDP RIB: stores where names are", argv=argv, capabilities=_NET))
    if files.is_border:
        argv = _module("gdp.cli.gdp", "domain", "serve", directory)
        title, bind = "GDP enrolment server of a domain", ("CAP_NET_BIND_SERVICE",)
        found.append(MachineProgram(name="enrolment", title=title, argv=argv, capabilities=bind))
    if files.config.proxy is not None and not missing_ros():
        argv = _module("proxy.cli.proxy", "--config", directory / "proxy.yaml", "--await-iface", _AWAIT_S)
        ros = tuple((key, os.environ[key]) for key in _ROS_VARIABLES if os.environ.get(key))
        found.append(
            MachineProgram(
                name="proxy",
                title="GDP proxy: carries ROS over the overlay",
                argv=argv,
                capabilities=_NET,
                environment=ros,
            )
        )
    found.append(
        MachineProgram(
            name="agent",
            title="GDP agent: renews memberships and fetches mail",
            argv=_module("gdp.cli.gdp", "agent", directory),
        )
    )
    return found


def missing_ros() -> str:
    """Return why no proxy can run here; empty: one can."""
    if importlib.util.find_spec("proxy") is None:
        return "the package of the proxy is not installed"
    if all(importlib.util.find_spec(each) is None for each in _ROS):
        return "neither rclpy nor cyclonedds is installed: pip install 'gdp-ros[dds]', then run gdp up again"
    return ""


def _module(module: str, *words: str | Path) -> tuple[str, ...]:
    return (sys.executable, "-m", module, *map(str, words))
