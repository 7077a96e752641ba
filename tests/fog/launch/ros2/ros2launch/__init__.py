"""Stand-in for ``ros2launch`` 0.26.6."""
