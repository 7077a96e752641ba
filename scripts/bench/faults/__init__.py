"""Faults in an overlay of real processes and namespaces, shared by ``survive.py`` and ``chaos.py``.

Sans-I/O: ``plan`` (the nodes, also of a random network), ``schedule`` (which fault happens when), ``oracle`` (what must
stay connected), ``accounts`` (evaluation of the records).

I/O: ``overlay`` (processes and links), ``link_faults`` (frames), ``clock`` (wall clocks), ``disk``, ``store``
(servers that RIBs share), ``member`` (the endpoint process), ``records`` (its record files).
"""
