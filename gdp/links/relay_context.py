"""What all parts of a relay share: its identity, its policy, its loop, and TLS contexts that follow renewals.

I/O: the private key reaches the TLS library through a file in memory, never one on a disk.
"""

from __future__ import annotations

import contextlib
import logging
import os
import ssl
from dataclasses import dataclass, field
from pathlib import Path

from gdp.config.relay_config import RelayConfig
from gdp.crypto.identity import Identity
from gdp.crypto.keys import SoftwareKey
from gdp.crypto.statements import parse
from gdp.crypto.x509_profile import to_pem
from gdp.errors import LocalError, RemoteError
from gdp.links.relay_loop import RelayLoop
from gdp.ports.tap import relay_alias
from gdp.relay.connection import ConnectionSettings
from gdp.relay.tls_channel import ALPN
from gdp.sansio import Timestamps
from gdp.trust.domain import Policy
from gdp.trust.revocations import OPERATOR

log = logging.getLogger(__name__)

_NO_CHECK_TIME = 0x200000  # X509_V_FLAG_NO_CHECK_TIME: ``Policy`` checks it, with the project's tolerance of clocks
_PARTIAL_CHAIN = ssl.VERIFY_X509_PARTIAL_CHAIN  # a root that succeeds another is an anchor by itself


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


def tls_context(identity: Identity, policy: Policy, *, is_server: bool) -> ssl.SSLContext:
    """Return a context that presents the node's membership and requires one of a trusted domain.

    Raises:
        LocalError: the key is in a token, which the TLS library cannot use.
    """
    key = identity.key
    if not isinstance(key, SoftwareKey):
        raise LocalError("the relay needs a signing key in a file: TLS cannot use the key in a token")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if is_server else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.check_hostname = False  # the name in the certificate is the switch's; ``verified_border`` compares it
    context.verify_mode = ssl.CERT_REQUIRED
    context.verify_flags = ssl.VerifyFlags(_PARTIAL_CHAIN | _NO_CHECK_TIME)
    context.set_alpn_protocols([ALPN])
    context.options |= ssl.OP_NO_RENEGOTIATION | ssl.OP_NO_TICKET
    if is_server:
        context.num_tickets = 0  # no resumption: each connection verifies the certificate
    with contextlib.suppress(ssl.SSLError):  # clears an error that a token's library left in this thread's queue
        context.load_verify_locations(cadata=b"\0")
    for root in policy.roots.values():
        for each in root.lineage:
            context.load_verify_locations(cadata=each.wire)
    _load_own(context, to_pem(identity.membership) + key.to_pem())
    return context


def _load_own(context: ssl.SSLContext, pem: bytes) -> None:
    descriptor = os.memfd_create("gdp-relay", os.MFD_CLOEXEC)
    try:
        os.write(descriptor, pem)
        context.load_cert_chain(f"/proc/self/fd/{descriptor}")
    except ssl.SSLError as error:
        raise LocalError(f"the TLS library refuses the node's certificate: {error.reason or error}") from error
    finally:
        os.close(descriptor)
