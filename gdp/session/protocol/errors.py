"""Errors of sessions; each text states what is wrong, where, and what to do."""

from __future__ import annotations

from gdp.errors import LocalError


class SessionError(LocalError):
    """Root of the errors of sessions."""


class SessionTimeoutError(SessionError, TimeoutError):
    """Something did not happen within the time that the caller allowed; trying again may help."""


class AttachError(SessionTimeoutError):
    """No switch accepted the node in time; the text states what the node waits for."""


class DelegationError(SessionError):
    """The node holds no delegation, or several, for a name and a right."""


class ClosedError(SessionError):
    """The session, publisher, subscription or server was closed."""


class CallError(SessionError):
    """Every server refused a request; the text is the last server's reason."""


class NoServerError(CallError, SessionTimeoutError):
    """No server of the name was available."""


class CallTimeoutError(CallError, SessionTimeoutError):
    """No server responded in time; the request may have been executed."""
