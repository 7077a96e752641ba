"""Status topic of a proxy: where local nodes read which parties its names have.

Section of a configuration file.
"""

from __future__ import annotations

from pydantic import Field, field_validator

from gdp.config.schema import Section
from gdp.intervals import DAY_S
from gdp.ros_names import NAME_FORM, NAME_MAX_CHARS, is_name


class StatusTopicConfig(Section):
    """A latched ``std_msgs/msg/String`` in each graph."""

    topic: str = Field(
        default="/gdp_status",
        description="Local std_msgs/msg/String, JSON.",
        json_schema_extra={"pattern": f"^{NAME_FORM}$", "maxLength": NAME_MAX_CHARS},
    )
    deadline_s: float | None = Field(
        default=None,
        gt=0,
        le=DAY_S,
        description="Seconds without a message after which a publisher is silent.",
    )

    @field_validator("topic")
    @classmethod
    def _topic(cls, text: str) -> str:
        if not is_name(text):
            raise ValueError("expected a full ROS name, such as /gdp_status")
        return text
