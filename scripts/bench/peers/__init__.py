"""Baselines of ``messages.py``: systems that carry a message from A to B over three machines in a row.

``chain.py`` makes the machines, ``exchange.py`` is the measurement that all endpoints run. ``systems.py``
has the processes of each baseline by machine, the ``*_endpoint.py`` are those at A and at B.
"""
