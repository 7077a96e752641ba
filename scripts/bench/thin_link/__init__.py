"""Thin link of the uplink bench: its emulation between two devices, its traffic, and the systems that share it.

``channel.py`` is one direction of the link, ``relay.py`` the process that applies it, ``line.py`` its owner in the
bench. ``traffic.py`` is what a robot and a cloud exchange; ``carriers.py`` carry it.
"""
