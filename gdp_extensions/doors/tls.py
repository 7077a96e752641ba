"""TLS of a door: the certificate that clients see, and the key that belongs to it.

I/O. The certificate is one of ``gdp cert door``, for the key of the door's node, or another with its own key.
"""

from __future__ import annotations

import ssl
from pathlib import Path

from gdp.crypto.identity import Identity
from gdp.crypto.keys import SoftwareKey
from gdp.errors import LocalError
from gdp.links.relay_context import load_own
from gdp.stores.files import read_private, read_public

_KEY = b"PRIVATE KEY-----"


class DoorTls:
    """TLS 1.3 of one door.

    Args:
        path: PEM with the certificate, and in front of it a private key where it is not the node's.

    Raises:
        LocalError: the file cannot be read, is not private although it has a key, or does not fit the key.
    """

    def __init__(self, path: Path, identity: Identity) -> None:
        self._path = path
        self._identity = identity
        self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self.context.minimum_version = ssl.TLSVersion.TLSv1_3
        self.read_certificate()

    def read_certificate(self) -> None:
        """Read the file, again after a renewal: the next connections see it."""
        pem, key = read_public(self._path), self._identity.key
        if _KEY in pem:
            pem = read_private(self._path)
        elif isinstance(key, SoftwareKey):
            pem += key.to_pem()
        else:
            raise LocalError(f"{self._path}: TLS cannot use the node's key in a token; put another key into the file")
        load_own(self.context, pem)
