"""Packet filter that keeps frames from outside out of the VXLAN devices of tunnels.

I/O. The kernel binds the socket of a VXLAN device to no address and to no device. So any host that reaches an IPv6
address of this one could send frames into a tunnel's device, past WireGuard. This filter drops packets to the port of
VXLAN unless they come from a WireGuard device of a switch. It belongs to a netlink socket (``NFT_TABLE_F_OWNER``, Linux
5.12): the kernel removes it with the socket, however the process ends. It needs CAP_NET_ADMIN only when it is made.

Source: ``include/uapi/linux/netfilter/nf_tables.h``, ``nfnetlink.h``; numbers in attributes are in network byte order.
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterable, Sequence
from typing import Final

from gdp.errors import LocalError
from gdp.ports.netlink import READ_BYTES, attribute, messages

__all__ = ["OutsideFilter"]

_NETLINK_NETFILTER: Final = 12
_HEADER: Final = struct.Struct("=IHHII")
_FAMILY: Final = struct.Struct("!BBH")  # struct nfgenmsg: family, version, resource
_NFPROTO_IPV6: Final = 10
_NFTABLES: Final = 10
_BATCH_BEGIN, _BATCH_END = 0x10, 0x11
_NEW_TABLE, _NEW_CHAIN, _NEW_RULE = (_NFTABLES << 8 | number for number in (0, 3, 6))
_REQUEST, _ACK, _CREATE, _APPEND = 0x1, 0x4, 0x400, 0x800
_ERROR: Final = 2
_NESTED: Final = 0x8000
_OWNER: Final = 0x2  # NFT_TABLE_F_OWNER
_LOCAL_IN: Final = 1
_FIRST: Final = -300  # priority of "raw"
_REGISTER: Final = 1
_L4PROTO, _IIFNAME = 16, 6
_EQUAL, _OTHER = 0, 1
_TRANSPORT: Final = 2
_CHAIN: Final = "outside"
_PATIENCE_S: Final = 5.0


class OutsideFilter:
    """The filter, until ``close``.

    Args:
        name: of its table, unique on this host.
        port: of VXLAN, UDP over IPv6.
        inside: beginnings of the names of the devices from which packets may come.

    Raises:
        LocalError: the kernel has no nf_tables, or refuses.
    """

    def __init__(self, name: str, port: int, inside: Sequence[str]) -> None:
        table, chain = name.encode() + b"\0", _CHAIN.encode() + b"\0"
        hook = attribute(1, _number(_LOCAL_IN)) + attribute(2, _number(_FIRST))
        steps = [*_is(_meta(_L4PROTO), _EQUAL, bytes([socket.IPPROTO_UDP]))]
        steps += _is(_destination_port(), _EQUAL, port.to_bytes(2, "big"))
        for each in inside:
            steps += _is(_meta(_IIFNAME), _OTHER, each.encode())
        steps.append(_drop())
        owned = attribute(1, table) + attribute(2, _number(_OWNER))
        hooked = attribute(1, table) + attribute(3, chain) + attribute(4 | _NESTED, hook) + attribute(7, b"filter\0")
        rule = attribute(1, table) + attribute(2, chain) + attribute(4 | _NESTED, b"".join(steps))
        try:
            self._socket = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _NETLINK_NETFILTER)
        except OSError as error:
            raise LocalError(f"packet filter: {error.strerror}") from error
        try:
            self._socket.settimeout(_PATIENCE_S)
            self._make([(_NEW_TABLE, 0, owned), (_NEW_CHAIN, 0, hooked), (_NEW_RULE, _APPEND, rule)])
        except OSError as error:
            self._socket.close()
            raise LocalError(f"packet filter: {error.strerror or error}") from error

    def close(self) -> None:
        """Remove the filter."""
        self._socket.close()

    def _make(self, parts: Iterable[tuple[int, int, bytes]]) -> None:
        """Send all parts as one transaction; raise ``OSError`` if the kernel refuses one."""
        batch = [_message(_BATCH_BEGIN, _REQUEST, 0, b"", _NFTABLES)]
        batch += [
            _message(kind, _REQUEST | _ACK | _CREATE | flags, number, body)
            for number, (kind, flags, body) in enumerate(parts, 1)
        ]
        batch.append(_message(_BATCH_END, _REQUEST, 0, b"", _NFTABLES))
        self._socket.send(b"".join(batch))
        waiting = len(batch) - 2
        while waiting:
            for kind, _, body in messages(self._socket.recv(READ_BYTES)):
                if kind == _ERROR:
                    (number,) = struct.unpack_from("=i", body)
                    if number:
                        raise OSError(-number, os.strerror(-number))
                    waiting -= 1


def _message(kind: int, flags: int, number: int, body: bytes, resource: int = 0) -> bytes:
    content = _FAMILY.pack(_NFPROTO_IPV6, 0, resource) + body
    return _HEADER.pack(_HEADER.size + len(content), kind, flags, number, 0) + content


def _number(value: int) -> bytes:
    return (value & 0xFFFFFFFF).to_bytes(4, "big")


def _step(name: str, content: bytes) -> bytes:
    """Return one expression of a rule."""
    return attribute(1 | _NESTED, attribute(1, name.encode() + b"\0") + attribute(2 | _NESTED, content))


def _meta(key: int) -> bytes:
    return _step("meta", attribute(1, _number(_REGISTER)) + attribute(2, _number(key)))


def _destination_port() -> bytes:
    values = (_REGISTER, _TRANSPORT, 2, 2)  # register, base, offset, length
    return _step("payload", b"".join(attribute(kind, _number(value)) for kind, value in enumerate(values, 1)))


def _is(load: bytes, comparison: int, value: bytes) -> list[bytes]:
    """Return the expressions that go on if what ``load`` loads begins with a value, or does not."""
    data = attribute(1, _number(_REGISTER)) + attribute(2, _number(comparison))
    return [load, _step("cmp", data + attribute(3 | _NESTED, attribute(1, value)))]


def _drop() -> bytes:
    verdict = attribute(2 | _NESTED, attribute(1, _number(0)))  # NFTA_DATA_VERDICT, NF_DROP
    return _step("immediate", attribute(1, _number(0)) + attribute(2 | _NESTED, verdict))
