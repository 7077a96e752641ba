"""State of a running node as its control socket states it: requests and responses, status, tables and snapshots.

Sans-I/O.
"""
