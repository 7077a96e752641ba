"""HTTPS server that sends a site's software to its machines.

I/O, one folder of the site's state, private::

    software.json      key of URLs, TLS key and certificate
    workspace/         archives of the workspace, by content

A machine's URL is ``/EXPIRY.MAC/SHA256``: it names no path, expires, and works without a record, also after a restart
of the supervisor. Each file can be fetched a few times with one URL. The certificate is self-signed. User data has it,
so machines trust this one and no other.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
import socket
import ssl
import tempfile
from collections import Counter
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from fog.software.config import SoftwareConfig
from fog.software.offer import Offered, offered, remove_unused_archives, signature
from gdp.http_server import Answer, HttpServer
from gdp.intervals import SERVER_S
from gdp.stores.files import private, read_private, write_all

SOFTWARE_FILE: Final = "software.json"  # on the machine, too: what ``fetch`` reads
_FETCHES_MAX: Final = 8  # of one file with one URL; a machine repeats a download that was cut
_CONNECTIONS_MAX: Final = 32
_KEY_BYTES: Final = 32
_VALID: Final = timedelta(days=3_650)
_NOT_FOUND: Final = Answer("404 Not Found")


class SoftwareServer:
    """Server of a site's software.

    Args:
        folder: of its keys and the archive; private.
        url: how machines reach it, such as ``https://198.51.100.7:4781``.
        now: Unix time.

    Raises:
        LocalError: the software cannot be read, or other users can access the folder.
    """

    def __init__(
        self, listening: socket.socket, folder: Path, config: SoftwareConfig, url: str, now: Callable[[], float]
    ) -> None:
        if not (folder / SOFTWARE_FILE).exists():
            write_all(folder, {SOFTWARE_FILE: private(_new_keys())})
        kept = json.loads(read_private(folder / SOFTWARE_FILE))
        self._key = bytes.fromhex(kept["url_key"])
        self._certificate: str = kept["certificate"]
        self._folder = folder
        self._config = config
        self._url = url
        self._now = now
        remove_unused_archives(config, folder)
        self._signature = signature(config)
        self._offered = offered(config, folder)
        self._files: dict[str, Path | bytes] = {}
        self._publish(self._offered)
        self._fetches: Counter[tuple[str, str]] = Counter()
        self._server = HttpServer(
            listening,
            self._find,
            name="software",
            connections=_CONNECTIONS_MAX,
            timeout_s=SERVER_S,
            tls=_tls(kept),
            is_for_downloads=True,
        )

    def bundle_file(self, lifetime_s: float) -> dict[str, bytes]:
        """Return the file for a new machine's bundle that leads ``fetch`` to the software; its URL expires."""
        if (now := signature(self._config)) != self._signature:
            self._signature, self._offered = now, offered(self._config, self._folder)
            self._publish(self._offered)
        expiry = f"{int(self._now() + lifetime_s):x}-{secrets.token_hex(8)}"
        described = {
            "url": f"{self._url}/{expiry}.{self._mac(expiry)}",
            "certificate": self._certificate,
            "manifest": self._offered.digest,
        }
        return {SOFTWARE_FILE: json.dumps(described, indent=1).encode()}

    def close(self) -> None:
        """Stop serving; downloads in progress end."""
        self._server.close()

    def _publish(self, more: Offered) -> None:
        self._files |= {**more.files, more.digest: more.manifest}

    def _mac(self, expiry: str) -> str:
        return hmac.new(self._key, expiry.encode(), hashlib.sha256).hexdigest()[:32]

    def _find(self, path: str) -> Answer:
        """Return the file or content of a URL's path, unless there is none, or the URL has expired or is used up."""
        _, _, rest = path.partition("/")
        capability, _, digest = rest.partition("/")
        expiry, _, mac = capability.partition(".")
        if not hmac.compare_digest(mac.encode(), self._mac(expiry).encode()):
            return _NOT_FOUND
        if int(expiry.partition("-")[0], 16) < self._now():
            return _NOT_FOUND
        found = self._files.get(digest)
        if found is None:
            return _NOT_FOUND
        self._fetches[capability, digest] += 1
        return _NOT_FOUND if self._fetches[capability, digest] > _FETCHES_MAX else Answer("200 OK", found)


def _new_keys() -> bytes:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "fog software")])
    now = datetime.now(timezone.utc)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + _VALID)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    private_pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return json.dumps(
        {
            "url_key": secrets.token_hex(_KEY_BYTES),
            "tls_key": private_pem.decode(),
            "certificate": certificate.public_bytes(serialization.Encoding.PEM).decode(),
        }
    ).encode()


def _tls(kept: dict[str, str]) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    with tempfile.NamedTemporaryFile("w", suffix=".pem") as both:  # mode 0600; ssl reads files only
        both.write(kept["tls_key"] + kept["certificate"])
        both.flush()
        context.load_cert_chain(both.name)
    return context
