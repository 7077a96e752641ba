"""Bootstrap bundle as plain files, which any provider can transfer: by hand, in user data, over ssh.

I/O: ``install`` writes the files. All other functions are sans-I/O.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path, PurePosixPath
from typing import Final

from fog.machine import MachineBundle, Program
from gdp.errors import LocalError
from gdp.stores.files import private, write_all

BOOT_FILE: Final = "boot.json"
JOIN_FILE: Final = "join.json"  # token and label, until the machine has joined
MEMBER_FOLDER: Final = "member"  # keys and, of a rented machine, what else `gdp join` makes


def pack(boot: MachineBundle) -> dict[str, bytes]:
    """Return all files below the machine's folder: those of the bundle, and ``boot.json``, which lists its programs.

    Raises:
        LocalError: a path leads out of the folder or is ``boot.json``; two programs have one name.
    """
    for path in boot.files:
        parts = PurePosixPath(path).parts
        if not parts or path.startswith("/") or ".." in parts or path == BOOT_FILE:
            raise LocalError(f"boot: {path!r} is no place for a file of a machine")
    names = [program.name for program in boot.programs]
    if len(set(names)) < len(names) or not all(name.replace("-", "").replace("_", "").isalnum() for name in names):
        raise LocalError(f"boot: programs need different names of letters, digits, '-' and '_': {', '.join(names)}")
    document = {"programs": [asdict(program) for program in boot.programs]}
    return {**boot.files, BOOT_FILE: json.dumps(document, indent=1).encode()}


def unpack(files: Mapping[str, bytes]) -> MachineBundle:
    """Return the bundle that was packed. Raises ``LocalError``: ``boot.json`` is missing or invalid."""
    if BOOT_FILE not in files:
        raise LocalError(f"no {BOOT_FILE}")
    others = {path: content for path, content in files.items() if path != BOOT_FILE}
    return MachineBundle(others, read_programs(files[BOOT_FILE]))


def read_programs(content: bytes) -> tuple[Program, ...]:
    """Return the programs that a ``boot.json`` lists. Raises ``LocalError``: the content is invalid."""
    try:
        document = json.loads(content)["programs"]
        programs = tuple(Program(**{**each, "argv": tuple(each["argv"])}) for each in document)
        for program in programs:
            _refuse_what_cannot_start(program)
    except json.JSONDecodeError as error:
        raise LocalError(f"{BOOT_FILE}:{error.lineno}: JSON is expected: {error.msg}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise LocalError(f"{BOOT_FILE} is none: {error!r}") from error
    return programs


def _refuse_what_cannot_start(program: Program) -> None:
    texts = (program.name, program.ready, *program.argv, *program.environment, *program.environment.values())
    if not program.argv or not all(isinstance(text, str) and "\0" not in text for text in texts):
        raise LocalError(f"{BOOT_FILE} is none: program {program.name!r} has no words, or other things than text")


def install(home: Path, boot: MachineBundle) -> None:
    """Write all files of a bundle into a machine's folder, readable only by its owner.

    Raises:
        LocalError: as ``pack``; a file exists already, or the system refuses.
    """
    for path, content in pack(boot).items():
        place = home / path
        for folder in [home, *(home / each for each in reversed(PurePosixPath(path).parents))]:
            folder.mkdir(mode=0o700, exist_ok=True)
        write_all(place.parent, {place.name: private(content)})
