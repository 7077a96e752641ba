"""Protocols of doors and what a door remembers of its clients. Sans-I/O."""
