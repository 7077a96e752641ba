"""Stand-in for ``ros2cli`` 0.32.2; the entry points of installed packages supply commands and verbs."""
