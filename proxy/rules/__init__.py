"""What crosses: the rules of ``proxy.yaml``, which of them holds for a name, and what may be wrong with them.

Place: ``pattern`` and ``choice`` are pure; ``rule`` and ``ros_end`` are sections of a file and read what it names.
"""
