"""Recordings: reading in a process without rights, writing, comparison, and an endpoint of the bridge."""
