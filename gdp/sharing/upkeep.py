"""Upkeep of shared names in a thread of the agent: mail, names that appeared, renewal.

I/O. A pass that finds nothing to do reads the files of the proxy and asks it for its status. A problem is logged when
it begins, and tried again with each pass.
"""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

from gdp.errors import GdpError
from gdp.intervals import STOP_S, UPKEEP_S
from gdp.sharing.exchange import Exchange
from gdp.sharing.sharing import Sharing
from gdp.stores.keyring import OWNER_KEY

log = logging.getLogger(__name__)


class ShareUpkeep:
    """Thread that keeps the shared names of one machine.

    Args:
        directory: of the machine, with ``proxy.yaml``; ``owner`` in it is an owner whose delegations are renewed.
        each_s: seconds between two passes.
    """

    def __init__(self, directory: Path, exchange: Exchange, *, each_s: float = UPKEEP_S) -> None:
        self._directory = directory
        self._exchange = exchange
        self._each_s = each_s
        self._ended = threading.Event()
        self._problems: set[str] = set()
        self._thread = threading.Thread(target=self._run, name="sharing", daemon=True)

    def start(self) -> None:
        """Begin the upkeep."""
        self._thread.start()

    def stop(self) -> None:
        """End the upkeep; return when the present pass is over, or after a few seconds."""
        self._ended.set()
        self._thread.join(STOP_S)

    def work(self) -> None:
        """Do one pass; problems are logged."""
        owner = self._directory / "owner"
        owners = [owner] if (owner / OWNER_KEY).exists() else []
        try:
            report = Sharing(self._directory / "proxy.yaml", self._exchange, owners).work(time.time())
            problems = set(report.problems)
            for each in report.granted:
                log.info("delegated node=%s until_unix_s=%d", each.label, each.until_unix_s)
        except GdpError as error:
            problems = {str(error)}
        for text in sorted(problems - self._problems):
            log.warning("sharing: %s", text)
        self._problems = problems

    def _run(self) -> None:
        while not self._ended.wait(self._each_s):
            self.work()
