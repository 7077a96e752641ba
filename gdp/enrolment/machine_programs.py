"""Programs of a machine whose files are given by a path: it joined a domain, or its nodes were configured by hand.

I/O; it reads files.
"""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.config.machine_file import MACHINE_FILE, NODE_SECTIONS, read_sections, section_source
from gdp.config.yaml_source import read_yaml
from gdp.enrolment.member_files import MEMBER_FILE, MemberFiles
from gdp.enrolment.programs import MachineProgram, node_program, programs_of
from gdp.errors import LocalError
from gdp.intervals import SERVER_S

FOG_FILE: Final = "fog.yaml"


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """A machine's folder and programs.

    Args:
        directory: absolute; the folder of its configuration.
        programs: in the order of their start.
        is_member: it joined or created a domain, so an agent runs, too.
        missing_proxy: the file of a proxy that ``machine.yaml`` names, if it is not there.
    """

    directory: Path
    programs: tuple[MachineProgram, ...]
    is_member: bool
    missing_proxy: Path | None = None

    def identity_of(self, program: MachineProgram) -> Path:
        """Return the folder of a node's keys; for a program without keys, the folder of the machine."""
        return self.directory if program.config is None else configured_identity(program.config, program.name)


def read_machine(path: Path, *, with_fog: bool = False) -> Machine:
    """Return the machine of a directory, or of a ``machine.yaml``.

    Args:
        with_fog: also the supervisor of clusters, where there is a ``fog.yaml``.

    Raises:
        LocalError: no node is configured there; the text says what makes one.
        ConfigError: a file cannot be read.
    """
    path = path.absolute()
    if path.is_file():
        directory, files = path.parent, dict(read_sections(path))
    elif (path / MEMBER_FILE).is_file():
        return Machine(directory=path, programs=tuple(programs_of(MemberFiles.load(path))), is_member=True)
    elif (path / MACHINE_FILE).is_file():
        directory, files = path, dict(read_sections(path / MACHINE_FILE))
    else:
        directory = path
        files = {each: path / f"{each}.yaml" for each in NODE_SECTIONS if (path / f"{each}.yaml").is_file()}
    if with_fog and (directory / FOG_FILE).is_file():
        files["fog"] = directory / FOG_FILE
    if not files:
        raise LocalError(
            f"{path}: no configuration of a node is here; run gdp join or gdp domain create, or gdp lab for a lab;"
            f" docs/reference/configuration.md describes {MACHINE_FILE}"
        )
    missing = files.pop("proxy") if "proxy" in files and not files["proxy"].is_file() else None
    programs = tuple(node_program(name, file) for name, file in files.items())
    return Machine(directory=directory, programs=programs, is_member=False, missing_proxy=missing)


def check_program(program: MachineProgram) -> None:
    """Have a node that was configured by hand validate its configuration.

    Raises:
        LocalError: it refuses, with its words, or its command cannot run.
    """
    if program.config is None or "--config" not in program.argv:
        return
    argv = [*program.argv[: program.argv.index("--config") + 2], "--check"]
    try:
        done = subprocess.run(argv, cwd="/", capture_output=True, text=True, timeout=SERVER_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise LocalError(f"{program.name}: its configuration cannot be checked: {error}") from error
    if done.returncode != 0:
        raise LocalError(f"nothing was started, because {program.name} says:\n{done.stderr.strip()}")


def configured_identity(config: Path, section: str) -> Path:
    """Return the folder of keys that a node's configuration names. Raises ``ConfigError``: it cannot be read."""
    data = section_source(read_yaml(config), section).data
    stated = data.get("identity") if isinstance(data, dict) else None
    return (config.parent / stated).resolve() if isinstance(stated, str) else config.parent
