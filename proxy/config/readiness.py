"""Readiness probe of a rule: whether the local server is ready for requests.

Section of a configuration file. Source of names and meanings: Kubernetes, "Configure Liveness, Readiness and Startup
Probes".
"""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import AfterValidator, Field, model_validator

from gdp.config.schema import Section
from gdp.intervals import HOUR_S
from gdp.ros_names import NAME_FORM, NAME_MAX_CHARS, TYPE_FORMS, fits_kind, is_name

THRESHOLD_MAX: Final = 1_000


def _local_name(text: str | None) -> str | None:
    if text is not None and not is_name(text):
        raise ValueError("expected a full ROS name, such as /plan/ready")
    return text


LocalName = Annotated[
    str | None,
    AfterValidator(_local_name),
    Field(json_schema_extra={"pattern": f"^{NAME_FORM}$", "maxLength": NAME_MAX_CHARS}),
]


class Readiness(Section):
    """Probe of one local server: a service that must succeed, or a topic that must tick."""

    service: LocalName = Field(default=None, description="Local std_srvs/srv/Trigger that must answer `success: true`.")
    topic: LocalName = Field(default=None, description="Or a local topic with a message in each period; needs `type`.")
    type_name: str = Field(default="", alias="type", description="Type of that topic.")
    period_s: float = Field(default=1.0, ge=0.05, le=HOUR_S, description="Seconds between two probes.")
    timeout_s: float = Field(default=1.0, gt=0, le=HOUR_S, description="Seconds that the service may take.")
    initial_delay_s: float = Field(
        default=0.0, ge=0, le=HOUR_S, description="Seconds from the server's appearance to the first probe."
    )
    failure_threshold: int = Field(
        default=3, ge=1, le=THRESHOLD_MAX, description="Failures in a row after which it is not ready."
    )
    success_threshold: int = Field(
        default=1, ge=1, le=THRESHOLD_MAX, description="Successes in a row after which it is ready."
    )

    @model_validator(mode="after")
    def _holds_together(self) -> Readiness:
        if (self.service is None) == (self.topic is None):
            raise ValueError("expected either service or topic")
        if self.topic is not None and not fits_kind(self.type_name, "topic"):
            raise ValueError(f"topic needs a type as ROS 2 writes it, such as {TYPE_FORMS['topic'][1]}")
        if self.service is not None and self.type_name:
            raise ValueError("type is for topic; the service is a std_srvs/srv/Trigger")
        return self
