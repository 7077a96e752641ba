"""Joining of a machine at its first start: it becomes a member of the domain with its token.

I/O. It does what ``gdp join --no-start`` does: keys are made here, and the domain's root is pinned by the token. Keys
are on disk before they are sent, so a restarted machine uses the same keys. Afterwards the file with the token is
deleted; a machine without one does not join.
"""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from fog.host.bundle import JOIN_FILE, MEMBER_FOLDER
from gdp.enrolment.domain_join import JoinRequest, join_domain
from gdp.errors import LocalError
from gdp.stores.files import read_private
from gdp.trust.join_token import JoinToken

log = logging.getLogger(__name__)

# a cloud machine must boot an image and install packages; the token has expired by then
JOIN_DEADLINE_S: Final = 900.0
_KEYS: Final = "keys"  # until the machine has joined


def join_file(token: JoinToken, label: str) -> bytes:
    """Return the content of ``JOIN_FILE``."""
    return json.dumps({"token": token.to_text(), "label": label}).encode()


def join(home: Path, *, deadline_s: float = JOIN_DEADLINE_S, wait: Callable[[float], None] = time.sleep) -> bool:
    """Join the domain of the token in a machine's folder; return whether there was one.

    An enrolment server that cannot be reached is tried again: the network of a machine that boots may come late.

    Raises:
        EnrolmentError: the domain refuses the token, or no server was reachable within ``deadline_s``.
        LocalError: the file is not valid, or the system refuses.
    """
    path, member = home / JOIN_FILE, home / MEMBER_FOLDER
    if not path.exists():
        return False
    if not member.exists():  # else it was stopped before the file was deleted
        joined = join_domain(_request(path, member, home / _KEYS, deadline_s), wait=wait)
        log.info("machine joined domain=%s nodes=%d", joined.root.label, len(joined.identities))
    shutil.rmtree(home / _KEYS, ignore_errors=True)
    path.unlink()
    return True


def _request(path: Path, member: Path, keys: Path, patience_s: float) -> JoinRequest:
    try:
        document = json.loads(read_private(path))
        token, label = str(document["token"]), str(document["label"])
    except (ValueError, KeyError, TypeError) as error:
        raise LocalError(f"{path}: token and label are expected: {error!r}") from error
    return JoinRequest(
        token=JoinToken.from_text(token), label=label, directory=member, keys=keys, patience_s=patience_s
    )
