"""Discovery of the interfaces of nodes: the nodes run once in a separate ROS graph.

I/O. Needs rclpy. Results are cached in the user's cache folder, keyed by command line and modification time of the
code.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from fog.child_environment import child_environment
from fog.cluster import CloudNode
from fog.launch.resolve import PYTHON, command_line, file_of
from gdp.errors import LocalError
from gdp.host.run_registry import RunRegistry
from gdp.terminal import echo

Found = tuple[tuple[str, str, str], ...]

# the ports of lower domains are in Linux's ephemeral range; ROS 2, "The ROS_DOMAIN_ID"
_DOMAINS: Final = range(215, 233)
_PORTS: Final = (7400, 250)  # of discovery: base, and gain per domain; DDSI-RTPS 2.5, section 9.6.2


def offered(nodes: Sequence[CloudNode], *, cache: Path | None = None) -> Found:
    """Return (kind, name, type) of the services and actions of nodes; takes some seconds the first time.

    Topics are not discovered, because a launch file must select the topics to export.
    """
    cache = cache or cache_file()
    if (before := kept(nodes, cache=cache)) is not None:
        return before
    echo("starting the nodes once, to see what they offer", err=True)
    found = _found(nodes)
    known = {**_read(cache), _key(nodes): found}
    cache.parent.mkdir(parents=True, exist_ok=True)
    fresh = cache.with_suffix(f".{os.getpid()}")
    fresh.write_text(json.dumps(known, indent=1), encoding="utf-8")
    fresh.replace(cache)
    return found


def kept(nodes: Sequence[CloudNode], *, cache: Path | None = None) -> Found | None:
    """Return the cached result without starting nodes; None: there is none."""
    found = _read(cache or cache_file()).get(_key(nodes))
    return None if found is None else tuple((kind, name, type_name) for kind, name, type_name in found)


def cache_file() -> Path:
    """Return the default cache file."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gdp" / "offered.json"


def _found(nodes: Sequence[CloudNode]) -> Found:
    question = {
        "domain": (domain := free_domain()),
        "nodes": [{"argv": _argv(node), "environment": dict(node.environment)} for node in nodes],
    }
    environment = {
        **child_environment(os.environ),
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "FOG_MACHINE": "probe",
    }
    run = RunRegistry().start()
    try:
        with subprocess.Popen(
            [sys.executable, "-m", "fog.launch.interface_discovery_worker", str(run.directory)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as process:
            run.note_process(process.pid)
            answer, _ = process.communicate(json.dumps(question))
    finally:
        run.end()
    try:
        said = json.loads(answer.splitlines()[-1])
    except (IndexError, ValueError) as error:
        raise LocalError(f"what the nodes offer was not found out (exit {process.returncode})") from error
    if "error" in said:
        raise LocalError(str(said["error"]))
    return tuple((kind, name, type_name) for kind, name, type_name in said["offered"])


def _argv(node: CloudNode) -> list[str]:
    return [sys.executable if word == PYTHON else word for word in command_line(node, os.environ)]


def free_domain() -> int:
    """Return a domain id that is unused on this machine; other processes get other ids."""
    taken = set(_bound_ports(Path("/proc/net/udp").read_text(encoding="ascii").splitlines()[1:]))
    base, gain = _PORTS
    free = [domain for domain in _DOMAINS if base + gain * domain not in taken]
    if not free:
        raise LocalError("all ROS domain ids from 215 to 232 are in use on this machine")
    return free[os.getpid() % len(free)]


def _bound_ports(lines: Iterable[str]) -> Iterable[int]:
    return (int(line.split()[1].rpartition(":")[2], 16) for line in lines)


def _key(nodes: Sequence[CloudNode]) -> str:
    files = [file_of(node, os.environ) for node in nodes]
    ages = [file.stat().st_mtime_ns if file else 0 for file in files]
    said = [(asdict(node), str(file), age) for node, file, age in zip(nodes, files, ages, strict=True)]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _read(cache: Path) -> Mapping[str, Sequence[tuple[str, str, str]]]:
    try:
        found: dict[str, list[tuple[str, str, str]]] = json.loads(cache.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # a missing or damaged cache counts as empty
        return {}
    return found
