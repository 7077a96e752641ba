"""Attacks with recordings on the decoder process, and by that process after an exploit."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import socket
import sqlite3
import struct
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gdp.errors import ConfigError, GdpError
from gdp.ports.confine import landlock, seccomp
from lab.process import until
from lab.zygote import Popen
from proxy.cli import replay
from proxy.config.config import ProxyConfig
from proxy.recordings.limits import BagLimits
from proxy.recordings.process import BagProcess, Cost, RecordingError
from proxy.recordings.reader import BagReader
from proxy.recordings.stream import BLOCK_BYTES, FrameReader, Kind
from proxy.recordings.writer import BagWriter
from proxy.serial.channel import Channel
from tests.attacks.test_recordings import BOMB_BYTES, MESSAGES, TOPICS, database, mcap, packed, ros1
from tests.pages import ROOT

TOPIC = Channel("/t", "a/msg/B", 2, hash="", definition="int8 a\n", definition_format="msg")
ENDS_S = 20.0


def recording(path: Path, count: int = 3, size: int = 100) -> Path:
    with BagWriter(path, 2) as bag:
        handle = bag.add(TOPIC)
        for number in range(count):
            bag.write(handle, number, b"\0\1\0\0" + bytes(size))
    return path


@pytest.fixture
def executed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Execute decoders: a forked one has memory of its zygote, which no limit counts."""
    monkeypatch.setattr(Popen, "zygote", None)


def child_of(process: int) -> int:
    """Return the only decoder of a process, which may have other children, and may just have been started."""
    children = Path(f"/proc/{process}/task/{process}/children")

    def decoders() -> list[str]:
        return [each for each in children.read_text().split() if b"proxy.recordings" in _command_line(each)]

    until(decoders)
    (child,) = decoders()
    return int(child)


def _command_line(process: str) -> bytes:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return b""  # it has ended


def has_ended(process: int) -> bool:
    """Return whether a process is gone, or only waits to be reaped."""
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    return True


def ends(process: int) -> bool:
    until_s = time.monotonic() + ENDS_S
    while not has_ended(process):
        if time.monotonic() > until_s:
            return False
        time.sleep(0.01)
    return True


# --- actions of an exploited decoder

