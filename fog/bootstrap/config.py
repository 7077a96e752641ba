"""Section ``enrolment:`` of ``fog.yaml``.

Sans-I/O.
"""

from __future__ import annotations

from pydantic import Field

from gdp.config.schema import Section

__all__ = ["EnrolmentConfig"]


class EnrolmentConfig(Section):
    """Section ``enrolment:`` of ``fog.yaml``."""

    revoke_misused: bool = Field(
        default=True, description="Revoke and replace a machine whose token was used again with another key."
    )
