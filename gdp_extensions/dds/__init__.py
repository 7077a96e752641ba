"""DDS endpoint: a live ROS 2 graph through Cyclone DDS's Python binding, for machines without ROS.

``endpoint`` is the interface for the proxy. ``wait_thread`` receives. ``node`` is the proxy's DDS participant.
``discovery`` fills ``graph_cache`` with the other participants. ``topics`` and ``services`` are the entities that can
be opened. ``library``, ``opaque``, ``policies`` and ``profile`` wrap parts of Cyclone. ``naming`` and ``node_info``
implement ROS's conventions in DDS.
"""
