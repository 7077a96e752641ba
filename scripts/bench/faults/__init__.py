"""Faults in an overlay of real processes and namespaces: what ``survive.py``, ``chaos.py`` and ``soak.py`` share.

Sans-I/O: ``plan`` (who there is), ``network`` (a random one), ``schedule`` (what fails when), ``oracle`` (what must
stay connected), ``accounts`` (what the records come to), ``slope`` (what grows).

I/O: ``overlay`` (processes and links), ``link_faults`` (frames), ``clock`` (wall clocks), ``disk``, ``store``
(servers that RIBs share), ``member`` (the process at the ends), ``records`` (what it writes down).
"""
