"""systemd units of a machine's programs.

I/O. The units are named after the machine's directory, so that one host can belong to several domains.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from gdp.enrolment.programs import MachineProgram
from gdp.errors import LocalError
from gdp.stores.files import public, write_all

__all__ = ["UNIT_FOLDER", "has_systemd", "install_units", "remove_units", "unit_texts"]

UNIT_FOLDER: Final = Path("/etc/systemd/system")
_RUNNING: Final = Path("/run/systemd/system")  # sd_booted(3)
_TIMEOUT_S: Final = 60.0
_OF_DEVICES: Final = frozenset({"CAP_NET_ADMIN", "CAP_NET_RAW"})
_FENCES: Final = """\
PrivateDevices=yes
PrivateTmp=yes
ProtectControlGroups=yes
ProtectKernelTunables=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
SystemCallArchitectures=native
SystemCallErrorNumber=EPERM
SystemCallFilter=@system-service
"""  # of programs that any host may connect to, and that touch no device
_UNSAFE: Final = re.compile(r"[^A-Za-z0-9_.-]")


def has_systemd() -> bool:
    """Return whether systemd runs this host."""
    return _RUNNING.is_dir()


def unit_texts(directory: Path, programs: Sequence[MachineProgram]) -> dict[str, str]:
    """Return the units of a machine by file name, in the order in which they start."""
    names = [f"gdp-{_UNSAFE.sub('-', directory.name)}-{each.name}.service" for each in programs]
    return {
        name: _unit(directory, each, None if each is programs[0] else names[0])
        for name, each in zip(names, programs, strict=True)
    }


def install_units(
    units: Mapping[str, str], folder: Path = UNIT_FOLDER, run: Callable[[Sequence[str]], None] | None = None
) -> None:
    """Write units, and start them now and at each boot.

    Raises:
        LocalError: the folder cannot be written, or systemd refuses.
    """
    call = run or _systemctl
    write_all(folder, {name: public(text.encode()) for name, text in units.items()}, force=True)
    call(["daemon-reload"])
    call(["enable", "--now", *units])


def remove_units(
    units: Sequence[str], folder: Path = UNIT_FOLDER, run: Callable[[Sequence[str]], None] | None = None
) -> None:
    """Stop units and remove their files. Raises ``LocalError``: systemd refuses."""
    call = run or _systemctl
    call(["disable", "--now", *units])
    for each in units:
        (folder / each).unlink(missing_ok=True)
    call(["daemon-reload"])


def _unit(directory: Path, program: MachineProgram, after: str | None) -> str:
    words = " ".join(_quoted(each) for each in program.argv)
    order = "After=network-online.target\nWants=network-online.target\n"
    order += f"After={after}\nWants={after}\n" if after is not None else ""
    environment = "".join(f"Environment={_quoted(f'{key}={value}')}\n" for key, value in program.environment)
    return f"""\
[Unit]
Description={program.title}
{order}StartLimitIntervalSec=0

[Service]
Type=exec
ExecStart={words}
ExecReload=/bin/kill -HUP $MAINPID
{environment}KillSignal=SIGINT
Restart=always
RestartSec=1
WorkingDirectory={directory.absolute()}
CapabilityBoundingSet={" ".join(program.capabilities)}
NoNewPrivileges=yes
ProtectSystem=full
ProtectClock=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
LockPersonality=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
UMask=0077
{"" if set(program.capabilities) & _OF_DEVICES else _FENCES}\

[Install]
WantedBy=multi-user.target
"""


def _quoted(word: str) -> str:
    """Return a word of a command line; systemd.service(5), section COMMAND LINES."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"' if re.search(r"[\s'\"\\;]", word) else escaped


def _systemctl(words: Sequence[str]) -> None:
    try:
        done = subprocess.run(["systemctl", *words], capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise LocalError(f"systemctl {words[0]}: {error}") from error
    if done.returncode != 0:
        raise LocalError(f"systemctl {words[0]}: {done.stderr.strip() or done.returncode}")
