"""Section ``software:`` of ``fog.yaml``: what ``fog`` sends to rented machines, and where they fetch it.

Sans-I/O.
"""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import AfterValidator, Field

from fog.bootstrap.config import listening_place, reachable_place
from gdp.config.schema import Directory, Section

__all__ = ["SOFTWARE_PORT", "SoftwareConfig"]

SOFTWARE_PORT: Final = 4781
IGNORED: Final = (".git/", "__pycache__/", "*.pyc")


class SoftwareConfig(Section):
    """Section ``software:`` of ``fog.yaml``."""

    wheels: Directory | None = Field(
        default=None, description="Folder of wheels, as `fog wheels` fills it; each machine installs all."
    )
    workspace: Directory | None = Field(
        default=None, description="`install` folder of a colcon workspace; it comes to /opt/fog-workspace."
    )
    ignore: tuple[str, ...] = Field(
        default=IGNORED, description="What is left out of the workspace; its file `.fogignore` has more."
    )
    address: Annotated[str, AfterValidator(reachable_place)] | None = Field(
        default=None, description="`HOST:PORT` of the software server. `null`: the border's host, port 4781."
    )
    listen: Annotated[str, AfterValidator(listening_place)] | None = Field(
        default=None,
        description="`HOST:PORT` on which the supervisor listens. `null`: every address, port of `address`.",
    )

    @property
    def is_empty(self) -> bool:
        """Return whether nothing is sent."""
        return self.wheels is None and self.workspace is None
