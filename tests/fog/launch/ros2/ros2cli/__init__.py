"""Stand-in for ``ros2cli``; ``ENTRY_POINTS`` is what installed distributions would name: group -> name -> object."""

ENTRY_POINTS = {}
