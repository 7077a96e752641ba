"""Types that doors and tools know: the standard messages of ROS 2 Jazzy. Sans-I/O.

Other types come with the definitions of their publishers and servers.
"""

from __future__ import annotations

from functools import cache

from rosbags.typesys import Stores, get_typestore

from gdp.errors import LocalError
from proxy.serial.channel import Channel

__all__ = ["known_channel"]


@cache
def known_channel(topic: str, type_name: str) -> Channel:
    """Return the description of a standard type.

    Raises:
        LocalError: it is not one.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    if type_name not in store.fielddefs:
        raise LocalError(f"{topic}: {type_name} is no standard type; the definition of its publisher is used")
    definition = store.generate_msgdef(type_name, ros_version=2)[0]
    return Channel(
        topic, type_name, 2, hash=store.hash_rihs01(type_name), definition=definition, definition_format="msg"
    )
