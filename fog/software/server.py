"""HTTPS server that sends a site's software to its machines.

I/O, one folder of the site's state, private::

    software.json      key of URLs, TLS key and certificate
    workspace/         archives of the workspace, by content

A machine's URL is ``/EXPIRY.MAC/SHA256``: it names no path, expires, and works without a record, also after a restart
of the supervisor. Each file can be fetched a few times with one URL. The certificate is self-signed. User data has it,
so machines trust this one and no other.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import json
import logging
import secrets
import socket
import ssl
import tempfile
import threading
from collections import Counter, OrderedDict
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from fog.software.config import SoftwareConfig
from fog.software.offer import Offered, offered, remove_unused_archives, signature
from gdp.stores.files import private, read_private, write_all

__all__ = ["SOFTWARE_FILE", "SoftwareServer"]

log = logging.getLogger(__name__)

SOFTWARE_FILE: Final = "software.json"  # on the machine, too: what ``fetch`` reads
_FETCHES_MAX: Final = 8  # of one file with one URL; a machine repeats a download that was cut
_CONNECTIONS_MAX: Final = 32
_TIMEOUT_S: Final = 30.0
_YIELD_S: Final = 1.0  # for the end of a connection that gives way
_PIECE_BYTES: Final = 1 << 18
_KEY_BYTES: Final = 32
_VALID: Final = timedelta(days=3_650)


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
        self._lock = threading.Lock()
        self._server = _Server(listening, self._find, _tls(kept))
        self._thread = threading.Thread(target=self._server.serve_forever, name="software", daemon=True)
        self._thread.start()

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
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def _publish(self, more: Offered) -> None:
        self._files |= {**more.files, more.digest: more.manifest}

    def _mac(self, expiry: str) -> str:
        return hmac.new(self._key, expiry.encode(), hashlib.sha256).hexdigest()[:32]

    def _find(self, path: str) -> Path | bytes | None:
        """Return the file or the content of a URL's path; None: there is none, or the URL has expired or is used up."""
        _, _, rest = path.partition("/")
        capability, _, digest = rest.partition("/")
        expiry, _, mac = capability.partition(".")
        if not hmac.compare_digest(mac.encode(), self._mac(expiry).encode()):
            return None
        if int(expiry.partition("-")[0], 16) < self._now():
            return None
        found = self._files.get(digest)
        if found is None:
            return None
        with self._lock:
            self._fetches[capability, digest] += 1
            return None if self._fetches[capability, digest] > _FETCHES_MAX else found


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(
        self, listening: socket.socket, find: Callable[[str], Path | bytes | None], tls: ssl.SSLContext
    ) -> None:
        handler = type("Handler", (_Handler,), {"find": staticmethod(find), "set_idle": staticmethod(self.set_idle)})
        super().__init__(("", 0), handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listening
        self._tls = tls
        self._free = threading.BoundedSemaphore(_CONNECTIONS_MAX)
        self._idle: OrderedDict[socket.socket, None] = OrderedDict()  # without a valid URL yet, the oldest first
        self._lock = threading.Lock()

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a connection; its handshake follows in its thread."""
        request, client_address = super().get_request()
        request.settimeout(_TIMEOUT_S)
        return self._tls.wrap_socket(request, server_side=True, do_handshake_on_connect=False), client_address

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread; if too many are open, the oldest one without a valid URL gives way."""
        if not self._free.acquire(blocking=False):
            with self._lock:
                oldest = next(iter(self._idle), None)
                if oldest is not None:
                    del self._idle[oldest]
                    _interrupt(oldest)
            if oldest is None or not self._free.acquire(timeout=_YIELD_S):
                log.warning("software not sent to=%s reason=too many connections", client_address)
                self.shutdown_request(request)
                return
        self.set_idle(request, is_idle=True)
        super().process_request(request, client_address)

    def set_idle(self, connection: socket.socket, *, is_idle: bool) -> None:
        """Note whether a connection is one of a machine that fetches now; others give way to new ones."""
        with self._lock:
            self._idle.pop(connection, None)
            if is_idle:
                self._idle[connection] = None

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection until its end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.set_idle(request, is_idle=False)
            self._free.release()

    def finish_request(self, request: Any, client_address: Any) -> None:
        """Do the TLS handshake, in the connection's thread, and answer."""
        request.do_handshake()
        super().finish_request(request, client_address)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log why a connection ended; any host may connect and break off."""
        del request
        log.info("software connection ended from=%s", client_address, exc_info=log.isEnabledFor(logging.DEBUG))


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    find: Callable[[str], Path | bytes | None]
    set_idle: Callable[..., None]

    def do_GET(self) -> None:
        """Send a file."""
        found = self.find(self.path)
        if found is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.set_idle(self.connection, is_idle=False)
        try:
            self._send(found)
        finally:
            self.set_idle(self.connection, is_idle=True)

    def _send(self, found: Path | bytes) -> None:
        if isinstance(found, bytes):
            self._head(len(found))
            self.wfile.write(found)
            return
        with found.open("rb") as file:
            self._head(found.stat().st_size)
            while piece := file.read(_PIECE_BYTES):
                self.wfile.write(piece)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # the library's name
        """Log a request without its path, which is a capability."""
        del format
        log.debug("software request from=%s status=%s", self.client_address, args[1] if len(args) > 1 else "")

    def _head(self, size: int) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "application/octet-stream")
        self.send_header("Content-Length", str(size))
        self.end_headers()


def _interrupt(connection: socket.socket) -> None:
    """End what another thread does with a connection."""
    with contextlib.suppress(OSError):  # it has ended in the meantime
        socket.socket.shutdown(connection, socket.SHUT_RDWR)  # of the plain socket: TLS stays its thread's


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
