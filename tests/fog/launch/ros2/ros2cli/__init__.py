"""Stand-in for ``ros2cli`` 0.32.2; commands and verbs are found by the entry points of what is installed."""
