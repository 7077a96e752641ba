"""Types: generated Python classes of interface names, and their descriptions as channels and services.

Imports the packages of the robot's ROS 2; no other I/O.
"""

from __future__ import annotations

import importlib
import re
import sys
from functools import lru_cache
from typing import Final

from gdp.errors import LocalError
from proxy.endpoints.definition import definition_of, interface_of, type_hash_of
from proxy.serial.channel import Channel, Service

_NAME: Final = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv|action)/(([A-Z][A-Za-z0-9]*)[A-Za-z0-9_]*)\Z")


def class_of(type_name: str) -> type:
    """Return the class of a message, a service, or a part of one (``std_srvs/srv/SetBool_Request``, the
    ``test_msgs/action/Fibonacci_SendGoal`` of an action, which is a service).

    Raises:
        LocalError: it is not installed; the text states what to install.
    """
    match = _NAME.match(type_name)
    if match is None:
        raise LocalError(f"{type_name!r} is not the name of a ROS 2 interface (package/msg/Name)")
    package, subpackage, name, outer = match.groups()
    try:
        # The generated module of the outer interface holds the classes of its parts, under their full names.
        module = sys.modules[getattr(importlib.import_module(f"{package}.{subpackage}"), outer).__module__]
        found = getattr(module, name)
    except (ImportError, AttributeError) as error:
        raise LocalError(
            f"{type_name} is not known to the ROS 2 of this machine: install the package {package} "
            f"(ros-<distribution>-{package.replace('_', '-')}) or source the workspace that has it"
        ) from error
    if not isinstance(found, type):
        raise LocalError(f"{type_name} is not an interface")
    return found


@lru_cache(maxsize=1024)
def channel_of(topic: str, type_name: str) -> Channel:
    """Return the local description of a topic's type, without any QoS."""
    interface = interface_of(type_name, class_of)
    text = definition_of(interface)
    return Channel(topic, type_name, 2, hash=type_hash_of(interface), definition=text, definition_format="msg")


@lru_cache(maxsize=1024)
def service_of(name: str, type_name: str) -> Service:
    """Return the local description of a service's type."""
    found = class_of(type_name)
    if not hasattr(found, "Request"):
        raise LocalError(f"{type_name} is not a service")
    # Before Iron services had no events, and interfaces no hashes.
    digest = type_hash_of(interface_of(type_name, class_of)) if hasattr(found, "Event") else ""
    request, response = (channel_of(name, f"{type_name}_{part}") for part in ("Request", "Response"))
    return Service(name, type_name, digest, request, response)
