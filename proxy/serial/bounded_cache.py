"""Cache of results by a digest of their source, bounded in number; the least recently used one is dropped first.

Sans-I/O. Keys are digests, so that a cache does not keep the long texts that peers send. A refusal by a computation is
kept too: the same text, sent again, costs no more time.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

_Result = TypeVar("_Result")


def digest_of(*texts: str | int) -> bytes:
    """Return the SHA-256 of texts and numbers; different sequences have different ones."""
    running = hashlib.sha256()
    for text in texts:
        raw = str(text).encode("utf-8", "surrogatepass")
        running.update(len(raw).to_bytes(8, "big") + raw)
    return running.digest()


class BoundedCache(Generic[_Result]):
    """Keeps results, and errors of one kind; ``refusal``: the error that is kept as a result."""

    def __init__(self, count_max: int, refusal: type[Exception]) -> None:
        self._count_max = count_max
        self._refusal = refusal
        self._known: OrderedDict[bytes, _Result | Exception] = OrderedDict()

    def __len__(self) -> int:
        return len(self._known)

    def get(self, key: bytes, compute: Callable[[], _Result]) -> _Result:
        """Return the result of a key, computed if necessary.

        Raises:
            refusal: what ``compute`` raised, now or before.
        """
        if key in self._known:
            self._known.move_to_end(key)
        else:
            self._known[key] = self._outcome(compute)
            if len(self._known) > self._count_max:
                self._known.popitem(last=False)
        found = self._known[key]
        if isinstance(found, self._refusal):
            raise found.with_traceback(None)
        return found  # type: ignore[return-value]

    def _outcome(self, compute: Callable[[], _Result]) -> _Result | Exception:
        try:
            return compute()
        except self._refusal as error:
            return error.with_traceback(None)
