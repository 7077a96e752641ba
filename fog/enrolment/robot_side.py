"""The robot's proxies learn what a cluster serves: a rule in their file, a delegation beside it, a SIGHUP.

Place: I/O; edits files that are at hand, signals processes of this machine.
A rule that the file already has, also one with a pattern, is enough. Otherwise one line is added for each name, marked
with the cluster's, and taken out again when the cluster is gone; nothing else of the file is touched. A file that is
private, or that has the salt of a name in it, is private afterwards.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import signal
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from fog.cluster import Carried
from fog.enrolment.boots import robot_rule
from fog.enrolment.members import Authority, metadata_of
from gdp.errors import LocalError
from gdp.stores.files import private, public, write_all
from gdp.stores.keyring import load_public_key
from proxy.config import ProxyConfig
from proxy.rules import choice

__all__ = ["forget_rules", "introduce", "processes_of", "reload"]

_MARK: Final = "  # fog: "
_IMPORT: Final = re.compile(r"^import:[ \t]*(#.*)?$", re.MULTILINE)
_EMPTY: Final = re.compile(r"^import:[ \t]*\n(?=[^\s#-]|\Z)", re.MULTILINE)  # a list whose last line we took
_NEXT: Final = re.compile(r"^[^\s#-]", re.MULTILINE)
_PROGRAMS: Final = ("gdp-proxy", "proxy.cli")
_CAUGHT: Final = re.compile(r"^SigCgt:\s*([0-9a-f]+)$", re.MULTILINE)
_SALT: Final = re.compile(r"""\bsalt["']?[ \t]*:""")  # under `metadata`
_ITEM: Final = re.compile(r"^(?P<indent>[ \t]*)-[ \t]", re.MULTILINE)


def introduce(path: Path, authority: Authority, cluster: str, carried: Sequence[Carried], *, days: float) -> None:
    """Let the proxy whose file this is take what a cluster serves, by rule and delegation; running or not.

    Raises:
        ConfigError: the file is not a proxy's, or a rule cannot be added by a line.
        LocalError: keys are missing.
    """
    key = load_public_key(authority.owner_key).compressed
    with _alone(path):
        config = ProxyConfig.load(path)
        lacking = [
            each
            for each in carried
            if choice.imported(config.imports, metadata_of(each).name(key), metadata_of(each)) is None
        ]
        if lacking:
            owner = os.path.relpath(authority.owner_key, path.parent)
            lines = [json.dumps({**robot_rule(each), "owner": owner}) + _MARK + cluster for each in lacking]
            before = path.read_text(encoding="utf-8")
            _write(path, _with_lines(before, lines))
            try:
                ProxyConfig.load(path)
            except Exception:
                _write(path, before)
                raise
        authority.let(config.identity, config.delegations, carried, days=days)


def forget_rules(path: Path, cluster: str) -> bool:
    """Take out the lines that were added for a cluster; return whether there were any."""
    mark = f"{_MARK}{cluster}"
    with _alone(path):
        before = path.read_text(encoding="utf-8")
        after = "".join(line for line in before.splitlines(keepends=True) if not line.rstrip("\n").endswith(mark))
        if after != before:
            _write(path, _EMPTY.sub("", after))
    return after != before


def processes_of(path: Path) -> Iterator[int]:
    """Yield the ids of proxies that run with this file, and that a SIGHUP does not end.

    Not one that only checks the file, nor one that is still starting: that has no handler yet.
    """
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        with suppress(OSError):  # it has ended, or is somebody else's
            words = (folder / "cmdline").read_bytes().decode("utf-8", "replace").split("\0")
            if not any(Path(word).name in _PROGRAMS for word in words) or "--config" not in words[:-1]:
                continue
            file = (folder / "cwd").resolve() / words[words.index("--config") + 1]
            if file.exists() and file.samefile(path) and _catches_hang_up(folder):
                yield int(folder.name)


def reload(path: Path) -> int:
    """Have the processes of this file read it again; return how many there are."""
    told = 0
    for pid in processes_of(path):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGHUP)
            told += 1
    return told


def _catches_hang_up(process: Path) -> bool:
    caught = _CAUGHT.search((process / "status").read_text(encoding="utf-8"))
    return caught is not None and bool(int(caught[1], 16) >> (signal.SIGHUP - 1) & 1)


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Hold off other launches that change this file; its folder is locked, for the file itself is replaced."""
    try:
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise LocalError(f"{path.parent}: {error.strerror}") from error
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def _with_lines(text: str, rules: Sequence[str]) -> str:
    """Return a YAML file with further items of its list ``import``."""
    if not text.endswith("\n"):
        text += "\n"
    head = _IMPORT.search(text)
    if head is None:
        if re.search(r"^import:", text, re.MULTILINE):
            raise LocalError("import: is written in one line, so no rule can be added; begin a line for each rule")
        return text + "import:\n" + "".join(f"- {rule}\n" for rule in rules)
    begin = head.end() + 1
    following = _NEXT.search(text, begin)
    item = _ITEM.search(text, begin, following.start() if following is not None else len(text))
    indent = item["indent"] if item is not None else ""
    return text[:begin] + "".join(f"{indent}- {rule}\n" for rule in rules) + text[begin:]


def _write(path: Path, text: str) -> None:
    is_private = not path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO)
    new = private if is_private or _SALT.search(text) else public
    write_all(path.parent, {path.name: new(text.encode())}, force=True)
