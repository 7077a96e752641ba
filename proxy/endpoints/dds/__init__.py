"""A live ROS 2 graph through Cyclone DDS's Python binding: for machines without ROS.

``endpoint`` is what the proxy calls; ``watch`` is the thread that hears; ``node`` is our place in the graph; ``survey``
knows who else is there, ``discovery`` tells it; ``topics`` and ``services`` are the things that are opened;
``library``, ``opaque``, ``policies`` and ``profile`` are what they need of Cyclone; ``naming`` and ``node_info`` say
how ROS writes itself in DDS.
"""

from gdp.errors import LocalError

try:
    from proxy.endpoints.dds.endpoint import DdsEndpoint
except ModuleNotFoundError as error:
    if not (error.name or "").startswith("cyclonedds"):
        raise
    raise LocalError("endpoint dds needs Cyclone DDS's Python binding: pip install 'gdp-ros[dds]'") from error

__all__ = ["DdsEndpoint"]
