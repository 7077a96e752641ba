"""ROS graph of the proxy: one of the ``ros`` entries of ``proxy.yaml``.

Section of a configuration file. Values that are not stated come from the environment, as in every ROS program.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import ClassVar, Final, Literal
from urllib.parse import urlsplit

from pydantic import Field, ValidationInfo, field_validator

from gdp.config.schema import Section
from gdp.errors import LocalError
from proxy.config.rule import DOMAIN_MAX, Rule
from proxy.serial.channel import RosVersion

DEFAULT_MASTER: Final = "http://localhost:11311"


class RosGraphConfig(Section):
    """Which graph, and through what."""

    renamed: ClassVar[Mapping[str, str]] = {"alone": "exclusive"}

    endpoint: Literal["ros2", "ros1", "dds"] = Field(description="`dds`: ROS 2 by Cyclone DDS, without ROS.")
    domain: int | None = Field(
        default=None, ge=0, le=DOMAIN_MAX, description="ROS 2 domain. `null`: ROS_DOMAIN_ID, else 0."
    )
    master: str | None = Field(
        default=None,
        description=f"URI of the ROS 1 master. `null`: ROS_MASTER_URI of the environment, else {DEFAULT_MASTER}.",
        json_schema_extra={"pattern": "^http://[^/]+:[0-9]+/?$"},
    )
    exclusive: bool = Field(
        default=False, description="No other proxy is in the graph: flows begin at once, not after two seconds."
    )

    @property
    def ros(self) -> RosVersion:
        """Return the ROS version."""
        return 1 if self.endpoint == "ros1" else 2

    @property
    def domain_id(self) -> int:
        """Return the ROS 2 domain. Raises ``LocalError``: the environment states an invalid one."""
        if self.domain is not None:
            return self.domain
        text = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not (text.isascii() and text.isdigit() and int(text) <= DOMAIN_MAX):
            raise LocalError(f"the environment's ROS_DOMAIN_ID is {text!r}, not a number from 0 to {DOMAIN_MAX}")
        return int(text)

    @property
    def master_uri(self) -> str:
        """Return the URI of the ROS 1 master."""
        return self.master or os.environ.get("ROS_MASTER_URI") or DEFAULT_MASTER

    @property
    def where(self) -> tuple[RosVersion, int | str]:
        """Return the identity of the graph; raises as ``domain_id``."""
        return (1, self.master_uri) if self.ros == 1 else (2, self.domain_id)

    def fits(self, rule: Rule) -> bool:
        """Return whether a rule may apply to this graph; raises as ``domain_id``."""
        return rule.ros in (None, self.ros) and (
            rule.domain is None or (self.ros == 2 and rule.domain == self.domain_id)
        )

    @field_validator("domain")
    @classmethod
    def _is_of_ros_2(cls, value: int | None, info: ValidationInfo) -> int | None:
        if info.data.get("endpoint") == "ros1" and value is not None:
            raise ValueError("ROS 1 has no domains; it has a master")
        return value

    @field_validator("master")
    @classmethod
    def _is_of_ros_1(cls, value: str | None, info: ValidationInfo) -> str | None:
        if value is None:
            return value
        if info.data.get("endpoint", "ros1") != "ros1":
            raise ValueError("ROS 2 has no master; it has a domain")
        if not _is_master(value):
            raise ValueError(f"expected a URI such as {DEFAULT_MASTER}")
        return value


def _is_master(text: str) -> bool:
    try:
        uri = urlsplit(text)
        return uri.scheme == "http" and bool(uri.hostname) and uri.port is not None and uri.path in ("", "/")
    except ValueError:  # an invalid port
        return False
