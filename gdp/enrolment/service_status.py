"""State of a machine's units: what systemd says of each, and what its node says of itself.

I/O; asks systemd, and nodes by their control sockets.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.config.machine_file import NODE_SECTIONS, section_source
from gdp.config.yaml_source import read_yaml
from gdp.enrolment.programs import configured_identity
from gdp.enrolment.units import UNIT_FOLDER, installed_units, systemctl
from gdp.errors import GdpError, LocalError
from gdp.intervals import ANSWER_S
from gdp.management.control_client import ask_node, control_path, find_control_socket_of
from gdp.state.control_protocol import Command
from gdp.stores.keyring import CARD, load_card

_PACKAGED: Final = Path("/usr/lib/systemd/system")
_RUNTIME: Final = re.compile(r"^Environment=.*?\bXDG_RUNTIME_DIR=(\S+)", re.MULTILINE)
_EXEC: Final = re.compile(r"^ExecStart=(.*)$", re.MULTILINE)
_KEYS: Final = ("ActiveState", "SubState", "UnitFileState", "NRestarts", "MainPID", "FragmentPath")


@dataclass(frozen=True, slots=True, kw_only=True)
class UnitState:
    """One unit.

    Args:
        active: systemd's word: ``active``, ``activating``, ``failed``, ``inactive``...
        enabled: whether it starts at boot.
        restarts: by systemd, since it was started.
        node: what the node says: ``ready``, or why it is not; None: the program is no node.
        uptime_s: of the node, as it says.
    """

    unit: str
    active: str
    enabled: bool
    restarts: int
    pid: int
    node: str | None
    uptime_s: float | None

    @property
    def is_well(self) -> bool:
        """Return whether the unit runs and its node is ready."""
        return self.active == "active" and self.node in (None, "ready")


def known_units(directory: Path | None = None) -> list[str]:
    """Return the units that ``gdp unit`` wrote, and without a directory also enabled ones of a package."""
    found = installed_units(directory)
    if directory is None:
        found += [each.name for each in sorted(_PACKAGED.glob("gdp-*.service")) if _is_enabled(each.name)]
    return list(dict.fromkeys(found))


def unit_state(unit: str) -> UnitState:
    """Return the state of a unit. Raises ``LocalError``: systemd does not answer."""
    text = systemctl(["show", *(f"--property={key}" for key in _KEYS), unit])
    shown = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
    active = shown.get("ActiveState", "unknown")
    node, uptime_s = (None, None) if active == "inactive" else _node(unit, Path(shown.get("FragmentPath", "")))
    return UnitState(
        unit=unit,
        active=active,
        enabled=shown.get("UnitFileState") == "enabled",
        restarts=int(shown.get("NRestarts") or 0),
        pid=int(shown.get("MainPID") or 0),
        node=node,
        uptime_s=uptime_s,
    )


def _is_enabled(unit: str) -> bool:
    return any(UNIT_FOLDER.glob(f"*.wants/{unit}"))


def _node(unit: str, fragment: Path) -> tuple[str | None, float | None]:
    """Return what the unit's node says of itself, and its uptime in seconds."""
    section = unit.removesuffix(".service").rpartition("-")[2]
    if section not in NODE_SECTIONS:
        return None, None
    try:
        status = ask_node(_socket(fragment.read_text(encoding="utf-8"), section), Command.STATUS, ANSWER_S)
    except OSError as error:
        return f"{fragment}: {error.strerror}", None
    except GdpError as error:
        return str(error), None
    if not status.is_ok:
        return status.error, None
    uptime = status.result.get("uptime_s")
    is_attached = status.result.get("attached") is not False
    return "ready" if is_attached else "waits for its switch", uptime if isinstance(uptime, int | float) else None


def _socket(text: str, section: str) -> Path:
    """Return the control socket of a unit's node. Raises ``LocalError``: the unit names no configuration."""
    line = _EXEC.search(text)
    words: Sequence[str] = shlex.split(line[1].replace("%%", "%").replace("$$", "$")) if line else ()
    if "--config" not in words[:-1]:
        raise LocalError("the unit's command names no --config")
    config = Path(words[words.index("--config") + 1])
    data = section_source(read_yaml(config), section).data
    if isinstance(data, dict) and isinstance(stated := data.get("control_socket"), str):
        return config.parent / stated
    name = load_card(configured_identity(config, section) / CARD).name
    if runtime := _RUNTIME.search(text):
        own = Path(runtime[1].replace("%t", "/run"), "gdp-locks", control_path(name).name)
        if own.exists():
            return own
    return find_control_socket_of(name)
