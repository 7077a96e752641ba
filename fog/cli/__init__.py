"""Commands of ``fog``."""

from gdp.extras import require_extra

require_extra("fog", ("numpy", "rich", "rosbags"), "fog")
