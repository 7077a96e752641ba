"""Demonstration across an internet: machines behind NATs join by tokens, and lose no message while networks change.

``traffic`` counts messages and calls, ``scenario`` makes networks and machines, is the sequence of events and shows it,
``cli`` is the command.
"""
