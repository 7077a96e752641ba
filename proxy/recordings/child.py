"""Child process that decodes one recording, without any other rights.

I/O; a command that ``process`` starts. It reads the recording and writes frames (``stream``) to a pipe. It sets limits
of memory and time, Landlock and seccomp before it opens the file. The kernel kills it when the other side of its
lifeline is closed, even while it decodes. ``PR_SET_PDEATHSIG`` would not suffice: it follows the thread that started
the process. Landlock also removes the right to signal the process from a parent that is confined later.
"""

from __future__ import annotations

import fcntl
import os
import resource
import signal
import site
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from gdp.errors import ConfigError, LocalError
from gdp.ports.confine.capabilities import Capability
from gdp.ports.readiness import readable
from gdp.ports.sandbox import Needs, confine
from proxy.recordings.decoder import BagDecoder
from proxy.recordings.source import Message
from proxy.recordings.stream import (
    BLOCK_BYTES,
    CHANNELS_MAX,
    CHANNELS_MAX_BYTES,
    Kind,
    frame_head,
    message_head,
    opened_to,
    text_to,
)
from proxy.serial.channel import Channel

_ROOT: Final = Path(__file__).resolve().parents[2]
_SYSTEM: Final = tuple(map(Path, ("/usr/lib", "/usr/share/zoneinfo", "/lib", "/lib64")))
_JOURNALS: Final = ("-wal", "-shm")  # journal files of SQLite, in the same folder as the database
_CPU_GRACE_S: Final = 5


def main(words: Sequence[str]) -> None:
    """Decode a recording, and write its messages each time that a byte is read from standard input.

    Args:
        words: the recording; a folder that may be written to, or nothing; the descriptors of the output and of the
            lifeline; bytes of address space; seconds of processor time; bytes of the largest file in that folder.
    """
    path, scratch = Path(words[0]), Path(words[1]) if words[1] else None
    number, lifeline, memory_bytes, cpu_s, file_bytes = map(int, words[2:])
    output = _Output(number)
    try:
        _die_with(lifeline)
        confine_decoder(path, scratch, memory_bytes, cpu_s, file_bytes)
        _serve(path, output)
    except BrokenPipeError:
        return
    except MemoryError:
        output.write(Kind.FAILED)
    except Exception as error:
        output.write(Kind.FAILED, text_to(f"{type(error).__name__}: {error}"))


def _die_with(lifeline: int) -> None:
    fcntl.fcntl(lifeline, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)
    if readable([lifeline], 0):  # the lifeline was closed before
        sys.exit(1)


def confine_decoder(path: Path, scratch: Path | None, memory_bytes: int, cpu_s: int, file_bytes: int) -> None:
    """Set the limits and drop the rights irreversibly."""
    tempfile.tempdir = None if scratch is None else str(scratch)
    _limit(resource.RLIMIT_CORE, 0)
    _limit(resource.RLIMIT_FSIZE, file_bytes)
    _limit(resource.RLIMIT_CPU, cpu_s, _CPU_GRACE_S)
    _limit(resource.RLIMIT_AS, memory_bytes)
    files = _files(path)
    kept = {Capability.DAC_READ_SEARCH} if os.geteuid() == 0 and any(map(_is_foreign, files)) else set()
    confine(
        Needs(
            capabilities=frozenset(kept),
            writes=() if scratch is None else (scratch,),
            reads=(*files, *_code(), Path(f"/proc/{os.getpid()}")),
            tcp_ports=(),
            only_reads=True,
        )
    )


def _limit(what: int, amount: int, grace: int = 0) -> None:
    """Set a limit, or keep one that is lower."""
    present = [each for each in resource.getrlimit(what) if each != resource.RLIM_INFINITY]
    resource.setrlimit(what, (min([amount, *present]), min([amount + grace, *present])))


def _files(path: Path) -> list[Path]:
    """Return the files of a recording; a folder's storage files may be links to elsewhere."""
    if not path.is_dir():
        return [path, *(path.with_name(path.name + suffix) for suffix in _JOURNALS)]
    return [path, *(entry.resolve() for entry in path.iterdir() if entry.is_symlink())]


def _is_foreign(path: Path) -> bool:
    try:
        return any(each.stat().st_uid != os.geteuid() for each in (path.absolute(), *path.absolute().parents))
    except OSError:
        return False


def _code() -> Iterable[Path]:
    """Return the folders from which Python may still import."""
    folders = {*sys.path, sys.prefix, sys.base_prefix, sys.exec_prefix, *site.getsitepackages()}
    folders -= {"", "/", "/usr", str(_ROOT), str(Path.cwd()), str(Path.home())}  # these contain other files, too
    return (*_SYSTEM, _ROOT / "gdp", _ROOT / "proxy", *map(Path, sorted(folders)))


class _Output:
    """Writes frames to a pipe; blocks while it is full."""

    def __init__(self, output: int) -> None:
        self._output = output

    def write(self, kind: Kind, *parts: bytes) -> None:
        """Write one frame."""
        left = [frame_head(kind, sum(map(len, parts))), *parts]
        while left:
            written = os.writev(self._output, left)
            while left and written >= len(left[0]):
                written -= len(left.pop(0))
            if left and written:
                left[0] = left[0][written:]

    def write_messages(self, messages: Iterable[Message]) -> None:
        """Write messages: small ones together, large ones as they are."""
        block: list[bytes] = []
        size = 0
        for message in messages:
            head = message_head(message)
            if block and size + len(head) + len(message.raw) > BLOCK_BYTES:
                self.write(Kind.BLOCK, b"".join(block))
                block, size = [], 0
            if len(head) + len(message.raw) > BLOCK_BYTES:
                self.write(Kind.BLOCK, head, message.raw)
                continue
            block += (head, message.raw)
            size += len(head) + len(message.raw)
        if block:
            self.write(Kind.BLOCK, b"".join(block))


def _serve(path: Path, output: _Output) -> None:
    try:
        with BagDecoder(path) as bag:
            _write_opened(bag, output)
            while sys.stdin.buffer.read(1):
                output.write_messages(bag.messages())
                output.write(Kind.END, text_to(bag.unread))
    except ConfigError as error:
        if isinstance(error.__cause__, MemoryError):
            output.write(Kind.FAILED)
        else:
            output.write(Kind.REFUSED, text_to(error.expected))
    except LocalError as error:
        output.write(Kind.REFUSED, text_to(f"cannot be read: {error}"))


def _write_opened(bag: BagDecoder, output: _Output) -> None:
    if len(bag.channels) > CHANNELS_MAX:
        raise LocalError(f"{len(bag.channels)} topics; at most {CHANNELS_MAX} are read")
    wires = [_wire(channel) for channel in bag.channels]
    if sum(map(len, wires)) > CHANNELS_MAX_BYTES:
        raise LocalError(f"descriptions of more than {CHANNELS_MAX_BYTES} bytes")
    for wire in wires:
        output.write(Kind.CHANNEL, wire)
    output.write(Kind.OPENED, opened_to(bag.count, bag.counts))


def _wire(channel: Channel) -> bytes:
    """Return a description; without its definition and QoS where no reader would accept these."""
    try:
        return channel.to_wire()
    except (LocalError, UnicodeError):
        bare = replace(channel, definition="", definition_format="", qos=())
    try:
        return bare.to_wire()
    except UnicodeError as error:
        raise LocalError("a topic's name or type is no text") from error