# Numbers of calls that Python has no function for, and arguments that succeed, or fail otherwise than by EPERM.
CALLS = [
    ("shmget", {"x86_64": 29, "aarch64": 194}, 0, 4096, 0o1600),
    ("shmat", {"x86_64": 30, "aarch64": 196}, 0, 0, 0),
    ("semget", {"x86_64": 64, "aarch64": 190}, 0, 1, 0o1600),
    ("msgget", {"x86_64": 68, "aarch64": 186}, 0, 0o1600),
    ("msgrcv", {"x86_64": 70, "aarch64": 188}, 0, 0, 0, 0, 0o4000),
    ("mq_open", {"x86_64": 240, "aarch64": 180}, b"x", 0, 0, 0),
    ("mq_unlink", {"x86_64": 241, "aarch64": 181}, b"x"),
    ("inotify_init1", {"x86_64": 294, "aarch64": 26}, 0),
    ("ioprio_set", {"x86_64": 251, "aarch64": 30}, 1, 0, 0),
    ("timer_create", {"x86_64": 222, "aarch64": 107}, 0, 0, 0),
]
PROBE = (
    f"""
CALLS = {CALLS}
"""
    + """
import ctypes, fcntl, json, os, pathlib, platform, resource, socket, sys, threading
from gdp.ports.confine import seccomp
from proxy.recordings.child import confine_decoder
path, scratch, port, parent = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
inside, outside = os.pipe()
confine_decoder(path, scratch, 256 << 20, 20, 1 << 20)
found = {}

def attempt(name, act):
    try:
        act()
        found[name] = "done"
    except (OSError, MemoryError, RuntimeError) as error:
        found[name] = type(error).__name__

attempt("recording", path.read_bytes)
attempt("scratch", lambda: (scratch / "x").write_bytes(b"x"))
attempt("sibling", lambda: path.with_name("secret").read_bytes())
attempt("write", lambda: path.with_name("new").write_bytes(b"x"))
attempt("alter", lambda: path.open("r+b"))
attempt("mode", lambda: os.chmod(path, 0o777))
attempt("remove", lambda: os.unlink(path))
attempt("udp", lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
attempt("tcp", lambda: socket.create_connection(("127.0.0.1", port)))
attempt("unix", lambda: socket.socketpair())
attempt("fork", lambda: os.fork() or os._exit(0))
attempt("execute", lambda: os.execv("/bin/true", ["true"]))
attempt("signal", lambda: os.kill(parent, 0))
attempt("memory", lambda: bytes(512 << 20))
attempt("hidden memory", lambda: os.memfd_create("x"))
attempt("large file", lambda: (scratch / "y").write_bytes(bytes(2 << 20)))
attempt("limits", lambda: resource.prlimit(parent, resource.RLIMIT_NOFILE))
attempt("environment", lambda: pathlib.Path(f"/proc/{parent}/environ").read_bytes())
libc = ctypes.CDLL(None, use_errno=True)

def call(number, *words):
    if libc.syscall(number, *words) < 0:
        raise OSError(ctypes.get_errno(), "refused")

for name, numbers, *words in CALLS:
    attempt(name, lambda: call(numbers[platform.machine()], *words))
attempt("affinity of another", lambda: os.sched_setaffinity(parent, {0}))
attempt("priority of another", lambda: os.setpriority(os.PRIO_PROCESS, parent, 1))
attempt("thread", lambda: threading.Thread(target=print).start())
attempt("owner of a file", lambda: fcntl.fcntl(inside, fcntl.F_SETOWN, parent))
attempt("signal of a file", lambda: fcntl.fcntl(inside, fcntl.F_SETSIG, 9))
attempt("signals of a file", lambda: fcntl.fcntl(inside, fcntl.F_SETFL, os.O_ASYNC))
attempt("notes of a folder", lambda: fcntl.fcntl(inside, fcntl.F_NOTIFY, fcntl.DN_CREATE))
attempt("lease of a file", lambda: fcntl.fcntl(inside, fcntl.F_SETLEASE, fcntl.F_RDLCK))
attempt("owner by ioctl", lambda: fcntl.ioctl(inside, 0x8901, parent))
attempt("signals by ioctl", lambda: fcntl.ioctl(inside, 0x5452, 1))
fcntl_number = {"x86_64": 72, "aarch64": 25}[platform.machine()]
attempt("high half of a command", lambda: call(fcntl_number, inside, ctypes.c_long(1 << 32 | 8), 1))
listed = set(seccomp.allowed(platform.machine()).values())
if listed and "Seccomp:\t2" in open("/proc/self/status").read():
    for number in {*range(335), *range(337, 500)} - listed:  # 335, 336: the kernel's own, of uprobes
        ctypes.set_errno(0)
        if libc.syscall(number, 0, 0, 0, 0, 0, 0) >= 0 or ctypes.get_errno() not in (1, 38):
            found[f"call {number}"] = "done"
print(json.dumps(found))
"""
)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Result of each attempt of a decoder: ``done``, or the kind of error."""
    folder = tmp_path_factory.mktemp("decoder")
    (folder / "scratch").mkdir()
    (folder / "secret").write_bytes(b"x")
    path = recording(folder / "a.mcap")
    with socket.create_server(("127.0.0.1", 0)) as server:
        words = [str(path), str(folder / "scratch"), str(server.getsockname()[1]), str(os.getpid())]
        done = subprocess.run(
            [sys.executable, "-c", PROBE, *words],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
    assert done.returncode == 0, done.stderr
    said: dict[str, str] = json.loads(done.stdout)
    return said


@pytest.mark.parametrize("act", ["recording", "scratch"])
def test_b01_a_decoder_reads_its_recording(found: dict[str, str], act: str) -> None:
    assert found[act] == "done"


@pytest.mark.parametrize("act", ["memory", "large file"])
def test_b01_a_decoder_has_no_more_memory_and_disk_than_its_limit(found: dict[str, str], act: str) -> None:
    assert found[act] in ("MemoryError", "OSError")


@pytest.mark.parametrize("act", ["sibling", "write", "alter", "remove", "execute", "environment"])
def test_b01_a_decoder_that_was_taken_over_reaches_no_other_file(found: dict[str, str], act: str) -> None:
    if not landlock.abi():
        pytest.skip("this kernel has no Landlock")
    assert found[act] == "PermissionError"


@pytest.mark.parametrize("act", ["udp", "tcp", "unix", "fork", "mode", "signal", "hidden memory", "limits"])
def test_b01_a_decoder_that_was_taken_over_has_no_network_process_or_signal(found: dict[str, str], act: str) -> None:
    needs_list()
    assert found[act] == "PermissionError"


@pytest.mark.parametrize("act", [name for name, *_ in CALLS])
def test_b13_a_decoder_that_was_taken_over_shares_no_memory_queue_or_watch(found: dict[str, str], act: str) -> None:
    needs_list()
    assert found[act] == "PermissionError"


@pytest.mark.parametrize("act", ["affinity of another", "priority of another", "thread"])
def test_b13_a_decoder_that_was_taken_over_schedules_nothing(found: dict[str, str], act: str) -> None:
    needs_list()
    assert found[act] in ("PermissionError", "RuntimeError")


@pytest.mark.parametrize(
    "act",
    [
        *("owner of a file", "signal of a file", "signals of a file", "notes of a folder", "lease of a file"),
        *("owner by ioctl", "signals by ioctl", "high half of a command"),
    ],
)
def test_b13_a_decoder_that_was_taken_over_has_no_signals_sent_for_it(found: dict[str, str], act: str) -> None:
    needs_list()
    assert found[act] == "PermissionError"


def test_b13_every_other_system_call_is_refused(found: dict[str, str]) -> None:
    needs_list()
    assert [act for act in found if act.startswith("call ")] == []


def needs_list() -> None:
    if not seccomp.allowed(os.uname().machine):
        pytest.skip("no list of system calls for this machine")


def frames(*parts: tuple[int, bytes]) -> bytes:
    return b"".join(struct.pack("<BI", kind, len(data)) + data for kind, data in parts)


NUMBERS = (Kind.OPENED, struct.pack("<Q?", 1, False))
DESCRIPTION = (Kind.CHANNEL, TOPIC.to_wire())


@pytest.mark.parametrize(
    "said",
    [
        frames((9, b"")),
        frames((Kind.END, b"")),
        frames((Kind.CHANNEL, b"\xa0")),
        struct.pack("<BI", Kind.CHANNEL, 1 << 31),
        struct.pack("<BI", Kind.BLOCK, (1 << 32) - 1),
        frames(
            *[
                (
                    Kind.CHANNEL,
                    Channel("/t", "a/B", 2, hash="", definition="#" * 60_000, definition_format="msg").to_wire(),
                )
            ]
            * 600
        ),
        frames(DESCRIPTION, (Kind.OPENED, b"")),
        frames(DESCRIPTION, (Kind.OPENED, struct.pack("<Q?Q", 1, True, 1) + bytes(8))),
        frames(DESCRIPTION, NUMBERS, (Kind.OPENED, NUMBERS[1])),
        frames(DESCRIPTION, NUMBERS, (Kind.BLOCK, b"x")),
        frames(DESCRIPTION, NUMBERS, (Kind.BLOCK, struct.pack("<IqIQI", 1, 0, 0, 0, 0))),
        frames(DESCRIPTION, NUMBERS, (Kind.BLOCK, struct.pack("<IqIQI", 0, 0, 1, 0, 0))),
        frames(DESCRIPTION, NUMBERS, (Kind.BLOCK, struct.pack("<IqIQI", 0, 0, 1, 0, 0) + bytes(BLOCK_BYTES))),
    ],
)
def test_b02_what_a_decoder_says_wrongly_is_refused(said: bytes) -> None:
    left = memoryview(said)

    def take(size: int) -> bytes:
        nonlocal left
        assert size <= len(left), "more is asked for than is there"
        piece, left = bytes(left[:size]), left[size:]
        return piece

    def read() -> None:
        reader = FrameReader()
        reader.open(take)
        list(reader.messages(take))

    with pytest.raises(GdpError):
        read()


def test_b02_words_of_a_decoder_are_printed_without_control_characters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = frames((Kind.REFUSED, b"cannot be read: \x1b[2J\nno"))
    pipe = io.BytesIO(said)
    monkeypatch.setattr(BagProcess, "read", lambda self, size, waiting=None: pipe.read(size))
    with pytest.raises(ConfigError, match=r"\\x1b\[2J\\nno"):
        BagReader(recording(tmp_path / "a.mcap"))


# --- cost of a recording


@pytest.mark.usefixtures("executed")
@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_b03_a_recording_that_needs_too_much_memory_is_named(tmp_path: Path, kind: str) -> None:
    make, compression = (mcap, "zstd") if kind == "mcap" else (ros1, "lz4")
    path = make(tmp_path / f"a.{kind}", compression, packed(compression, 60 << 20), 60 << 20)
    with pytest.raises(RecordingError, match=rf"{path}: to read it takes more than 80 MiB") as failure:
        BagReader(path, BagLimits(memory_bytes=80 << 20))
    assert failure.value.limit == "memory"


def test_b03_a_recording_that_needs_too_much_time_is_named(tmp_path: Path) -> None:
    path = recording(tmp_path / "a.mcap", 1_000)
    with BagReader(path, BagLimits(cpu_s=1)) as bag:
        again = (list(bag.messages()) for _ in range(1_000))
        with pytest.raises(RecordingError, match=rf"{path}: to read it takes more than 1 s") as failure:
            list(map(len, again))
    assert failure.value.limit == "cpu"


@pytest.mark.usefixtures("executed")
def test_a28_a_bomb_does_not_reach_the_process_that_replays(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap", "zstd", packed("zstd", BOMB_BYTES), BOMB_BYTES)
    with contextlib.suppress(GdpError), BagReader(path) as bag:
        assert not list(bag.messages())


@pytest.mark.parametrize("place", ["../b/b_0.db3", "/etc/passwd"])
def test_b04_a_folder_does_not_name_files_elsewhere(tmp_path: Path, place: str) -> None:
    topic = "INSERT INTO topics VALUES (1, '/secret', 'a/msg/B', 'cdr', '')"
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    database(tmp_path / "b" / "b_0.db3", TOPICS, MESSAGES, topic)
    about = {
        "version": 4, "storage_identifier": "sqlite3", "relative_file_paths": [place], "message_count": 0,
        "duration": {"nanoseconds": 1}, "starting_time": {"nanoseconds_since_epoch": 1},
        "compression_format": "", "compression_mode": "", "topics_with_message_count": [],
    }  # fmt: skip
    (tmp_path / "a" / "metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": about}))
    with pytest.raises(ConfigError, match="cannot be read"):
        BagReader(tmp_path / "a")


def test_b04_a_pipe_in_place_of_a_recording_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.bag")
    with pytest.raises(ConfigError, match="neither a file nor a folder"):
        BagReader(tmp_path / "a.bag")


# --- the end of a decoder


@pytest.mark.parametrize(
    ("number", "says"),
    [
        (signal.SIGKILL, "was killed, perhaps for want of memory"),
        (signal.SIGSEGV, r"crashed \(SIGSEGV\)"),
        (signal.SIGXCPU, "takes more than"),
    ],
)
def test_b05_the_end_of_a_decoder_is_one_error_that_names_the_recording(tmp_path: Path, number: int, says: str) -> None:
    path = recording(tmp_path / "a.mcap", 3, 4 << 20)
    with BagReader(path) as bag:
        messages = bag.messages()
        next(messages)
        os.kill(child_of(os.getpid()), number)
        with pytest.raises(RecordingError, match=rf"^{path}: .*{says}"):
            list(messages)


def test_b05_a_decoder_that_falls_silent_is_no_hang(tmp_path: Path) -> None:
    path = recording(tmp_path / "a.mcap", 3, 4 << 20)
    process = BagProcess(path, Cost(1 << 30, 30, 0.2, 0), None)
    try:
        os.kill(child_of(os.getpid()), signal.SIGSTOP)
        with pytest.raises(RecordingError, match=rf"{path}: its decoder gave nothing for"):
            process.read(1 << 30)
    finally:
        process.close()


def test_b05_who_waits_for_a_decoder_may_stop(tmp_path: Path) -> None:
    with BagReader(recording(tmp_path / "a.mcap", 3, 4 << 20)) as bag:
        os.kill(child_of(os.getpid()), signal.SIGSTOP)
        assert not list(bag.messages(lambda: False))
        assert not list(bag.messages())


@pytest.mark.usefixtures("executed")
@pytest.mark.parametrize("is_refused", [False, True])
def test_b05_gdp_replay_says_so_in_one_line_and_exits_with_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_refused: bool
) -> None:
    monkeypatch.setattr(ProxyConfig, "load", lambda path: None)
    path = mcap(tmp_path / "a.mcap", "zstd", packed("zstd", 60 << 20), 60 << 20)
    if is_refused:
        path.write_bytes(b"no recording")
    said = CliRunner().invoke(replay.app, [str(path), "--config", "p.yaml", "--memory", "80", "--check"])
    assert said.exit_code == (2 if is_refused else 1)
    assert said.stderr.count("\n") == 1
    assert str(path) in said.stderr
    assert ("(see --memory)" in said.stderr) != is_refused


HOLDS = """
import os, sys, threading, time
from pathlib import Path
from gdp.ports.sandbox import Needs, confine
from proxy.recordings.reader import BagReader
bag = BagReader(sys.argv[1])
next(bag.messages())
children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
if sys.argv[2] == "confined":
    confine(Needs(writes=(Path("/dev"),)))
