"""Access token in the URL of a local server: every user of the host may connect, but only who knows it is served.

Source: RFC 6750, section 2.3, for a token in the query of a URL.
"""

from __future__ import annotations

import secrets
from typing import Final
from urllib.parse import parse_qs, urlsplit

_TOKEN_BYTES: Final = 24


def new_access_token() -> str:
    """Return a new token of 192 random bits, whose characters need no quoting in a URL."""
    return secrets.token_urlsafe(_TOKEN_BYTES)


def query_token(path: str) -> str:
    """Return the token of a request's path, such as ``/?token=...``; empty: it has none, or several."""
    try:
        found = parse_qs(urlsplit(path).query).get("token", [])
    except ValueError:
        return ""  # more fields than the library reads
    return found[0] if len(found) == 1 else ""


def is_access_token(given: str, token: str) -> bool:
    """Return whether a client knows the token; the time of the comparison shows nothing of it."""
    return secrets.compare_digest(given.encode(errors="replace"), token.encode())
