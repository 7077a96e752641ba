"""Verbs of the ``fog`` command."""

from gdp.extras import require_extra

require_extra("fog", ("numpy", "rich", "rosbags"), "fog")
