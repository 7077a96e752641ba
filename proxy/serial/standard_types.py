"""Standard types: those that a ROS 2 distribution ships, where no other source describes them.

Sans-I/O. Recordings lack definitions before Iron: their types, and those of a machine without ROS, are Humble's. Doors
and tools know those of Jazzy. A message that does not fit travels opaque (see ``serializer``).
"""

from __future__ import annotations

from functools import cache, lru_cache

from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from gdp.errors import LocalError
from proxy.serial.channel import Channel, DefinitionFormat


@cache
def _store(distribution: Stores) -> Typestore:
    return get_typestore(distribution)


def standard_definition(type_name: str, distribution: Stores = Stores.ROS2_HUMBLE) -> str | None:
    """Return the full ``msg`` text of a type that a distribution ships, None for any other."""
    store = _store(distribution)
    if type_name not in store.fielddefs:
        return None
    return store.generate_msgdef(type_name, ros_version=2)[0]


@lru_cache(maxsize=1024)
def standard_channel(topic: str, type_name: str, distribution: Stores = Stores.ROS2_HUMBLE) -> Channel | None:
    """Return a topic of such a type with its hash and definition, None for any other type."""
    text = standard_definition(type_name, distribution)
    if text is None:
        return None
    digest = _store(distribution).hash_rihs01(type_name)
    return Channel(topic, type_name, 2, hash=digest, definition=text, definition_format="msg")


def known_channel(topic: str, type_name: str) -> Channel:
    """Return a topic of a type that Jazzy ships.

    Raises:
        LocalError: it is none; other types come with the definitions of their publishers and servers.
    """
    channel = standard_channel(topic, type_name, Stores.ROS2_JAZZY)
    if channel is None:
        raise LocalError(f"{topic}: {type_name} is no standard type; the definition of its publisher is used")
    return channel


def type_hash(type_name: str, definition: str, definition_format: DefinitionFormat) -> str:
    """Return the ROS 2 type hash (``RIHS01_...``) of a definition, empty where it has none."""
    store = get_typestore(Stores.EMPTY)
    try:
        if definition_format == "msg":
            store.fielddefs.update(get_types_from_msg(definition, type_name))
        elif definition_format == "idl":
            rule = "=" * 80 + "\n"
            for section in definition.split(rule):
                text = section.partition("\n")[2] if section.startswith("IDL: ") else section
                if text.strip():
                    store.fielddefs.update(get_types_from_idl(text))
        return store.hash_rihs01(type_name)
    except (TypesysError, KeyError, AssertionError, RecursionError):
        return ""
