"""Waiting for a device that another node of this host is about to create.

I/O.
"""

from __future__ import annotations

import contextlib
import logging
import select
import time

from gdp.ports.rtnetlink import LinkMonitor

__all__ = ["wait_for_device"]

log = logging.getLogger(__name__)


def wait_for_device(ifname: str, patience_s: float) -> None:
    """Return when a device of this name exists, or after ``patience_s``; opening it then reports its absence."""
    end_s = time.monotonic() + patience_s
    with contextlib.closing(LinkMonitor()) as links:
        found = links.all()
        while not any(link.ifname == ifname and not link.gone for link in found):
            rest_s = end_s - time.monotonic()
            if rest_s <= 0:
                return
            log.debug("waiting for device ifname=%s", ifname)
            select.select([links], [], [], rest_s)
            found = links.poll()
