"""Rules and delegations by which a robot's proxy uses a cluster.

I/O; writes drop-in files and delegations, and makes running nodes reload through their control sockets.
``proxy.yaml`` never changes. The rules of a cluster are the file ``fog-CLUSTER.yaml`` of the drop-in directory
(``proxy.config.drop_ins``), which ``remove_rules`` removes. A rule that the proxy already has is not written again. The
file is private (0600) if ``proxy.yaml`` is, or if a rule contains a name's salt.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fog.bootstrap.bundles import robot_rule
from fog.bootstrap.members import Authority, metadata_of
from fog.cluster import ExportedInterface
from gdp.config.drop_in import drop_in_directory, locked, read_drop_in, write_drop_in
from gdp.errors import GdpError, LocalError
from gdp.intervals import RELOAD_S
from gdp.management.control_client import NotRunningError, ask_node, find_control_socket
from gdp.state.control_protocol import Command
from gdp.stores.keyring import load_public_key
from proxy.config import matching
from proxy.config.config import ProxyConfig

log = logging.getLogger(__name__)

_HEAD: Final = "# Rules of cluster {cluster}; fog writes this file, and removes it with the cluster.\nimport:\n"


def add_rules(
    path: Path, authority: Authority, cluster: str, carried: Sequence[ExportedInterface], *, days: float
) -> None:
    """Add rules and delegations with which a robot's proxy uses a cluster; the proxy need not run.

    Raises:
        ConfigError: the file is not a proxy configuration, or a new rule conflicts with an existing one.
        LocalError: keys are missing, or the drop-in cannot be written.
    """
    key = load_public_key(authority.owner_key).compressed
    with locked(path):
        config = ProxyConfig.load(path)
        lacking = [
            each
            for each in carried
            if matching.imported(config.imports, metadata_of(each).name(key), metadata_of(each)) is None
        ]
        if lacking:
            _add_rules(path, authority, cluster, lacking, config.prefix)
        authority.grant_access(config.identity, config.delegations, carried, days=days)


def remove_rules(path: Path, cluster: str) -> bool:
    """Remove the drop-in file of a cluster; return whether there was one."""
    file = _drop_in(path, cluster)
    with locked(path):
        try:
            file.unlink()
        except FileNotFoundError:
            return False
        except OSError as error:
            raise LocalError(f"{file}: {error.strerror}") from error
    return True


def control_socket_of(identity: Path, configured: Path | None) -> Path:
    """Return the control socket of a node of this host.

    Raises:
        LocalError: the directory does not belong to a node.
    """
    return configured or find_control_socket(identity)


def reload(identity: Path, configured: Path | None = None) -> bool:
    """Reload the configuration of a node of this host, if it runs; return whether it did.

    A node that rejects it keeps its old configuration; the reason is logged.
    """
    try:
        answer = ask_node(control_socket_of(identity, configured), Command.RELOAD, RELOAD_S)
    except NotRunningError:
        return False
    except GdpError as error:
        log.warning("node not reloaded identity=%s reason=%s", identity, error)
        return False
    if not answer.is_ok:
        log.warning("node not reloaded identity=%s reason=%s", identity, answer.error)
    return answer.is_ok


def reload_proxy(path: Path) -> bool:
    """Make the proxy of this ``proxy.yaml`` reload it, if it runs; return whether it did.

    Raises:
        ConfigError: the file is not a proxy configuration.
    """
    config = ProxyConfig.load(path)
    return reload(config.identity, config.control_socket)


def _drop_in(path: Path, cluster: str) -> Path:
    return drop_in_directory(path) / f"fog-{cluster}.yaml"


def _add_rules(
    path: Path, authority: Authority, cluster: str, carried: Sequence[ExportedInterface], prefix: str | None
) -> None:
    """Append rules to the drop-in file of a cluster; restore it if the proxy does not accept the result."""
    file = _drop_in(path, cluster)
    before = read_drop_in(file)
    owner = os.path.relpath(authority.owner_key, file.parent)
    own = {"prefix": ""} if prefix else {}  # a cluster's names are those of all robots
    lines = [f"- {json.dumps({**robot_rule(each), **own, 'owner': owner})}\n" for each in carried]
    write_drop_in(path, file.name, (before or _HEAD.format(cluster=cluster)) + "".join(lines))
    try:
        ProxyConfig.load(path)
    except Exception:
        write_drop_in(path, file.name, before)
        raise
