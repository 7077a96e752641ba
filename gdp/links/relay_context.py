"""What all parts of a relay share: its identity, its policy, its loop, and TLS contexts that follow renewals."""

from __future__ import annotations

import logging
import ssl
from dataclasses import dataclass, field
from pathlib import Path

from gdp.config.relay_config import RelayConfig
from gdp.crypto.identity import Identity
from gdp.crypto.statements import parse
from gdp.errors import RemoteError
from gdp.links.relay_loop import RelayLoop
from gdp.links.relay_tls import tls_context
from gdp.ports.tap import relay_alias
from gdp.relay.connection import ConnectionSettings
from gdp.sansio import Timestamps
from gdp.trust.domain import Policy
from gdp.trust.revocations import OPERATOR

log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True)
class RelayContext:
    """Shared parts of one relay.

    Args:
        identity, policy: renewed in place by ``Credentials``.
    """

    config: RelayConfig
    identity: Identity
    policy: Policy
    loop: RelayLoop
    _made: dict[bool, tuple[tuple[bytes, ...], ssl.SSLContext]] = field(default_factory=dict)
    _read: dict[Path, tuple[int, int]] = field(default_factory=dict)

    @property
    def alias(self) -> str:
        """Return the text that marks devices of this relay."""
        return relay_alias(self.identity.name)

    def settings(self, rate: float | None) -> ConnectionSettings:
        """Return the settings of a new connection."""
        config = self.config
        return ConnectionSettings(
            mtu=config.mtu,
            keepalive_s=config.keepalive_ms / 1_000,
            dead_s=config.dead_ms / 1_000,
            queue_bytes=config.queue_bytes,
            rate=rate,
        )

    def tls(self, *, is_server: bool) -> ssl.SSLContext:
        """Return the context of a new connection, with the present membership and roots.

        Raises:
            LocalError: as for ``tls_context``.
        """
        state = (self.identity.membership, *(root.wire for root in self.policy.roots.values()))
        known = self._made.get(is_server)
        if known is None or known[0] != state:
            known = state, tls_context(self.identity, self.policy, is_server=is_server)
            self._made[is_server] = known
        return known[1]

    def load_revocations(self, at: Timestamps) -> None:
        """Take in new or changed files of the operator's folder; an invalid one is logged once."""
        folder = self.config.revocations
        if folder is None:
            return
        try:
            paths = sorted(folder.iterdir())
        except OSError as error:
            log.error("revocations not read folder=%s reason=%s", folder, error.strerror)
            return
        for path in paths:
            try:
                status = path.stat()
                stamp = status.st_ino, status.st_mtime_ns
                if self._read.get(path) == stamp:
                    continue
                self._read[path] = stamp
                self.policy.revoked.receive_revocation(parse(path.read_bytes()), OPERATOR, at, lambda _: False)
            except (OSError, RemoteError) as error:
                log.error("revocation not taken file=%s reason=%s", path, error)
