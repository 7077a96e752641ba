"""Section ``software:`` of ``fog.yaml``: what ``fog`` sends to rented machines, and where they fetch it."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import AfterValidator, Field

from gdp.config.schema import Directory, Section
from gdp.errors import LocalError
from gdp.host_port import checked_host_port, split_host_port

SOFTWARE_PORT: Final = 4781
IGNORED: Final = (".git/", "__pycache__/", "*.pyc")


def listening_host_port(text: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT``; an empty host, or ``*``, becomes an empty one: every address.

    Raises:
        LocalError: the text has another form.
    """
    host, _, port = text.rpartition(":")
    if host in ("", "*"):
        return "", split_host_port(f"localhost:{port}")[1]
    return split_host_port(text)


def _listening(text: str) -> str:
    try:
        listening_host_port(text)
    except LocalError as error:
        raise ValueError(str(error)) from error
    return text


def _reachable(text: str) -> str:
    if text.startswith("*:"):
        raise ValueError(f"{text!r}: machines need an address to reach: expected HOST:PORT")
    return checked_host_port(text)


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
    address: Annotated[str, AfterValidator(_reachable)] | None = Field(
        default=None, description="`HOST:PORT` of the software server. `null`: the border's host, port 4781."
    )
    listen: Annotated[str, AfterValidator(_listening)] | None = Field(
        default=None,
        description="`HOST:PORT` on which the supervisor listens. `null`: every address, port of `address`.",
    )

    @property
    def is_empty(self) -> bool:
        """Return whether nothing is sent."""
        return self.wheels is None and self.workspace is None
