"""Baselines of ``messages.py``: systems that carry a message from A to B over three machines in a row.

``chain.py`` makes the machines, ``exchange.py`` is the measurement that all endpoints run. Each baseline has a
``*_net.py`` (its processes by machine) and a ``*_endpoint.py`` (the processes at A and at B).
"""
