"""Standard definitions for recordings without any: rosbag2 stored them only from Iron on.

Sans-I/O. The types are those of Humble, the last distribution whose recordings lack them. A message that does not fit
travels opaque (see ``serializer``).
"""

from __future__ import annotations

from functools import cache

from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from proxy.serial.channel import DefinitionFormat

__all__ = ["standard_definition", "type_hash"]


@cache
def _humble() -> Typestore:
    return get_typestore(Stores.ROS2_HUMBLE)


def standard_definition(type_name: str) -> str | None:
    """Return the full ``msg`` text of a type that Humble ships, None for any other."""
    store = _humble()
    if type_name not in store.fielddefs:
        return None
    return store.generate_msgdef(type_name, ros_version=2)[0]


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
