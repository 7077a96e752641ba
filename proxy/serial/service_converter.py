"""Converter of a service between ROS 1 and ROS 2: its description in the other ROS, its requests and responses.

Sans-I/O. Errors are those of ``converter``, for either half.
Source: ``genmsg.gentools`` (md5 of a service: over the md5 texts of request and response, one after the other);
``rosidl_generator_type_description`` (RIHS01 of a service: a structure of request, response and event).
"""

from __future__ import annotations

import hashlib
from typing import Final

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from proxy.serial.channel import Channel, RosVersion, Service
from proxy.serial.converter import translated_channel
from proxy.serial.schema import msg_name
from proxy.serial.type_translation import md5_text, retyped, rihs01, types_of

_EVENT_INFO: Final = "service_msgs/msg/ServiceEventInfo"


def translated_service(service: Service, ros: RosVersion) -> Service:
    """Return the service in ROS ``ros``."""
    if service.ros == ros:
        return service
    converter = Service(
        service.name,
        service.type_name,
        "",
        translated_channel(service.request, ros),
        translated_channel(service.response, ros),
    )
    digest = _md5(converter) if ros == 1 else _rihs01(converter)
    return Service(converter.name, converter.type_name, digest, converter.request, converter.response)


def _md5(service: Service) -> str:
    texts = (md5_text(_name(half), types_of(half)) for half in (service.request, service.response))
    return hashlib.md5("".join(texts).encode(), usedforsecurity=False).hexdigest()


def _rihs01(service: Service) -> str:
    name, request, response = service.type_name, service.request.type_name, service.response.type_name
    types = retyped({_EVENT_INFO: get_typestore(Stores.ROS2_JAZZY).fielddefs[_EVENT_INFO]}, 2)
    for half in (service.request, service.response):
        parsed = types_of(half)
        types |= parsed | {half.type_name: parsed[_name(half)]}
    event = f"{name}_Event"
    types[event] = (
        [],
        [
            ("info", (Nodetype.NAME, _EVENT_INFO)),
            ("request", (Nodetype.SEQUENCE, ((Nodetype.NAME, request), 1))),
            ("response", (Nodetype.SEQUENCE, ((Nodetype.NAME, response), 1))),
        ],
    )
    types[name] = (
        [],
        [
            ("request_message", (Nodetype.NAME, request)),
            ("response_message", (Nodetype.NAME, response)),
            ("event_message", (Nodetype.NAME, event)),
        ],
    )
    return rihs01(name, types)


def _name(half: Channel) -> str:
    return msg_name(half.type_name, half.definition_format)
