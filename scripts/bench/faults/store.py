"""Valkey or Redis Cluster in a namespace of the run, which RIBs reach over a bridge; servers fail on demand.

I/O. ``scripts/start_cluster.sh`` starts three primaries with a replica each. The servers are daemons. They are in the
run's record, and they run in a namespace of the run; its end ends all processes inside.
"""

from __future__ import annotations

import errno
import os
import shutil
import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final

import yaml
from redis import Redis
from redis.exceptions import RedisError

from gdp.host import netns_files
from gdp.host.mounts import mount_tmpfs
from gdp.host.run_registry import Run
from lab.faults import Fault, FaultKind
from lab.machine import LabMachine
from lab.namespaces import Namespace, Namespaces
from lab.process import until

_START_CLUSTER: Final = Path(__file__).resolve().parents[2] / "start_cluster.sh"
_KINDS: Final = ("valkey", "redis")  # in the order of start_cluster.sh
_BRIDGE: Final = "servers"
_IFNAME: Final = "store"  # device in the namespace of a RIB
_ADDRESS: Final = "10.255.77.1"
_OF_RIBS: Final = "10.255.77.{}"
_START_S: Final = 120.0
_ANSWER_S: Final = 0.3
_WHOLE_S: Final = 20.0
_CRITICAL: Final = "== CRITICAL =="  # of a server that lost data and continues


def has_server() -> bool:
    """Return whether a Valkey or Redis server, with its client, is installed."""
    return _program() is not None


class StoreCluster:
    """Cluster of six servers.

    ``run``: run whose folder holds the data. ``spaces``: of the network. ``ribs``: switches in whose namespaces the
    RIBs run that use the cluster. Raises ``LocalError``: the kernel refuses. Raises ``FailedError``: the servers do not
    start.
    """

    def __init__(self, run: Run, spaces: Namespaces, ribs: Sequence[str]) -> None:
        self._run = run
        self._folder = run.directory / "store"
        self._namespace = Namespace(run, "store")
        self._namespace.inside(netns_files.disable_ipv6)
        self._namespace.bridge(_BRIDGE)
        self._namespace.configure(["link set lo up", f"addr add {_ADDRESS}/24 dev {_BRIDGE}"])
        for at, node in enumerate(ribs, 2):
            self._join(spaces[node], f"to-{node}", _OF_RIBS.format(at))
        self._enter = self._namespace.command([], dies_with_us=False)
        host = LabMachine(run.directory, self._enter)
        config = host.output(str(_START_CLUSTER), str(self._folder), _ADDRESS, patience_s=_START_S)
        self._config = yaml.safe_load(Path(config.strip()).read_text(encoding="utf-8"))
        self._password = (self._folder / "admin.password").read_text(encoding="ascii").strip()
        self._servers = {int(conf.parent.name): _port(conf) for conf in self._folder.glob("*/server.conf")}
        program = _program()
        assert program is not None  # or the script had failed
        self._program = program
        for number in self._servers:
            run.note_process(self._pid(number))
        self._away: dict[Fault, int] = {}  # killed or frozen servers

    @property
    def config(self) -> Mapping[str, object]:
        """Return the keys of a RIB's file that make it use the cluster."""
        return dict(self._config)

    def take(self, fault: Fault) -> str:
        """Kill or stop a replica, or a primary that has a replica in step; return which."""
        is_primary, stops = fault.kind is not FaultKind.KILL_REPLICA, fault.kind is FaultKind.FREEZE_PRIMARY
        fit = until(lambda: self._fit(is_primary=is_primary), lambda: "a whole store after a fault", _WHOLE_S)
        server = self._away[fault] = fit[round(fault.amount) % len(fit)]
        os.kill(self._pid(server), signal.SIGSTOP if stops else signal.SIGKILL)
        return f"server {server}"

    def give_back(self, fault: Fault) -> None:
        """Continue a stopped server, or restart a killed one. Raises ``FailedError``: it does not start."""
        number = self._away.pop(fault)
        if fault.kind is FaultKind.FREEZE_PRIMARY:
            with suppress(ProcessLookupError):
                os.kill(self._pid(number), signal.SIGCONT)
            return
        folder = self._folder / str(number)
        (folder / "server.pid").unlink(missing_ok=True)
        LabMachine(folder, self._enter).output(self._program, "server.conf")
        until(lambda: self._role(number) is not None, lambda: f"an answer of server {number} of the store", _WHOLE_S)
        self._run.note_process(self._pid(number))

    def complaints(self) -> list[str]:
        """Return which servers said in their log that they lost data."""
        return critical_lines(self._folder)

    def close(self) -> None:
        """End the servers; the run removes their data."""
        for number in self._servers:
            with suppress(FileNotFoundError, ProcessLookupError):
                os.kill(self._pid(number), signal.SIGKILL)

    def _fit(self, *, is_primary: bool) -> list[int]:
        """Return the servers of this role; only those that another server could replace, or that replace none yet."""
        roles = {number: self._role(number) for number in sorted(self._servers)}
        if any(role is None for role in roles.values()) or list(roles.values()).count((True, True)) != len(roles) // 2:
            return []
        return [number for number, role in roles.items() if role is not None and role[0] is is_primary]

    def _role(self, number: int) -> tuple[bool, bool] | None:
        """Return whether a server is a primary, and whether its counterpart is in step; None: it does not answer."""
        return self._namespace.inside(partial(_role_of, self._servers[number], self._password, self._folder))

    def _pid(self, number: int) -> int:
        return int((self._folder / str(number) / "server.pid").read_text(encoding="ascii"))

    def _join(self, rib: Namespace, ifname: str, address: str) -> None:
        self._namespace.join(rib, ifname, _IFNAME)
        self._namespace.configure([f"link set dev {ifname} master {_BRIDGE} up"])
        rib.configure([f"addr add {address}/24 dev {_IFNAME}", f"link set dev {_IFNAME} up"])


