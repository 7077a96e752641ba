"""Demonstration across an internet: machines behind NATs join by tokens, and lose no message while networks change.

``stage`` makes networks and machines, ``traffic`` counts messages and calls, ``scenario`` is the sequence of events
and shows it, ``cli`` is the command.
"""
