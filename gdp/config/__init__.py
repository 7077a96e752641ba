"""Configuration files of a node or a machine: every key, its bounds and its default. I/O: it reads files."""
