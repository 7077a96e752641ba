"""Rights of each kind of node after its start, and the confinement to them.

I/O. A switch continues to open ports that come back and to remove its veth pairs (CAP_NET_RAW, CAP_NET_ADMIN). With the
kernel data plane it also loads and attaches its program there (CAP_BPF, CAP_PERFMON). A RIB or proxy opens its device
again when it comes back. A node reads the operator's folders again on SIGHUP, or when its certificates are replaced. If
another user owns these, as in a shell of sudo, the node keeps the capability to read or write past the owner, and
Landlock bounds it. A relay makes TAP devices while it runs (CAP_NET_ADMIN).
"""

from __future__ import annotations

import logging
import os
import site
import stat
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from gdp.config.config import ClusterConfig, RibConfig, SwitchConfig
from gdp.config.relay_config import RelayConfig
from gdp.host.single_instance import lock_directory
from gdp.nodes.audit import audit_folder
from gdp.nodes.credentials import watched_folders
from gdp.ports.sandbox import Capability, Needs, confine

__all__ = ["confine_proxy", "confine_relay", "confine_rib", "confine_switch"]

log = logging.getLogger(__name__)

_DEVICE: Final = frozenset({Capability.NET_RAW, Capability.NET_ADMIN})
_PROGRAMS: Final = frozenset({Capability.BPF, Capability.PERFMON})
_SYSTEM: Final = tuple(map(Path, ("/usr", "/lib", "/lib64", "/lib32", "/etc", "/proc", "/sys", "/dev", "/opt")))
_RESOLVER: Final = Path("/run/systemd/resolve")  # where /etc/resolv.conf may lead
_DEVICE_SETTINGS: Final = Path("/proc/sys/net/ipv6/conf")
_CHANGED: Final = (Path("/dev"),)  # null, and the terminal
_WRITABLE_BY_ALL: Final = stat.S_IWOTH


def confine_switch(config: SwitchConfig, plane: str) -> None:
    """Drop the rights that a switch does not need.

    Args:
        plane: the name of its data plane.
    """
    again = watched_folders(config.identity, config.domain)
    again += () if config.revocations is None else (config.revocations,)
    again += () if config.links is None or config.links.peers is None else (config.links.peers,)
    state = () if config.state is None else (config.state,)
    kept = (*state, *_folder_of(config.control_socket), *_audits(config.audit), *config.token_folders)
    is_kernel = plane == "kernel"
    _confine(
        Needs(
            capabilities=_DEVICE | (_PROGRAMS if is_kernel else frozenset()) | _past_owners(again, kept),
            writes=(*_CHANGED, lock_directory(), *kept),
            reads=(*_code(), *again),
            tcp_ports=() if config.metrics is None else (config.metrics.port,),
            spared_calls=frozenset({"bpf"} if is_kernel else ()),
        )
    )


def confine_rib(config: RibConfig) -> None:
    """Drop the rights that a RIB does not need."""
    is_shared = config.store != "memory"
    again = watched_folders(config.identity, config.domain)
    secrets = () if config.store == "memory" else _files_of(config.store.cluster)
    folders = (None if config.snapshot is None else config.snapshot.parent, config.state)
    snapshots = tuple(folder for folder in folders if folder is not None) + _folder_of(config.control_socket)
    kept = (*snapshots, *_audits(config.audit), *config.token_folders)
    ports = () if config.metrics is None else (config.metrics.port,)
    _confine(
        Needs(
            capabilities=_DEVICE | _past_owners((*again, *secrets), kept),
            writes=(*_CHANGED, lock_directory(), *kept),
            reads=None if is_shared else (*_code(), *again),
            tcp_ports=None if is_shared else ports,
        )
    )


def confine_relay(config: RelayConfig) -> None:
    """Drop the rights that a relay does not need; it listens on its port, or opens connections to borders."""
    again = watched_folders(config.identity, config.domain)
    again += () if config.revocations is None else (config.revocations,)
    kept = _folder_of(config.control_socket)
    ports = tuple(each.port for each in (config.metrics, config.server) if each is not None)
    _confine(
        Needs(
            capabilities=frozenset({Capability.NET_ADMIN}) | _past_owners(again, kept),
            writes=(*_CHANGED, _DEVICE_SETTINGS, lock_directory(), *kept),
            reads=(*_code(), _RESOLVER, *again, *_folder_of(config.switch_socket)),
            tcp_ports=None if config.borders else ports,
        )
    )


def confine_proxy(reads: Iterable[Path], writes: Iterable[Path], *, has_ros: bool) -> None:
    """Drop the rights that a proxy does not need.

    Args:
        reads: paths that it reads again on SIGHUP.
        writes: folders of its recording and of its state.
        has_ros: whether it takes part in a graph. ROS middleware writes logs and shared memory, which it shares with
            nodes of other users: CAP_DAC_OVERRIDE is kept for that.
    """
    written = tuple(writes)
    changed = [*_CHANGED, lock_directory(), Path(tempfile.gettempdir()), *written]
    kept = _DEVICE | _past_owners(reads, written)
    if has_ros:
        changed += _ros_folders()
        kept |= {Capability.DAC_OVERRIDE}
    _confine(Needs(capabilities=kept, writes=tuple(changed), starts_programs=has_ros))


def _confine(needs: Needs) -> None:
    log.info("rights %s", confine(needs).to_text())


def _past_owners(reads: Iterable[Path] = (), writes: Iterable[Path] = ()) -> frozenset[Capability]:
    """Return the capabilities that root needs to read or change files of another user."""
    kept = set()
    if os.geteuid() == 0:
        if any(_is_foreign(path) for path in reads):
            kept.add(Capability.DAC_READ_SEARCH)
        if any(_is_foreign(path) and not path.stat().st_mode & _WRITABLE_BY_ALL for path in writes):
            kept.add(Capability.DAC_OVERRIDE)
    return frozenset(kept)


def _audits(configured: Path | None) -> tuple[Path, ...]:
    folder = audit_folder(configured)
    return () if folder is None else (folder,)


def _folder_of(file: Path | None) -> tuple[Path, ...]:
    """Return the folder of a file that the node removes at its end."""
    return () if file is None else (file.parent,)


def _files_of(store: ClusterConfig) -> tuple[Path, ...]:
    return tuple(each for each in (store.password_file, store.ca, store.cert, store.key) if each is not None)


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
