"""Diagnosis of one name: facts of nodes and of a host, an ordered table of causes, and the answer.

Layer: sans-I/O. ``gdp/cli/explain.py`` gathers the facts; ``diagnose`` answers with one sentence and one command.
"""
