"""Verbs of the ``fog`` command.

Their parts raise ``GdpError`` where a verb cannot go on; ``options.opened`` ends the command with its text.
"""

from gdp.extras import require_extra

require_extra("fog", ("numpy", "rich", "rosbags"), "fog")
