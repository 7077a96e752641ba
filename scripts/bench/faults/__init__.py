"""Faults in an overlay of real processes and namespaces, shared by ``survive.py`` and ``chaos.py``.

Sans-I/O: ``plan`` (the nodes, also of a random network, and what must stay connected), ``schedule`` (faults in
time), ``accounts`` (evaluation of the records).

I/O: ``overlay`` (processes and links), ``link_faults`` (frames), ``clock`` (wall clocks), ``store`` (a
disk, and servers that RIBs share), ``member`` (the endpoint process), ``records`` (its record files).
"""
