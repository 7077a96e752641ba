"""Requirements of a machine for pip, each pinned by version and hash.

I/O: ``read_requirements`` reads one file. All other functions are sans-I/O.
Source: pip's "Secure installs" and "Requirements File Format". Installed code can reach a machine's keys, so no package
is selected by its name alone: pip runs with ``--require-hashes``, which also refuses unlisted dependencies.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.stores.files import read_at_most

FILE_MAX_BYTES: Final = 1 << 20
_EXPECTED: Final = (
    "expected a wheel's URL with its hash (https://...whl#sha256=HEX), or name==version --hash=sha256:HEX"
)
_HASH: Final = "[0-9a-f]{64}"
_NAME: Final = r"[A-Za-z0-9][\w.\-]*(?:\[[\w.,\- ]*\])?"
_URL: Final = re.compile(rf"(?:{_NAME} *@ *)?(?:https|file)://\S+#(?:\S+&)?sha256={_HASH}(?:&\S+)?(?: *;.*)?\Z")
_PINNED: Final = re.compile(
    rf"(?:{_NAME} *==[\w.!+\-]+|(?:{_NAME} *@ *)?(?:https|file)://\S+)(?: *;[^\n]*?)?(?: +--hash=sha256:{_HASH})+\Z"
)
_OPTIONS: Final = ("--index-url ", "--extra-index-url ", "--find-links ", "--only-binary ", "--require-hashes")
_COMMENT: Final = re.compile(r"(?:^|\s)#.*")


def pinned(requirement: str) -> str:
    """Return the requirement if it is pinned by hash. Raises ``ValueError``: it is not pinned by hash."""
    if not (_URL.match(requirement) or _PINNED.match(requirement)) or "\n" in requirement:
        raise ValueError(f"{requirement!r}: {_EXPECTED}")
    return requirement


def read_requirements(path: Path) -> bytes:
    """Return a requirements file for pip in which every requirement is pinned by hash.

    Raises:
        LocalError: the file cannot be read, or a line is not pinned; the text names the line.
    """
    try:
        with path.open("rb") as file:
            raw = read_at_most(file, FILE_MAX_BYTES)
        text = raw.decode()
    except OSError as error:
        raise LocalError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise LocalError(f"{path}: UTF-8 text is expected") from error
    if len(raw) > FILE_MAX_BYTES:
        raise LocalError(f"{path}: longer than {FILE_MAX_BYTES} bytes")
    found = 0
    for number, line in _lines(text):
        if line.startswith(_OPTIONS):
            continue
        try:
            pinned(line)
        except ValueError as error:
            raise LocalError(f"{path}:{number}: {error}") from error
        found += 1
    if not found:
        raise LocalError(f"{path}: no requirement in it")
    return raw


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield each logical line with the number of its first; continuations are joined, comments omitted."""
    begun, whole = 0, ""
    for number, line in enumerate(text.splitlines(), 1):
        begun = begun or number
        is_continued = line.endswith("\\")
        whole += _COMMENT.sub("", line.removesuffix("\\")).strip() + " "
        if not is_continued:
            if whole.strip():
                yield begun, re.sub(r"\s+", " ", whole.strip())
            begun, whole = 0, ""
    if whole.strip():
        yield begun, re.sub(r"\s+", " ", whole.strip())
