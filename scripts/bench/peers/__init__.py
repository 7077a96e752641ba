"""The contenders of ``messages.py``: what carries a message from A to B over three machines in a row.

``chain.py`` lays the machines, ``exchange.py`` is the one measurement that all ends run, and of every contender there
is a ``*_net.py`` (which processes stand where) and a ``*_endpoint.py`` (what runs at A and at B).
"""
