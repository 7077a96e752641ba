"""Global Data Plane: 256-bit names, switched at layer 2, sealed end to end.

A program without ROS opens a session::

    import gdp

    with gdp.open("robot/proxy") as session:
        session.publisher("camera").put(b"...")

A listed name is imported when it is first used, so ``import gdp`` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gdp.errors import ConfigError, GdpError, LocalError, RemoteError
    from gdp.metadata import Metadata
    from gdp.names import Name
    from gdp.service.replication import Replication
    from gdp.session.aio import AsyncPublisher, AsyncServer, AsyncSession, AsyncSubscription
    from gdp.session.aio import open_session_async as open_async
    from gdp.session.protocol.errors import (
        AttachError,
        CallError,
        CallTimeoutError,
        ClosedError,
        DelegationError,
        NoServerError,
        SessionError,
        SessionTimeoutError,
    )
    from gdp.session.protocol.messages import DelegatedName, Message, Request, Response
    from gdp.session.session import Publisher, Server, Session, Subscription
    from gdp.session.session import open_session as open  # noqa: A004 (gdp.open is the library's entry)

    __version__: str

__all__ = [
    "AsyncPublisher",
    "AsyncServer",
    "AsyncSession",
    "AsyncSubscription",
    "AttachError",
    "CallError",
    "CallTimeoutError",
    "ClosedError",
    "ConfigError",
    "DelegatedName",
    "DelegationError",
    "GdpError",
    "LocalError",
    "Message",
    "Metadata",
    "Name",
    "NoServerError",
    "Publisher",
    "RemoteError",
    "Replication",
    "Request",
    "Response",
    "Server",
    "Session",
    "SessionError",
    "SessionTimeoutError",
    "Subscription",
    "__version__",
    "open",
    "open_async",
]

_MODULES = {
    "gdp.errors": ("ConfigError", "GdpError", "LocalError", "RemoteError"),
    "gdp.metadata": ("Metadata",),
    "gdp.names": ("Name",),
    "gdp.service.replication": ("Replication",),
    "gdp.session.aio": ("AsyncPublisher", "AsyncServer", "AsyncSession", "AsyncSubscription"),
    "gdp.session.protocol.errors": (
        "AttachError",
        "CallError",
        "CallTimeoutError",
        "ClosedError",
        "DelegationError",
        "NoServerError",
        "SessionError",
        "SessionTimeoutError",
    ),
    "gdp.session.protocol.messages": ("DelegatedName", "Message", "Request", "Response"),
    "gdp.session.session": ("Publisher", "Server", "Session", "Subscription"),
}
_PLACES = {name: (module, name) for module, names in _MODULES.items() for name in names}
_PLACES["open"] = ("gdp.session.session", "open_session")
_PLACES["open_async"] = ("gdp.session.aio", "open_session_async")


def __getattr__(name: str) -> object:
    """Import a name of the library when it is first used."""
    if name == "__version__":
        from importlib import metadata

        value: object = metadata.version("gdp-ros")
    elif name in _PLACES:
        module, attribute = _PLACES[name]
        value = getattr(importlib.import_module(module), attribute)
    else:
        raise AttributeError(f"module 'gdp' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the names that the library exports."""
    return sorted({*globals(), *__all__})
