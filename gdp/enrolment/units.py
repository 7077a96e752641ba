"""systemd units of a machine's programs.

I/O. The units are named after the machine's directory, so that one host can belong to several domains.
"""

from __future__ import annotations

import contextlib
import re
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from gdp.enrolment.programs import MachineProgram
from gdp.errors import LocalError
from gdp.stores.files import public, write_all

MARK: Final = (
    "# gdp service: "  # begins the first line of each unit, in earlier versions too; then the machine's folder
)
UNIT_FOLDER: Final = Path("/etc/systemd/system")
_RUNNING: Final = Path("/run/systemd/system")  # sd_booted(3)
_TIMEOUT_S: Final = 120.0  # a node has 90 s to report that it is up
_RUNTIME: Final = Path("/run")
_RUNTIME_LINE: Final = re.compile(r"^RuntimeDirectory=(.*)$", re.MULTILINE)
_UNSAFE: Final = re.compile(r"[^A-Za-z0-9_.-]")


def has_systemd() -> bool:
    """Return whether systemd runs this host."""
    return _RUNNING.is_dir()


def unit_names(directory: Path | None, programs: Sequence[MachineProgram]) -> dict[str, str]:
    """Return the file name of each program's unit; None: of the machine whose configuration is in ``/etc/gdp``."""
    machine = "" if directory is None else f"{_UNSAFE.sub('-', directory.name)}-"
    return {each.name: f"gdp-{machine}{each.name}.service" for each in programs}


def installed_units(directory: Path | None = None, folder: Path = UNIT_FOLDER) -> list[str]:
    """Return the file names of units that were written here, in the order in which they start.

    Args:
        directory: the machine's folder; None: of all machines.
    """
    found = list[tuple[int, str]]()
    for path in folder.glob("gdp-*.service"):
        if path.is_symlink() or not path.is_file():
            continue
        first = path.read_text(encoding="utf-8", errors="replace").partition("\n")[0]
        if first.startswith(MARK) and (directory is None or first.removeprefix(MARK) == str(directory.absolute())):
            found.append((path.stat().st_mtime_ns, path.name))
    return [name for _, name in sorted(found)]


def install_units(
    units: Mapping[str, str], folder: Path = UNIT_FOLDER, run: Callable[[Sequence[str]], object] | None = None
) -> None:
    """Write units, and start them now and at each boot.

    Raises:
        LocalError: the folder cannot be written, or systemd refuses.
    """
    call = run or systemctl
    write_all(folder, {name: public(text.encode()) for name, text in units.items()}, force=True)
    call(["daemon-reload"])
    call(["enable", "--now", *units])


def remove_units(
    units: Sequence[str], folder: Path = UNIT_FOLDER, run: Callable[[Sequence[str]], object] | None = None
) -> None:
    """Stop units and remove their files. Raises ``LocalError``: systemd refuses."""
    call = run or systemctl
    call(["disable", "--now", *units])
    folders = {name for each in units for name in _runtime_folders(folder / each)}
    for each in units:
        (folder / each).unlink(missing_ok=True)
    call(["daemon-reload"])
    for name in folders:
        _remove_empty(_RUNTIME / name)


def _runtime_folders(unit: Path) -> list[str]:
    """Return the folders below /run that a unit preserves for the others."""
    line = _RUNTIME_LINE.search(unit.read_text(encoding="utf-8")) if unit.exists() else None
    return line[1].split() if line else []


def _remove_empty(path: Path) -> None:
    """Remove a folder of locks that no node uses any more; of a dynamic user, ``path`` is a link to it."""
    target = path.resolve()
    for each in (target / "gdp-locks", target):
        with contextlib.suppress(OSError):  # missing, or other nodes use it
            each.rmdir()
    if path.is_symlink() and not target.exists():
        path.unlink()


def quoted(word: str) -> str:
    """Return a word of a command line; systemd.service(5), section COMMAND LINES."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"' if re.search(r"[\s'\"\\;]", word) else escaped


def systemctl(words: Sequence[str]) -> str:
    """Run ``systemctl`` and return what it prints. Raises ``LocalError``: it is missing or refuses."""
    try:
        done = subprocess.run(["systemctl", *words], capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise LocalError(f"systemctl {words[0]}: {error}") from error
    if done.returncode != 0:
        raise LocalError(f"systemctl {words[0]}: {done.stderr.strip() or done.returncode}")
    return done.stdout
