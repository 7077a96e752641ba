"""Logs of a command as lines of JSON, for programs that collect them.

Computes text only; ``gdp.cli.node`` installs it.
"""

from __future__ import annotations

import logging
from datetime import datetime, timezone

import orjson

__all__ = ["JsonLines"]


class JsonLines(logging.Formatter):
    """One object a record: ``time`` (RFC 3339, UTC), ``level``, ``logger``, ``message``; ``trace`` of an exception."""

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as one line without its end."""
        fields = {
            "time": datetime.fromtimestamp(record.created, timezone.utc).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info is not None:
            fields["trace"] = self.formatException(record.exc_info)
        return orjson.dumps(fields).decode()
