"""Types of a machine without ROS: those that every ROS 2 has.

Sans-I/O.
"""

from __future__ import annotations

from functools import lru_cache

from proxy.serial.channel import Channel
from proxy.serial.standard_types import standard_definition, type_hash

__all__ = ["hash_of", "known_channel"]


@lru_cache(maxsize=1024)
def known_channel(topic: str, type_name: str) -> Channel | None:
    """Return a topic of a standard type with its hash and definition, None for any other type."""
    text = standard_definition(type_name)
    if text is None:
        return None
    return Channel(topic, type_name, 2, hash=_hash(type_name, text), definition=text, definition_format="msg")


def hash_of(channel: Channel) -> str:
    """Return the ROS 2 type hash of a channel: its own, or that of its definition; empty where it cannot be derived."""
    if channel.hash.startswith("RIHS01_"):
        return channel.hash
    if channel.definition_format:
        return type_hash(channel.type_name, channel.definition, channel.definition_format)
    known = known_channel(channel.topic, channel.type_name)
    return known.hash if known is not None else ""


@lru_cache(maxsize=1024)
def _hash(type_name: str, text: str) -> str:
    return type_hash(type_name, text, "msg")
