"""Units of a machine: the packaged unit files, for its paths and its user.

I/O; it reads the packaged files and who owns the keys. A node runs as the owner of its keys, with the capabilities of
its unit. Keys below ``/var/lib/gdp-ros`` belong to a dynamic user (``DynamicUser=``), as the packaged files say. The
enrolment server and the agent of a machine that joined have the unit of a RIB, without its devices and reports.
"""

from __future__ import annotations

import pwd
import sys
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Final

from gdp.enrolment.programs import Machine, MachineProgram
from gdp.enrolment.units import MARK, quoted, unit_names
from gdp.errors import LocalError

STATE_FOLDER: Final = Path("/var/lib/gdp-ros")
_CONFIG_FOLDER: Final = Path("/etc/gdp")
_PREFIX: Final = Path("/usr/lib/gdp-ros")
_PRIVATE_TMP: Final = (Path("/tmp"), Path("/var/tmp"))
_HOMES: Final = (Path("/home"), Path("/root"), Path("/run/user"))
_OF_DYNAMIC_USER: Final = (
    "DynamicUser", "User", "Group", "StateDirectory", "StateDirectoryMode", "RuntimeDirectory", "WorkingDirectory",
)  # fmt: skip
_SILENT: Final = {  # of programs that report nothing to systemd
    **dict.fromkeys(("NotifyAccess", "WatchdogSec", "TimeoutStartSec"), ""),
    "Type": "Type=exec",
}
_OF_OTHERS: Final = {  # of those that, too, any host may connect to, and that touch no device
    **_SILENT,
    "RestrictAddressFamilies": "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK",
    "MemoryMax": "MemoryMax=1G",
}


def service_texts(machine: Machine) -> dict[str, str]:
    """Return the units of a machine by file name, in the order in which they start.

    Raises:
        LocalError: a unit could not see the machine's files.
    """
    names = unit_names(None if machine.directory == _CONFIG_FOLDER else machine.directory, machine.programs)
    switch = names.get("switch")
    return {names[each.name]: _unit(machine, each, switch) for each in machine.programs}


def _unit(machine: Machine, program: MachineProgram, switch: str | None) -> str:
    templates = resources.files("gdp.enrolment").joinpath("service")
    is_node = templates.joinpath(f"gdp-{program.name}.service").is_file()
    template = templates.joinpath(f"gdp-{program.name if is_node else 'rib'}.service").read_text(encoding="utf-8")
    identity = machine.identity_of(program)
    is_dynamic = not machine.is_member and _below(
        identity.resolve(), STATE_FOLDER, STATE_FOLDER.parent / "private" / STATE_FOLDER.name
    )
    own = (machine.directory, identity, *([] if program.writes is None else [program.writes]))
    folders = (*own, Path(sys.prefix), Path(sys.base_prefix), Path(__file__))
    if hidden := [each for each in folders if _below(each.resolve(), *_PRIVATE_TMP)]:
        raise LocalError(
            f"{hidden[0]}: units have a /tmp of their own and cannot see it; move it, say to {STATE_FOLDER}"
        )
    changes = {} if is_dynamic else dict(_of_owner(machine, identity, program.writes))
    if program.name == "store":
        changes |= {**_SILENT, "ExecReload": ""}
    if machine.is_member:
        rights = " ".join(program.capabilities)
        changes |= {key: f"{key}={rights}" for key in ("AmbientCapabilities", "CapabilityBoundingSet")}
        changes |= {"Restart": "Restart=always"} | ({} if is_node or program.name == "store" else _OF_OTHERS)
    of_ros = (Path(each) for _, value in program.environment for each in value.split(":") if each.startswith("/"))
    is_at_home = any(_below(each, *_HOMES) for each in (*folders, *of_ros))
    changes["ProtectHome"] = f"ProtectHome={'read-only' if is_at_home else 'yes'}"
    lines = [f"{MARK}{machine.directory}"]
    for line in template.splitlines():
        key, equals, value = line.partition("=")
        if equals and key in changes:
            continue
        if key == "ExecStart":
            lines.append(f"ExecStart={_command(program, value, is_packaged=is_dynamic)}")
            lines += [f"Environment={quoted(f'{name}={text}')}" for name, text in program.environment]
        elif key == "Description":
            lines.append(f"Description={program.title}")
        elif key in ("After", "Wants"):
            units = ["network-online.target"] if machine.is_member else []
            units += [each for each in value.split() if each != "gdp-switch.service"]
            units += [switch] if switch is not None and program.name != "switch" else []
            lines += [f"{key}={' '.join(dict.fromkeys(units))}"] if units else []
        else:
            lines.append(line)
            if line == "[Service]":
                lines += [text for text in changes.values() if text]
    return "\n".join([*lines, ""])


def _command(program: MachineProgram, packaged: str, *, is_packaged: bool) -> str:
    """Return the command line: the packaged one where it is right for this installation."""
    words = packaged.split()
    config = str(program.config)
    if is_packaged and config in words and Path(sys.prefix) == _PREFIX:
        return packaged
    own = list(program.argv)
    if is_packaged and "--state" in words:
        own += words[words.index("--state") : words.index("--state") + 2]
    return " ".join(quoted(each) for each in own)


def _of_owner(machine: Machine, identity: Path, more: Path | None) -> Mapping[str, str]:
    """Return the lines of a node that runs as the owner of its keys, by the key of the packaged lines they replace."""
    directory = machine.directory
    status = identity.stat()
    try:
        user = pwd.getpwuid(status.st_uid)
    except KeyError as error:
        raise LocalError(f"{identity}: its owner {status.st_uid} is no user of this host; chown it first") from error
    runtime = "gdp-locks" if user.pw_uid == 0 else f"gdp-{user.pw_name}"
    at = "" if user.pw_uid == 0 else f"XDG_RUNTIME_DIR=%t/{runtime} "
    others = (each for each in (identity, more) if each is not None and not _below(each, directory))
    writable = dict.fromkeys((directory, *others))
    return {
        **dict.fromkeys(_OF_DYNAMIC_USER, ""),
        "User": f"User={user.pw_name}",
        "RuntimeDirectory": f"RuntimeDirectory={runtime} wireguard",
        "RuntimeDirectoryMode": "RuntimeDirectoryMode=0755",
        "WorkingDirectory": "WorkingDirectory=/",
        "Environment": f"Environment={at}HOME={quoted(str(directory))}",
        "ReadWritePaths": f"ReadWritePaths={' '.join(quoted(str(each)) for each in writable)}",
    }


def _below(path: Path, *folders: Path) -> bool:
    return any(path.is_relative_to(each) for each in folders)
