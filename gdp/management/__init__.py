"""Management plane of a machine: the control sockets of running nodes and their clients.

I/O. Source: RFC 7426, section 3.4.
"""
