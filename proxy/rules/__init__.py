"""Rules of ``proxy.yaml``: which names cross, which rule applies to a name, and conflicts between rules.

The modules are in ``proxy/config``: ``pattern`` and ``matching`` are sans-I/O; ``rule`` and ``graph`` are sections of a
file and read the files that it names.
"""
