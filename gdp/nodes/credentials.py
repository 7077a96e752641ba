"""Credentials of a running node: reload of its membership and trusted roots when their files change.

I/O; it polls files. The issuer replaces ``node.crt``, ``root.crt`` or a root of ``domain.trusts``. The node reloads
them within ``UPKEEP_S``, or at once on SIGHUP, and keeps its name and session. The node logs
credentials that are not valid, and keeps the present ones.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Final, Protocol

from gdp.config.schema import Domain
from gdp.crypto.certificates import Membership
from gdp.crypto.identity import Identity
from gdp.errors import LocalError
from gdp.intervals import DAY_S
from gdp.sansio import Timestamps
from gdp.stores.files import read_public
from gdp.stores.keyring import NODE_CERTIFICATE, ROOT_CERTIFICATE, load_root, parsed
from gdp.trust.domain import Policy

log = logging.getLogger(__name__)

_PUBLIC: Final = (".crt", ".pem", ".cer")
_SHARE: Final = 5  # 1/5: warn in the last fifth of a shorter validity
_NodeState = tuple[tuple[int, int, int] | None, ...]


class NodeConfig(Protocol):
    """Keys that the configuration of every node has."""

    @property
    def identity(self) -> Path:
        """Return the directory of its keys."""

    @property
    def domain(self) -> Domain:
        """Return its domain, and those that it trusts."""


class Credentials:
    """The credential files of one node.

    Args:
        identity, policy: objects to renew.
    """

    def __init__(self, directory: Path, domain: Domain, identity: Identity, policy: Policy) -> None:
        self._certificate, self._root = directory / NODE_CERTIFICATE, directory / ROOT_CERTIFICATE
        self._roots = (domain.root, *domain.trusts)
        self._identity = identity
        self._policy = policy
        self._seen = self._state()
        self._failed = ""
        self._warned: bytes = b""

    def reload_changed(self, now: Timestamps) -> None:
        """Reload what has changed since the last call, and warn of a membership that ends soon."""
        state = self._state()
        if state != self._seen:
            self._take_up(now.unix_s, state)
        self._warn(now.unix_s)

    def seconds_left(self, unix_s: float) -> float:
        """Return for how many seconds the membership is still valid; negative: it has expired."""
        return self._identity.member.not_after_unix_s - unix_s

    def _take_up(self, unix_s: float, state: _NodeState) -> None:
        """Reload files, which are replaced one by one.

        The call retries files that are not yet valid together, and logs the error the second time.
        """
        try:
            roots = [load_root(path) for path in self._roots]
            own = load_root(self._root)
            wire = read_public(self._certificate)
            member = parsed(self._certificate, lambda data: Membership.from_wire(data, own, unix_s), wire)
            self._policy.renew_roots(roots)
            before = self._identity.member
            self._identity.renew(member, own)
        except LocalError as error:
            if self._failed == str(error):
                log.error("credentials not renewed reason=%s", error)
                self._seen, self._failed = state, ""
            else:
                self._failed = str(error)
            return
        self._seen, self._failed = state, ""
        if member.fingerprint != before.fingerprint:
            until = member.not_after_unix_s
            log.info("membership renewed name=%s until_unix_s=%d", self._identity.name.short, until)
        for root in roots:
            log.info("root read again domain=%s successions=%d", root.label, len(root.predecessors))

    def _warn(self, unix_s: float) -> None:
        member = self._identity.member
        whole = member.not_after_unix_s - member.not_before_unix_s
        left_s = self.seconds_left(unix_s)
        if left_s <= min(7 * DAY_S, whole / _SHARE) and self._warned != member.fingerprint:
            self._warned = member.fingerprint
            log.warning("membership ends soon name=%s left_s=%d: run gdp cert renew", self._identity.name.short, left_s)

    def _state(self) -> _NodeState:
        return tuple(_stamp(path) for path in (self._certificate, self._root, *self._roots))


def watched_folders(directory: Path, domain: Domain) -> tuple[Path, ...]:
    """Return the paths that a node must be able to read again: folders, because a replaced file is another one.

    Apart from the node's own folder, these are folders that hold only certificates. A root that lies elsewhere, such as
    next to its domain's key, is read at the start, and again only if it was written in place.
    """
    roots = (domain.root, *domain.trusts)
    return tuple(dict.fromkeys([directory, *(path.parent if _is_public(path.parent) else path for path in roots)]))


def _is_public(folder: Path) -> bool:
    try:
        return all(each.suffix in _PUBLIC and each.is_file() for each in folder.iterdir())
    except OSError:
        return False


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """Return a value that changes when a file is replaced."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size