def critical_lines(folder: Path) -> list[str]:
    """Return the first critical line of each server's log, in the folder of a cluster."""
    found = []
    for log in sorted(folder.glob("*/server.log")):
        lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if _CRITICAL in line]
        if lines:
            found.append(
                f"server {log.parent.name} of the store, {len(lines)} times: {lines[0].partition(_CRITICAL)[2].strip()}"
            )
    return found


def _program() -> str | None:
    """Return the server program that ``start_cluster.sh`` also starts, or None."""
    kinds = (kind for kind in _KINDS if shutil.which(f"{kind}-cli"))
    return next((program for kind in kinds if (program := shutil.which(f"{kind}-server"))), None)


def _port(conf: Path) -> int:
    words = (line.split() for line in conf.read_text(encoding="utf-8").splitlines())
    return next(int(each[1]) for each in words if each and each[0] == "tls-port")


def _role_of(port: int, password: str, folder: Path) -> tuple[bool, bool] | None:
    client = Redis(
        host=_ADDRESS, port=port, username="admin", password=password, ssl=True, ssl_ca_certs=str(folder / "ca.pem"),
        socket_timeout=_ANSWER_S, socket_connect_timeout=_ANSWER_S,
    )  # fmt: skip
    try:
        known = client.info("replication")
        is_primary = known["role"] == "master"
        is_in_step = known["connected_slaves"] > 0 if is_primary else known["master_link_status"] == "up"
        return is_primary, bool(is_in_step)
    except (RedisError, OSError):
        return None
    finally:
        client.close()


SIZE_BYTES: Final = 64 << 20  # six snapshots with their logs take 30 MB at most
NOT_WRITTEN: Final = "snapshot not written"
_WRITTEN: Final = "snapshot written again"
_READ: Final = "snapshot read"
_NOT_READ: Final = "snapshot not read"
_UP: Final = "rib up"
BROKEN: Final = ".broken"
_BLOCKS_BYTES: Final = (1 << 20, 1 << 12)


class Disk:
    """Small file system.

    ``run``: run whose folder holds the mount, and whose end unmounts it. Raises ``LocalError``: the kernel refuses.
    """

    def __init__(self, run: Run) -> None:
        self._path = run.directory / "disk"
        run.plan_mount(self._path)
        mount_tmpfs(self._path, SIZE_BYTES)

    @property
    def _ballast(self) -> Path:
        return self._path / "ballast"

    def snapshot(self, node: str) -> Path:
        """Return the path of the snapshot of the RIB at a switch."""
        return self._path / f"rib-{node}.sqlite"

    def fill(self) -> None:
        """Fill every block."""
        with self._ballast.open("wb", buffering=0) as file:
            for size in _BLOCKS_BYTES:
                try:
                    while True:
                        file.write(bytes(size))
                except OSError as error:
                    if error.errno != errno.ENOSPC:
                        raise

    def free(self) -> None:
        """Free the blocks."""
        self._ballast.unlink(missing_ok=True)

    def broken(self) -> list[str]:
        """Return the snapshots that a RIB could not read."""
        return sorted(name for name in os.listdir(self._path) if name.endswith(BROKEN))


def snapshot_faults(who: str, log: str, *, is_alive: bool) -> Iterator[str]:
    """Yield, in words, what an incarnation of a RIB logged wrongly about its snapshot.

    ``log``: its whole log. ``is_alive``: it runs, the disk has free space, and it had enough time to write.
    """
    is_failing = has_started = False
    for line in log.splitlines():
        if _UP in line and not has_started:
            yield f"{who} is up and did not say what it read of its snapshot"
        elif _READ in line or _NOT_READ in line:
            has_started = True
            if _READ in line and " unreadable=0 " not in line:
                yield f"{who} read half an entry: {line}"
        elif NOT_WRITTEN in line:
            if is_failing:
                yield f"{who} said twice that its snapshot is not written"
            is_failing = True
        elif _WRITTEN in line:
            is_failing = False
    if is_failing and is_alive:
        yield f"{who} does not write its snapshot again, or does not say so"