print(*children, flush=True)
if sys.argv[2] == "closes":
    bag.close()
    print("closed", flush=True)
time.sleep(60)
"""


@contextlib.contextmanager
def holder(path: Path, how: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """Yield a process that holds a recording open, and its decoder."""
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(HOLDS), str(path), how],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            yield process, int(process.stdout.readline())
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("how", "number", "is_stopped"),
    [
        ("free", signal.SIGINT, False),
        ("free", signal.SIGKILL, True),
        ("confined", signal.SIGKILL, False),
        ("confined", signal.SIGINT, True),
        pytest.param("free", signal.SIGINT, True, marks=pytest.mark.nightly),
        pytest.param("free", signal.SIGKILL, False, marks=pytest.mark.nightly),
        pytest.param("confined", signal.SIGKILL, True, marks=pytest.mark.nightly),
        pytest.param("confined", signal.SIGINT, False, marks=pytest.mark.nightly),
    ],
)
def test_b06_no_decoder_outlives_the_process_that_started_it(
    tmp_path: Path, how: str, number: int, is_stopped: bool
) -> None:
    with holder(recording(tmp_path / "a.mcap", 3, 4 << 20), how) as (process, decoder):
        if is_stopped:
            os.kill(decoder, signal.SIGSTOP)
        assert not has_ended(decoder)
        process.send_signal(number)
        process.wait(ENDS_S)
        assert ends(decoder)


def test_b06_a_recording_that_is_closed_leaves_no_decoder_and_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # other tests make such folders meanwhile
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as connection:
        connection.execute(TOPICS)
        connection.execute(MESSAGES)
    connection.close()
    with BagReader(path) as bag:
        assert list(tmp_path.glob("gdp-recording-*"))
        decoder = child_of(os.getpid())
        assert bag.count == 0
    assert has_ended(decoder)
    assert not list(tmp_path.glob("gdp-recording-*"))


def test_b07_a_decoder_works_no_further_ahead_than_its_pipe_holds(tmp_path: Path) -> None:
    path = recording(tmp_path / "a.mcap", 64, 1 << 20)
    with BagReader(path) as bag:
        messages = bag.messages()
        next(messages)
        decoder = child_of(os.getpid())
        until(lambda: Path(f"/proc/{decoder}/stat").read_text().rpartition(")")[2].split()[0] == "S")
        assert written_by(decoder) < 8 << 20
        assert sum(1 for _ in messages) == 63


def written_by(process: int) -> int:
    lines = Path(f"/proc/{process}/io").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("wchar")).split()[1])
