"""Management plane (RFC 7426) of a machine: the control sockets of running nodes and their clients. I/O."""
