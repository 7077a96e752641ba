"""Rights of each kind of node after its start, and the confinement to them.

I/O. A switch continues to open ports that come back and to remove its veth pairs (CAP_NET_RAW, CAP_NET_ADMIN). With the
kernel data plane it also loads and attaches its program there (CAP_BPF, CAP_PERFMON). A RIB or proxy opens its device
again when it comes back, and its programs for keepalives are open. A node reads the operator's folders again on SIGHUP,
or when its certificates are replaced. If another user owns these, as in a shell of sudo, the node keeps the capability
to read or write past the owner, and Landlock bounds it. A relay makes TAP devices while it runs (CAP_NET_ADMIN).
"""

from __future__ import annotations

import logging
import os
import site
import stat
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gdp.host.single_instance import lock_directory
from gdp.nodes.audit import audit_folder
from gdp.nodes.credentials import NodeConfig, watched_folders
from gdp.ports.confine.capabilities import Capability
from gdp.ports.sandbox import Needs, confine

if TYPE_CHECKING:  # a node loads its own configuration alone
    from gdp.config.config import RibConfig, SwitchConfig
    from gdp.config.relay_config import RelayConfig, RelayServer
    from gdp.config.schema import Metrics

log = logging.getLogger(__name__)

_DEVICE: Final = frozenset({Capability.NET_RAW, Capability.NET_ADMIN})
_PROGRAMS: Final = frozenset({Capability.BPF, Capability.PERFMON})
_SYSTEM: Final = tuple(map(Path, ("/usr", "/lib", "/lib64", "/lib32", "/etc", "/proc", "/sys", "/dev", "/opt")))
_RESOLVER: Final = Path("/run/systemd/resolve")  # where /etc/resolv.conf may lead
_DEVICE_SETTINGS: Final = Path("/proc/sys/net/ipv6/conf")
_CHANGED: Final = (Path("/dev"),)  # null, and the terminal
_WRITABLE_BY_ALL: Final = stat.S_IWOTH


def confine_switch(config: SwitchConfig, plane: str) -> None:
    """Drop the rights that a switch does not need; ``plane``: the name of its data plane."""
    is_kernel = plane == "kernel"
    needs = Needs(
        capabilities=_DEVICE | (_PROGRAMS if is_kernel else frozenset()),
        reads=(),
        tcp_ports=_ports(config.metrics),
        spared_calls=frozenset({"bpf"} if is_kernel else ()),
    )
    again = (config.revocations, None if config.links is None else config.links.peers)
    folders = (config.state, _folder_of(config.control_socket), audit_folder(config.audit), *config.token_folders)
    _confine(config, needs, again, folders)


def confine_rib(config: RibConfig) -> None:
    """Drop the rights that a RIB does not need; one with a store in a cluster opens connections."""
    store = None if config.store == "memory" else config.store.cluster
    needs = (
        Needs(capabilities=_DEVICE, uses_open_programs=True)
        if store
        else Needs(capabilities=_DEVICE, uses_open_programs=True, reads=(), tcp_ports=_ports(config.metrics))
    )
    secrets = () if store is None else (store.password_file, store.ca, store.cert, store.key)
    sockets = map(_folder_of, (config.snapshot, config.control_socket))
    _confine(config, needs, secrets, (config.state, *sockets, audit_folder(config.audit), *config.token_folders))


def confine_relay(config: RelayConfig) -> None:
    """Drop the rights that a relay does not need; it listens on its port, or opens connections to borders."""
    needs = Needs(
        capabilities=frozenset({Capability.NET_ADMIN}),
        writes=(_DEVICE_SETTINGS,),
        reads=(_RESOLVER, *_given(_folder_of(config.switch_socket))),
        tcp_ports=None if config.borders else _ports(config.metrics, config.server),
    )
    _confine(config, needs, (config.revocations,), (_folder_of(config.control_socket),))


def confine_proxy(
    config: NodeConfig, reads: Iterable[Path | None], writes: Iterable[Path | None], *, has_ros: bool
) -> None:
    """Drop the rights that a proxy does not need.

    Args:
        reads: paths that it reads again on SIGHUP.
        writes: folders of its recording and of its state.
        has_ros: whether it takes part in a graph. ROS middleware writes logs and shared memory, which it shares with
            nodes of other users: CAP_DAC_OVERRIDE is kept for that.
    """
    needs = Needs(
        capabilities=_DEVICE | ({Capability.DAC_OVERRIDE} if has_ros else frozenset()),
        writes=(Path(tempfile.gettempdir()), *(_ros_folders() if has_ros else ())),
        starts_programs=has_ros,
        uses_open_programs=True,
    )
    _confine(config, needs, reads, writes)


def _confine(config: NodeConfig, needs: Needs, reads: Iterable[Path | None], writes: Iterable[Path | None]) -> None:
    """Drop all rights but these, and those on files of the operator.

    Args:
        reads: what the node reads again, apart from its certificates; they may belong to another user.
        writes: folders that it changes; likewise.
    """
    again, kept = (*watched_folders(config.identity, config.domain), *_given(*reads)), _given(*writes)
    needs = replace(
        needs,
        capabilities=needs.capabilities | _past_owners(again, kept),
        writes=(*_CHANGED, lock_directory(), *needs.writes, *kept),
        reads=None if needs.reads is None else (*_code(), *needs.reads, *again),
    )
    log.info("rights %s", confine(needs).to_text())


def _given(*paths: Path | None) -> tuple[Path, ...]:
    return tuple(path for path in paths if path is not None)


def _ports(*sections: Metrics | RelayServer | None) -> tuple[int, ...]:
    return tuple(each.port for each in sections if each is not None)


def _past_owners(reads: Iterable[Path], writes: Iterable[Path]) -> frozenset[Capability]:
    """Return the capabilities that root needs to read or change files of another user."""
    kept = set()
    if os.geteuid() == 0:
        if any(_is_foreign(path) for path in reads):
            kept.add(Capability.DAC_READ_SEARCH)
        if any(_is_foreign(path) and not path.stat().st_mode & _WRITABLE_BY_ALL for path in writes):
            kept.add(Capability.DAC_OVERRIDE)
    return frozenset(kept)


def _folder_of(file: Path | None) -> Path | None:
    """Return the folder of a file that the node removes at its end."""
    return None if file is None else file.parent


def _is_foreign(path: Path) -> bool:
    """Return whether another user owns a folder or one of its parents."""
    try:
        return any(each.stat().st_uid != os.geteuid() for each in (path.absolute(), *path.absolute().parents))
    except OSError:
        return False


def _code() -> tuple[Path, ...]:
    """Return the folders from which Python loads further modules."""
    folders = {*sys.path, sys.prefix, sys.base_prefix, sys.exec_prefix, *site.getsitepackages()}
    folders -= {"", "/", str(Path.cwd()), str(Path.home())}  # users keep other files there
    own = Path(__file__).resolve().parents[1]
    return (*_SYSTEM, own, *map(Path, sorted(folders)))


def _ros_folders() -> list[Path]:
    """Return the folders of ROS logs; they must exist, because a rule needs an open folder."""
    home = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros")
    folders = [home, *(Path(given) for given in (os.environ.get("ROS_LOG_DIR"),) if given)]
    for folder in folders:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            log.warning("folder of ROS logs not made path=%s reason=%s", folder, error.strerror)
    return folders
