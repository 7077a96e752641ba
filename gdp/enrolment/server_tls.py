"""TLS of the enrolment server: its key, the certificate that the domain's root issues to it, and the context.

I/O; reads the root's private key. The key pair lies in the server's private folder, as OpenSSL reads it from files.
"""

from __future__ import annotations

import ssl
from pathlib import Path
from typing import Final, NamedTuple

from gdp.crypto.keys import SigningKey
from gdp.crypto.server_certificate import channel_binding, issue_server_certificate
from gdp.crypto.validity import Validity
from gdp.crypto.x509_profile import to_pem
from gdp.errors import LocalError
from gdp.intervals import DAY_S
from gdp.stores.files import ignore_folder, private, write_all
from gdp.stores.keyring import load_domain

CERTIFICATE_DAYS: Final = 30.0  # the server issues another one at each start, and each day
_FILE: Final = "tls.pem"


class ServerTls(NamedTuple):
    """A context of the server, and the channel binding of its connections (RFC 5929, section 4)."""

    context: ssl.SSLContext
    binding: bytes


def make_server_tls(domain: Path, state: Path, unix_s: float) -> ServerTls:
    """Make a key pair of the server, TLS 1.3 only; the earlier one is replaced.

    Raises:
        LocalError: the root's key cannot be read, the root has expired, or the folder cannot be written.
    """
    authority, key = load_domain(domain), SigningKey.generate()
    end = min(unix_s + CERTIFICATE_DAYS * DAY_S, authority.root.validity.not_after_unix_s)
    if end <= unix_s:
        raise LocalError("the root of the domain has expired")
    certificate = issue_server_certificate(authority, key.public, Validity(int(unix_s), int(end)))
    write_all(state, {_FILE: private(key.to_pem() + to_pem(certificate))}, force=True)
    ignore_folder(state)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.num_tickets = 0  # no resumption: each connection shows the certificate
    try:
        context.load_cert_chain(state / _FILE)
    except (ssl.SSLError, OSError) as error:
        raise LocalError(f"{state / _FILE}: cannot be read back: {error.strerror or error}") from error
    return ServerTls(context, channel_binding(certificate))
