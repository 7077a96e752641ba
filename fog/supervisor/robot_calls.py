"""How much a robot's proxy has sent into the overlay, by the metrics that it shows on this host.

Place: I/O. For providers that cannot show what a machine's proxy says now. It counts all that the proxy sends, topics
too: more than calls, never less.
Source: Prometheus text exposition format, version 0.0.4.
"""

from __future__ import annotations

import re
from http.client import HTTPException
from pathlib import Path
from typing import Final
from urllib.request import urlopen

from proxy.config import ProxyConfig

__all__ = ["sent_by"]

_SENT: Final = re.compile(rb'^gdp_messages_total\{direction="out"\} (\S+)$', re.MULTILINE)
_PATIENCE_S: Final = 0.5


def sent_by(proxy: Path) -> int | None:
    """Return how many messages the proxy of this file has sent since its start; None: it does not say.

    Raises:
        ConfigError: the file is not a proxy's.
    """
    metrics = ProxyConfig.load(proxy).metrics
    if metrics is None:
        return None
    try:
        with urlopen(f"http://127.0.0.1:{metrics.port}/metrics", timeout=_PATIENCE_S) as answer:
            found = _SENT.search(answer.read())
    except (OSError, HTTPException):
        return None  # it does not run, or not here
    return None if found is None else int(float(found[1]))
