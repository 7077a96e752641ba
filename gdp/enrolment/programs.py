"""Programs of a machine: which commands run for it, in which order they start, and what each may do.

I/O; it looks at the files of the machine and at the installed packages. A machine joined a domain, or its nodes were
configured by hand.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.config.machine_file import MACHINE_FILE, SECTIONS, read_sections, section_source
from gdp.config.store_config import StoreConfig
from gdp.config.yaml_source import read_yaml
from gdp.enrolment.member_files import MEMBER_FILE, MemberFiles
from gdp.enrolment.member_setup import RELAY_FILE
from gdp.errors import LocalError
from gdp.extras import find_entry_point, install_command
from gdp.intervals import SERVER_S

FOG_FILE: Final = "fog.yaml"
_NET: Final = ("CAP_NET_RAW", "CAP_NET_ADMIN", "CAP_BPF", "CAP_PERFMON")  # a device, and programs in the kernel
_AWAIT_S: Final = "60"
_ROS_VARIABLES: Final = (
    "PYTHONPATH", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "ROS_DISTRO", "ROS_DOMAIN_ID", "RMW_IMPLEMENTATION",
    "ROS_LOCALHOST_ONLY", "ROS_AUTOMATIC_DISCOVERY_RANGE", "CYCLONEDDS_URI",
)  # fmt: skip
_TITLES: Final = {
    "switch": "GDP switch: forwards frames by 256-bit names",
    "relay": "GDP relay: carries frames through TLS where UDP is blocked",
    "rib": "GDP RIB: stores where names are",
    "proxy": "GDP proxy: carries ROS over the overlay",
    "store": "GDP holder: keeps the history of topics in capsules",
    "fog": "GDP fog supervisor: replaces machines of clusters that are lost",
}
_COMMANDS: Final = {"store": ("gdp", "store", "serve", "--config"), "fog": ("fog", "supervise", "--stay", "--site")}
_ROS: Final = ("rclpy", "cyclonedds")


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineProgram:
    """A program that runs as long as the machine is a member.

    Args:
        title: for people; ``name`` is part of the unit's name.
        argv: the command.
        capabilities: those that it needs at its start.
        environment: variables that a unit has to set: those of ROS, as ``setup.bash`` exports them.
        config: file of a node that was configured by hand.
        writes: a folder that it writes, too; None: none beyond those of the machine and its keys.
    """

    name: str
    title: str
    argv: tuple[str, ...]
    capabilities: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()
    config: Path | None = None
    writes: Path | None = None


def programs_of(files: MemberFiles) -> list[MachineProgram]:
    """Return the programs of a machine, in the order in which they start."""
    directory = files.directory.absolute()
    found = [
        MachineProgram(
            name="switch",
            title=_TITLES["switch"],
            argv=_module("gdp.cli.switch", "--config", directory / "switch.yaml"),
            capabilities=_NET,
        )
    ]
    if (directory / RELAY_FILE).exists():
        argv = _module("gdp.cli.relay", "--config", directory / RELAY_FILE)
        needed = ("CAP_NET_ADMIN", "CAP_NET_RAW", "CAP_NET_BIND_SERVICE")
        title = _TITLES["relay"]
        found.append(MachineProgram(name="relay", title=title, argv=argv, capabilities=needed))
    if files.config.rib is not None:
        argv = _module("gdp.cli.rib", "--config", directory / "rib.yaml", "--await-iface", _AWAIT_S)
        found.append(MachineProgram(name="rib", title=_TITLES["rib"], argv=argv, capabilities=_NET))
    if files.is_border:
        argv = _module("gdp.cli.gdp", "domain", "serve", directory)
        title, bind = "GDP enrolment server of a domain", ("CAP_NET_BIND_SERVICE",)
        found.append(MachineProgram(name="enrolment", title=title, argv=argv, capabilities=bind))
    if files.config.proxy is not None and not missing_ros():
        argv = _module(_module_of("gdp-proxy"), "--config", directory / "proxy.yaml", "--await-iface", _AWAIT_S)
        found.append(
            MachineProgram(
                name="proxy",
                title=_TITLES["proxy"],
                argv=argv,
                capabilities=_NET,
                environment=_ros_environment(),
            )
        )
    if files.config.store is not None:
        config = directory / "store.yaml"
        argv, folder = _module("gdp.cli.gdp", *_COMMANDS["store"][1:], config, "--await-iface", _AWAIT_S), _held(config)
        title = _TITLES["store"]
        found.append(MachineProgram(name="store", title=title, argv=argv, capabilities=_NET, writes=folder))
    found.append(
        MachineProgram(
            name="agent",
            title="GDP agent: renews memberships and fetches mail",
            argv=_module("gdp.cli.gdp", "agent", directory),
        )
    )
    return found


def node_program(name: str, config: Path) -> MachineProgram:
    """Return the program of a node that a file configures: a section of ``machine.yaml``, or ``fog``."""
    awaits = ("--await-iface", _AWAIT_S) if name in ("rib", "proxy", "store") else ()
    argv = _command(*_COMMANDS.get(name, (f"gdp-{name}", "--config")), config, *awaits)
    return MachineProgram(
        name=name,
        title=_TITLES[name],
        argv=argv,
        environment=_ros_environment() if name == "proxy" else (),
        config=config,
        writes=_held(config) if name == "store" else None,
    )


def _held(config: Path) -> Path:
    """Return the folder of a holder's capsules."""
    return StoreConfig.load(config).holds.folder.resolve()


def missing_ros() -> str:
    """Return why no proxy can run here; empty: one can."""
    if find_entry_point("console_scripts", "gdp-proxy") is None:
        return "the package of the proxy is not installed"
    if all(importlib.util.find_spec(each) is None for each in _ROS):
        return f"neither rclpy nor cyclonedds is installed: {install_command('dds')}, then run gdp up again"
    return ""


def _ros_environment() -> tuple[tuple[str, str], ...]:
    return tuple((key, os.environ[key]) for key in _ROS_VARIABLES if os.environ.get(key))


def _command(command: str, *words: str | Path) -> tuple[str, ...]:
    """Return a node's command line: its script next to the interpreter, or its module where no script is installed."""
    script = Path(sys.executable).with_name(command)
    return (str(script), *map(str, words)) if script.is_file() else _module(_module_of(command), *words)


def _module_of(script: str) -> str:
    """Return the module of a script of this distribution."""
    point = find_entry_point("console_scripts", script)
    if point is None:
        raise LocalError(f"the package of {script} is not installed (run: pip install gdp-ros)")
    return point.module


def _module(module: str, *words: str | Path) -> tuple[str, ...]:
    return (sys.executable, "-m", module, *map(str, words))


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
        files = {each: path / f"{each}.yaml" for each in SECTIONS if (path / f"{each}.yaml").is_file()}
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
