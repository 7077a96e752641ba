"""Relay of frames through TLS, for networks that block UDP: framing, queue, admission and the connection's protocol.

Sans-I/O. ``gdp/nodes/relay.py`` gives it sockets, TAP devices and a clock.
"""
