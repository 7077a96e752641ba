"""Ring demonstration: five switches in namespaces, a recording sent through them and compared byte for byte.

I/O; it starts the project's commands as processes and parses their output.
"""
