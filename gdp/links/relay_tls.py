"""TLS contexts of a relay, from the identity and the policy of its node.

I/O: the private key reaches the TLS library through a file in memory, never one on a disk.
"""

from __future__ import annotations

import contextlib
import os
import ssl

from gdp.crypto.identity import Identity
from gdp.crypto.keys import SoftwareKey
from gdp.crypto.x509_profile import to_pem
from gdp.errors import LocalError
from gdp.relay.tls_channel import ALPN
from gdp.trust.domain import Policy

_NO_CHECK_TIME = 0x200000  # X509_V_FLAG_NO_CHECK_TIME: ``Policy`` checks it, with the project's tolerance of clocks
_PARTIAL_CHAIN = ssl.VERIFY_X509_PARTIAL_CHAIN  # a root that succeeds another is an anchor by itself


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
    load_own(context, to_pem(identity.membership) + key.to_pem())
    return context


def load_own(context: ssl.SSLContext, pem: bytes) -> None:
    """Load certificate and private key. Raises ``LocalError``: the TLS library refuses them."""
    descriptor = os.memfd_create("gdp-tls", os.MFD_CLOEXEC)
    try:
        os.write(descriptor, pem)
        context.load_cert_chain(f"/proc/self/fd/{descriptor}")
    except ssl.SSLError as error:
        raise LocalError(f"the TLS library refuses the node's certificate: {error.reason or error}") from error
    finally:
        os.close(descriptor)
