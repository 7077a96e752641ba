"""Recordings: read by a process without rights, written, compared, and an endpoint of the bridge."""
