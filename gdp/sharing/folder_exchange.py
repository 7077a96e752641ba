"""Exchange through a folder that the nodes share: for one machine, or for a lab with a common file system.

I/O. The writers of the folder are trusted with the sender's name, and with nothing else::

    nodes/NAME.card            descriptor of each member
    mail/RECIPIENT/ID.mail     CBOR: from, kind, data; in the order of their identifiers
"""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from gdp.errors import StatementError
from gdp.names import Name
from gdp.sharing.exchange import Mail
from gdp.stores.files import private, public, read_public, write_all
from gdp.stores.keyring import load_card
from gdp.trust.node_descriptor import NodeDescriptor

log = logging.getLogger(__name__)

_NODES: Final = "nodes"
_MAIL: Final = "mail"


class FolderExchange:
    """Exchange of one member through a shared folder.

    Args:
        folder: made if it is missing.
        own: descriptor of this member, which the folder then shows to the others.

    Raises:
        LocalError: the folder cannot be written.
    """

    def __init__(self, folder: Path, own: NodeDescriptor) -> None:
        self._folder = folder
        self._own = own
        write_all(folder / _NODES, {f"{own.name.to_text()}.card": public(own.wire)}, force=True)

    def nodes(self) -> Sequence[NodeDescriptor]:
        """Return the descriptors in the folder. Raises ``LocalError``: a descriptor is invalid."""
        return [load_card(path) for path in sorted((self._folder / _NODES).glob("*.card"))]

    def send(self, to: Name, kind: str, data: bytes) -> None:
        """Write a mail for a member. Raises ``LocalError``: the folder cannot be written."""
        name = f"{time.time_ns():020d}-{secrets.token_hex(4)}.mail"
        wire = Mail(sender=self._own.label, kind=kind, data=data).to_cbor()
        write_all(self._folder / _MAIL / to.to_text(), {name: private(wire)})

    def receive_mail(self) -> Iterator[Mail]:
        """Yield the waiting mails; each is removed when the next one is asked for, a malformed one at once."""
        for path in sorted((self._folder / _MAIL / self._own.name.to_text()).glob("*.mail")):
            try:
                mail = Mail.from_cbor(read_public(path))
            except StatementError as error:
                log.warning("mail removed path=%s reason=%s", path, error)
                path.unlink()
                continue
            yield mail
            path.unlink()
