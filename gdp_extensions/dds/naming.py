"""Naming conventions of ROS 2 in DDS: names, types and hashes.

Sans-I/O.
Source: the ROS 2 design article on topic and service names; REP-2016 for ``typehash=`` in user data; rmw_cyclonedds for
``clientid=`` and ``serviceid=``.
"""

from __future__ import annotations

import re
from typing import Final, NamedTuple

from proxy.endpoints.core.endpoint import Role

CYCLONE: Final = b"\x01\x10"
_VENDORS: Final = {CYCLONE: "Cyclone DDS", b"\x01\x0f": "Fast DDS", b"\x01\x01": "RTI Connext"}
_HASH: Final = re.compile(rb"(?:^|;)typehash=(RIHS01_[0-9a-f]{64});")
_IDENTITY: Final = re.compile(rb"(?:^|;)(?:clientid|serviceid)=([0-9.]+);")
_REQUEST, _REPLY = "Request", "Reply"


class Named(NamedTuple):
    """ROS name, type and role of a DDS reader or writer."""

    role: Role
    name: str
    type_name: str


def named(topic: str, type_name: str, *, is_writer: bool) -> Named | None:
    """Return the ROS identity of a reader or writer, None where ROS does not show it (replies, what is not ROS)."""
    ros_type = _ros_type(type_name)
    prefix, slash, rest = topic.partition("/")
    if not slash or not ros_type:
        return None
    if prefix == "rt":
        return Named(Role.PUBLISHES if is_writer else Role.SUBSCRIBES, f"/{rest}", ros_type)
    if prefix == "rq" and rest.endswith(_REQUEST) and ros_type.endswith(f"_{_REQUEST}"):
        role = Role.CALLS if is_writer else Role.SERVES
        return Named(role, f"/{rest.removesuffix(_REQUEST)}", ros_type.removesuffix(f"_{_REQUEST}"))
    return None


def dds_type(ros_type: str) -> str:
    """Return ``std_msgs::msg::dds_::String_`` for ``std_msgs/msg/String``."""
    namespace, _, name = ros_type.rpartition("/")
    return f"{namespace.replace('/', '::')}::dds_::{name}_"


def _ros_type(type_name: str) -> str:
    namespace, infix, name = type_name.partition("::dds_::")
    return f"{namespace.replace('::', '/')}/{name[:-1]}" if infix and name.endswith("_") else ""


def vendor(gid: bytes) -> str:
    """Return the DDS vendor of an entity, from the first two bytes of its GUID."""
    return _VENDORS.get(gid[:2], f"vendor {gid[:2].hex()}")


def user_data(type_hash: str, *identities: bytes) -> bytes:
    """Return the user data of a reader or writer."""
    hashed = f"typehash={type_hash};".encode() if type_hash else b""
    return b"".join((*identities, hashed))


def identity(kind: str, gid: bytes, number: int) -> bytes:
    """Return ``clientid=1.16.…;``, by which the two halves of a client or server find each other."""
    of = gid[:12] + number.to_bytes(4, "big")
    return f"{kind}={'.'.join(str(byte) for byte in of)};".encode()


def hash_in(data: bytes) -> str:
    """Return the type hash in user data, empty where there is none."""
    found = _HASH.search(data)
    return found[1].decode() if found else ""


def identity_in(data: bytes) -> bytes:
    """Return the client's or server's identity in user data, empty where there is none."""
    found = _IDENTITY.search(data)
    return found[1] if found else b""
