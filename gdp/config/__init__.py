"""Configuration files of a node or a machine: every key, its bounds and its default, and errors with their position.

I/O: it reads files.
"""
