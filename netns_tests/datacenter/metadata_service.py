"""Instance metadata service of a data centre, at 169.254.169.254: user data, identity, tags and interruption notices.

I/O. Source: EC2 user guide, "Instance metadata and user data". Version 2 needs a token, and the response to its request
has one hop to live. Version 1 is answered too, because cloud-init uses tokens only where SMBIOS names Amazon.
"""

from __future__ import annotations

import json
import re
import secrets
import socket
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import IPv4Address
from typing import Final

from lab.namespaces import Namespace
from netns_tests.datacenter.router import METADATA

_PORT: Final = 80
_PATH: Final = re.compile(r"/(?:latest|\d{4}-\d\d-\d\d)/(.*)")
_TOKEN: Final = "X-aws-ec2-metadata-token"


@dataclass(slots=True)
class InstanceDocument:
    """Metadata of one instance; ``tags``: returns the current tags."""

    instance: str
    region: str
    private: IPv4Address
    user_data: bytes
    tags: Callable[[], Mapping[str, str]]
    interrupted_at: str = ""  # as in instance-action; empty: no notice
    answered: list[str] = field(default_factory=list)

    def tree(self) -> dict[str, bytes]:
        """Return path -> content."""
        document = {"instanceId": self.instance, "region": self.region, "privateIp": str(self.private)}
        texts = {
            "meta-data/instance-id": self.instance,
            "meta-data/local-hostname": f"ip-{str(self.private).replace('.', '-')}",
            "meta-data/hostname": f"ip-{str(self.private).replace('.', '-')}",
            "meta-data/local-ipv4": str(self.private),
            "meta-data/ami-launch-index": "0",
            "meta-data/placement/availability-zone": f"{self.region}a",
            "meta-data/placement/region": self.region,
            "dynamic/instance-identity/document": json.dumps(document),
        }
        texts |= {f"meta-data/tags/instance/{key}": value for key, value in self.tags().items()}
        if self.interrupted_at:
            action = {"action": "terminate", "time": self.interrupted_at}
            texts["meta-data/spot/instance-action"] = json.dumps(action)
        return {**{path: text.encode() for path, text in texts.items()}, "user-data": self.user_data}


class MetadataService:
    """Service in the router's namespace; ``find``: address of a machine -> its document, None: unknown."""

    def __init__(self, namespace: Namespace, find: Callable[[IPv4Address], InstanceDocument | None]) -> None:
        handler = type("Handler", (_Handler,), {"find": staticmethod(find), "tokens": set()})
        self._server = namespace.inside(lambda: ThreadingHTTPServer((str(METADATA), _PORT), handler))
        self._server.daemon_threads = True
        self._server.socket.setsockopt(socket.IPPROTO_IP, socket.IP_TTL, 1)  # HttpPutResponseHopLimit of RunInstances
        self._thread = threading.Thread(target=self._server.serve_forever, name="metadata", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    find: Callable[[IPv4Address], InstanceDocument | None]
    tokens: set[str]

    def do_PUT(self) -> None:
        if self.path != "/latest/api/token":
            self._send(HTTPStatus.NOT_FOUND, b"")
            return
        token = secrets.token_hex()
        self.tokens.add(token)
        self._send(HTTPStatus.OK, token.encode())

    def do_GET(self) -> None:
        document = self.find(IPv4Address(self.client_address[0]))
        match = _PATH.fullmatch(self.path)
        given = self.headers.get(_TOKEN)
        if given is not None and given not in self.tokens:
            self._send(HTTPStatus.UNAUTHORIZED, b"")
        elif document is None or match is None:
            self._send(HTTPStatus.NOT_FOUND, b"")
        else:
            document.answered.append(match[1])
            content = _content(document.tree(), match[1])
            self._send(HTTPStatus.NOT_FOUND if content is None else HTTPStatus.OK, content or b"")

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # the library's name
        """Print nothing."""

    def _send(self, status: HTTPStatus, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)


def _content(tree: Mapping[str, bytes], path: str) -> bytes | None:
    """Return a leaf, or the listing of a folder; None: there is neither."""
    leaf = path.rstrip("/")
    if leaf in tree:
        return tree[leaf]
    below = leaf + "/" if leaf else ""
    rest = [each.removeprefix(below) for each in tree if each.startswith(below)]
    names = dict.fromkeys(f"{each.partition('/')[0]}/" if "/" in each else each for each in rest)
    return "\n".join(names).encode() if names else None
