"""Processes, namespaces, control groups and mounts of this host, and the registry of the runs that own them.

I/O. The registry removes what a killed run left behind.
"""
