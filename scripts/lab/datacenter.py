"""Network of a data centre: a router with one-to-one NAT and the firewall of security groups, and a metadata service.

I/O; a network namespace of the run, reached from the namespace of the caller by a veth pair. Like EC2's internet
gateway, it gives each machine a public address; it admits what the machine's security groups admit, and replies.
::

    caller 198.51.100.1 ==== wan 198.51.100.2 [router] lan 10.77.0.1 ==== machines 10.77.0.10, ...
                                              169.254.169.254: metadata

The metadata are user data, identity, tags and interruption notices. Source: EC2 user guide, "Instance metadata and user
data". Version 2 needs a token, and the response to its request has one hop to live. Version 1 is answered too, because
cloud-init uses tokens only where SMBIOS names Amazon.
"""

from __future__ import annotations

import json
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import IPv4Address
from typing import Final

from gdp.host.run_registry import Run
from lab.machine import LabMachine
from lab.namespaces import IpNamespace, Namespace

CALLER: Final = IPv4Address("198.51.100.1")
METADATA: Final = IPv4Address("169.254.169.254")
_WAN: Final = IPv4Address("198.51.100.2")
_PUBLIC: Final = IPv4Address("198.51.100.0")
_LAN: Final = IPv4Address("10.77.0.1")
_PRIVATE: Final = IPv4Address("10.77.0.0")
_FIRST: Final = 10
_PORT: Final = 80
_PATH: Final = re.compile(r"/(?:latest|\d{4}-\d\d-\d\d)/(.*)")
_TOKEN: Final = "X-aws-ec2-metadata-token"
_RULES: Final = """
table ip cloud {
  map to_private { type ipv4_addr : ipv4_addr; }
  map to_public { type ipv4_addr : ipv4_addr; }
  set admitted { type ipv4_addr . inet_proto . inet_service . ipv4_addr; }
  chain in { type nat hook prerouting priority dstnat; iifname "wan" dnat to ip daddr map @to_private; }
  chain out { type nat hook postrouting priority srcnat; oifname "wan" snat to ip saddr map @to_public; }
  chain forward {
    type filter hook forward priority filter; policy drop;
    ct state established,related accept
    iifname "lan" accept
    ip daddr . meta l4proto . th dport . ip saddr @admitted accept
  }
}
"""


@dataclass(frozen=True, slots=True)
class Lease:
    """Addresses of a machine, and its network namespace."""

    namespace: Namespace
    private: IPv4Address
    public: IPv4Address

    @property
    def network_config(self) -> str:
        """Return cloud-init's network configuration of the machine; a data centre without DHCP states it."""
        return (
            "network:\n  version: 2\n  ethernets:\n    eth0:\n"
            f"      addresses: [{self.private}/16]\n      gateway4: {_LAN}\n"
        )


@dataclass(frozen=True, slots=True)
class Admitted:
    """What a security group admits: one port of a protocol from one address."""

    protocol: str
    port: int
    source: IPv4Address


class Router:
    """Router of a run; ``Run.end`` removes it. The caller's end of the link is the device ``device``."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._next = _FIRST
        self.namespace = IpNamespace(run, "router", forwards=True)
        self.device = f"wan{run.id}"
        link = ("type", "veth", "peer", "name", "wan", "netns", str(self.namespace.path))
        for words in (
            ("link", "add", self.device, *link),
            ("address", "add", f"{CALLER}/24", "dev", self.device),
            ("link", "set", self.device, "up"),
        ):
            LabMachine(run.directory).output("ip", *words)
        self.namespace.configure(
            [
                f"address add {_WAN}/24 dev wan",
                "link set wan up",
                f"address add {METADATA}/32 dev lo",
                "link add lan type bridge",
                f"address add {_LAN}/16 dev lan",
                "link set lan up",
            ]
        )
        self.namespace.nft(_RULES)

    def add(self, name: str, admitted: Iterable[Admitted] = ()) -> Lease:
        """Return the namespace and addresses of a new machine whose device ``eth0`` is up."""
        number, self._next = self._next, self._next + 1
        lease = Lease(Namespace(self._run, name), _PRIVATE + number, _PUBLIC + number)
        self.namespace.configure(
            [
                f"link add m{number} type veth peer name eth0 netns {lease.namespace.path}",
                f"link set m{number} master lan up",
                f"address add {lease.public}/32 dev wan",
            ]
        )
        rules = [
            f"add element ip cloud to_private {{ {lease.public} : {lease.private} }}",
            f"add element ip cloud to_public {{ {lease.private} : {lease.public} }}",
            *(
                f"add element ip cloud admitted {{ {lease.private} . {each.protocol} . {each.port} . {each.source} }}"
                for each in admitted
            ),
        ]
        self.namespace.nft("\n".join(rules))
        return lease


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
