"""Zygote: a process that has imported the project once, and forks each program that a harness starts.

I/O; Linux. An import of ``gdp-switch`` costs about half a second of processor time, a fork some milliseconds. ``Popen``
is ``subprocess.Popen`` with the same command lines: where a line starts one of the project's own programs, the zygote
forks it, otherwise it is executed. The forked process is a child of the caller, so that waiting, signals, process
groups and ``/proc/PID/cmdline`` are the same. Coverage, other settings of the interpreter or another copy of the
project mean the real program. So do namespaces other than by ``nsenter``, and a shell that does more than start it.

    zygote.install()
    process = subprocess.Popen([sys.executable, "-m", "gdp.cli.switch", "--help"])

Source: prctl(2) ``PR_SET_CHILD_SUBREAPER``, proc(5) ``stat``, setns(2), unix(7).
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import fcntl
import functools
import gc
import importlib.metadata
import io
import json
import os
import re
import resource
import runpy
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, NoReturn

ROOT: Final = Path(__file__).resolve().parents[2]
_LATE: Final = ("domain", "join", "share", "delegate", "topic", "explain", "trace")  # commands with many imports
_PRELOADED: Final = (
    "gdp.cli.switch",
    "gdp.nodes.switch",
    "gdp.cli.rib",
    "gdp.nodes.rib",
    "gdp.cli.gdp",
    "gdp.cli.relay",
    "gdp.nodes.relay",
    "proxy.cli.proxy",
    "proxy.node.bridge_node",
    "proxy.cli.replay",
    "proxy.recordings.child",
    "fog.cli.app",
    "ring.cli",
    *(f"gdp.cli.{each}" for each in _LATE),
    *("proxy.cli.topic", "typer.rich_utils", "rich.markdown", "gdp.ports.kernel.plane", "networkx"),
    *("numpy", "rosidl_generator_py", "rosbags.typesys.stores.ros2_jazzy", "rosbags.typesys.stores.ros1_noetic"),
    *("fog.supervisor.process", "gdp_extensions.doors.node"),
)
# These start programs that a zygote forks.
_STARTERS: Final = {"fog.cli.app", "fog.host.cli", "ring", "internet_demo", "fog_demo", "up", "join", "domain"}
_NATIVE: Final = {"rclpy", "cyclonedds"}  # they leave their network in destructors
_PLAIN: Final = re.compile(r"(?:[\w ./:,=@+%-]|'[^']*')+")  # a shell takes it for words
_PACKAGES: Final = ("gdp", "proxy", "fog", "gdp_extensions", "ring", "internet_demo", "fog_demo", "lab")
_DECODER: Final = re.compile(r"^from proxy\.recordings\.child import main$", re.MULTILINE)  # Python runs it by ``-c``
# On a machine of a laboratory such code is a program; elsewhere it may be about what an import does.
_OURS: Final = re.compile(rf"^(?:from|import) (?:{'|'.join(_PACKAGES)})\b", re.MULTILINE)
_KEPT: Final = ("PYTHONPATH", "PYTHONUNBUFFERED")  # settings of the interpreter that a forked program follows
_SETTINGS: Final = ("PYTHON", "LD_", "COVERAGE")
_LIBRARIES: Final = "LD_LIBRARY_PATH"
_SPACES: Final = ("ipc", "mnt", "pid", "user", "uts")
_LIMITS: Final = tuple(value for name, value in vars(resource).items() if name.startswith("RLIMIT_"))
_REQUEST_BYTES: Final = 1 << 18
_FIRST_FD: Final = 512  # received descriptors wait above this number until each has its own
_SET_PDEATHSIG, _SET_CHILD_SUBREAPER = 1, 36
_PLACE_OF_NAME: Final = "-" * 4096  # an argument, which each forked process replaces with its own command line
_LIBC: Final = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True, slots=True)
class Program:
    """What to run in a forked process: ``module`` as by ``-m``, ``code`` as by ``-c``, or ``file`` as a script."""

    argv: list[str]
    module: str = ""
    code: str = ""
    file: str = ""
    spaces: tuple[str, ...] = ()
    pdeathsig: int = 0
    is_bare: bool = False
    environment: tuple[tuple[str, str], ...] = ()

    @classmethod
    def from_argv(cls, argv: Sequence[str], path: str = "") -> Program | None:
        """Return the project's program that a command line starts; None: another. ``path``: of commands."""
        words = [os.fspath(each) for each in argv]
        spaces, pdeathsig, is_bare, environment = list[str](), 0, False, dict[str, str]()
        while words:
            if words[0] == "nsenter" and len(words) > 2 and words[1].startswith(("--net=", "--mount=")):
                spaces, words = [*spaces, words[1].partition("=")[2]], words[2:]
            elif words[:3] == ["setpriv", "--pdeathsig", "KILL"]:
                pdeathsig, words = signal.SIGKILL, words[3:]
            elif words[:2] == ["env", "-i"]:
                is_bare, environment, words = True, {}, ["env", *words[2:]]
            elif words[0] == "env" and len(words) > 1 and not words[1].startswith("-"):
                words = words[1:]
                while words and "=" in words[0]:
                    name, _, value = words.pop(0).partition("=")
                    environment[name] = value
            elif words[:-1] in (["bash", "-c"], ["bash", "-ec"]) and _PLAIN.fullmatch(words[-1]):
                words = shlex.split(words[-1].removeprefix("exec "))
            else:
                break
            words = words[1:] if words[:1] == ["--"] else words
        words[:1] = [shutil.which(each, path=environment.get("PATH", path)) or each for each in words[:1]]
        if not words or Path(words[0]).parent != Path(sys.executable).parent:
            return None
        values = tuple(environment.items())
        program = cls(words, spaces=tuple(spaces), pdeathsig=pdeathsig, is_bare=is_bare, environment=values)
        if not Path(words[0]).name.startswith("python"):
            return replace(program, file=words[0]) if Path(words[0]).name in _scripts() else None
        if words[1:2] == ["-m"] and len(words) > 2 and words[2].partition(".")[0] in _PACKAGES:
            return replace(program, module=words[2])
        if words[1:2] == ["-c"] and len(words) > 2 and (_DECODER if not spaces else _OURS).search(words[2]):
            return replace(program, code=words[2])
        if len(words) > 1 and words[1].endswith(".py") and Path(words[1]).resolve().is_relative_to(ROOT):
            return replace(program, file=words[1])
        return None


@dataclass(frozen=True, slots=True)
class Request:
    """One program with what its process inherits. ``groups``: control groups that are not the zygote's.

    Descriptors travel with it: 0 to 2, the namespace, a pipe that is closed when the program begins, then ``fds``.
    """

    program: dict[str, Any]
    parent: int
    cwd: str
    environment: dict[str, str]
    limits: list[list[int]]
    groups: list[str]
    fds: list[int]
    new_session: bool
    umask: int


@dataclass(frozen=True, slots=True)
class _Birth:
    """What an interpreter of this installation begins with: ``sys.path`` from its second entry on, and variables."""

    path: list[str]
    added: dict[str, str]


_born: list[_Birth] = []  # set in processes that a zygote has forked


class Zygote:
    """A running zygote, seen by the process that starts it; one request at a time, from any thread."""

    def __init__(self, pid: int, link: socket.socket) -> None:
        self.pid = pid
        self._link = link
        self._lock = threading.Lock()
        self._place, self.groups = _place(), _groups()
        self._settings = _settings(os.environ)
        atexit.register(link.close)  # the zygote ends then

    @classmethod
    def start(cls, modules: Sequence[str] = _PRELOADED) -> Zygote:
        """Start a zygote: in an interpreter of its own, or as a fork of a process that a zygote has forked.

        Call this before there are threads. In the new process it does not return. ``modules``: what one in an
        interpreter of its own imports, in this order.
        """
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            if _born:
                if (pid := os.fork()) == 0:
                    ours.close()
                    os.closerange(3, theirs.fileno())  # a lock that the program inherits ends with the program
                    os.closerange(theirs.fileno() + 1, os.sysconf("SC_OPEN_MAX"))
                    _live(theirs, _born[0])
                return cls(pid, ours)
            environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
            environment["OPENBLAS_NUM_THREADS"] = "1"  # a fork has no other threads
            theirs.set_inheritable(True)
            words = [sys.executable, __file__, str(theirs.fileno()), _PLACE_OF_NAME]
            ours.send(json.dumps(modules).encode())
            return cls(os.posix_spawn(sys.executable, words, environment), ours)

    def fork(self, request: Request, descriptors: Sequence[int]) -> int:
        """Return the process id of a new child of the caller. Raises ``OSError``: the zygote is gone."""
        with self._lock:
            _prctl(_SET_CHILD_SUBREAPER, 1)  # the new process is an orphan for a moment; it becomes our child
            try:
                data = json.dumps(asdict(request)).encode()
                socket.send_fds(self._link, [data], list(descriptors))
                answer = self._link.recv(64)
            finally:
                _prctl(_SET_CHILD_SUBREAPER, 0)
        if not answer:
            raise OSError("the zygote has ended")
        return int(answer)

    def can_run(self, program: Program, environment: Mapping[str, str], cwd: Path) -> bool:
        """Return whether a forked process is the same as an executed one would be."""
        if _settings(environment) != ({} if program.is_bare else self._settings):  # an interpreter adds some by itself
            return False
        first = Path(program.file).parent if program.file else cwd
        folders = [first, *map(Path, filter(None, environment.get("PYTHONPATH", "").split(os.pathsep)))]
        are_ours = all(each.startswith("gdp-") for each in _groups() - self.groups)  # directly below the roots
        return (
            are_ours
            and self._place == _place()
            and not any(
                (each / "sitecustomize.py").exists()
                or ((each / "gdp").is_dir() and not (each / "gdp").samefile(ROOT / "gdp"))
                for each in folders
            )
        )


def install() -> None:
    """Let ``subprocess`` fork what this process starts of the project; call this before there are threads.

    A process whose zygote is installed already keeps it.
    """
    if Popen.zygote is None:
        Popen.zygote = Zygote.start()
        subprocess.Popen = Popen  # type: ignore[misc]


def run_command(module: str) -> None:
    """Run a module's ``main`` in this process. No resource exists while it is imported: Ctrl-C then ends directly."""
    signal.signal(signal.SIGINT, lambda number, _: os._exit(128 + number))
    install()
    importlib.import_module(module).main()


class Popen(subprocess.Popen):  # type: ignore[type-arg]
    """``subprocess.Popen`` that forks the project's own programs from ``zygote``, if there is one."""

    zygote: Zygote | None = None

    def _execute_child(
        self, args: Any, executable: Any, preexec_fn: Any, close_fds: Any, pass_fds: Any, cwd: Any, env: Any, *rest: Any
    ) -> None:
        """Fork, or execute; the arguments are those of the standard library from 3.10 to 3.14."""
        (_, _, shell, *pipes), (_, gid, gids, uid, umask, new_session, *group) = rest[:9], rest[9:]
        is_plain = close_fds and not (shell or executable or preexec_fn or isinstance(args, (str, bytes)))
        is_ours = gid is None and gids is None and uid is None and all(each == -1 for each in group)
        request = self._request(args, pass_fds, cwd, env, new_session, umask) if is_plain and is_ours else None
        if self.zygote is None or request is None:
            super()._execute_child(args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *rest)  # type: ignore[misc]
            return
        p2cread, _, _, c2pwrite, _, errwrite = pipes
        with open("/proc/thread-self/ns/net", "rb") as space:
            standard = [number if each == -1 else each for number, each in enumerate((p2cread, c2pwrite, errwrite))]
            begun, begins = os.pipe()
            try:
                self.pid = self.zygote.fork(request, [*standard, space.fileno(), begins, *request.fds])
            finally:
                os.close(begins)
                with open(begun, "rb") as pipe:
                    pipe.read()
        self._child_created = True
        self._close_pipe_fds(*pipes)  # type: ignore[attr-defined]

    def _request(self, args: Any, pass_fds: Any, cwd: Any, env: Any, new_session: bool, umask: int) -> Request | None:
        """Return what to ask of the zygote; None: a forked process would be another than an executed one."""
        given = os.environ if env is None else env
        program = None if self.zygote is None else Program.from_argv(args, given.get("PATH", ""))
        if self.zygote is None or program is None:
            return None
        environment = {**({} if program.is_bare else given), **dict(program.environment)}
        environment = {os.fsdecode(name): os.fsdecode(value) for name, value in environment.items()}
        folder = Path(os.getcwd() if cwd is None else os.fspath(cwd)).absolute()
        if not folder.is_dir() or not self.zygote.can_run(program, environment, folder):
            return None
        limits = [list(resource.getrlimit(each)) for each in _LIMITS]
        groups, fds = sorted(_groups() - self.zygote.groups), sorted(pass_fds)
        return Request(asdict(program), os.getpid(), str(folder), environment, limits, groups, fds, new_session, umask)


def main() -> None:
    """Import the project, then fork programs until the caller closes its end of the socket."""
    path = sys.path[1:]
    sys.path[:1] = [str(ROOT), str(ROOT / "scripts")]  # of this copy, also where the interpreter has another installed
    link = socket.socket(fileno=int(sys.argv[1]))
    sys.modules["lab.zygote"] = sys.modules["__main__"]  # so that a program keeps the zygote that it was given
    for module in json.loads(link.recv(_REQUEST_BYTES)):
        with contextlib.suppress(ModuleNotFoundError):  # an extra that is not installed
            importlib.import_module(module)
    _build_models()
    started = dict(entry.partition("=")[::2] for entry in Path("/proc/self/environ").read_text().split("\0") if entry)
    added = {name: value for name, value in os.environ.items() if name not in started}
    gc.collect()
    gc.freeze()
    _live(link, _Birth(path, added))


def _build_models() -> None:
    """Build the models of configurations, which a process defers until it reads the first: 40 ms of processor time."""
    pydantic = sys.modules.get("pydantic")
    models = list(pydantic.BaseModel.__subclasses__()) if pydantic else []
    for model in models:
        models += model.__subclasses__()
        if model.model_config.get("defer_build"):
            model.model_rebuild()


def _live(link: socket.socket, birth: _Birth) -> NoReturn:
    """Fork programs until the caller is gone; in each forked process, run its program."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the programs
    program = _serve(link, birth)
    _born[:] = [birth]
    command = program.argv[3 if program.module else 1 :][:1]
    if {program.module, program.module.partition(".")[0], *command} & _STARTERS:  # it starts many programs
        install()
    _finish(program)


def _serve(link: socket.socket, birth: _Birth) -> Program:
    """Return the program to run, in each forked process."""
    while True:
        data, descriptors, _, _ = socket.recv_fds(link, _REQUEST_BYTES, 64)
        if not data:
            os._exit(0)
        gate, opens = os.pipe()
        reads, writes = os.pipe()
        if (between := os.fork()) == 0:
            if child := os.fork():
                os.write(writes, str(child).encode())
                os._exit(0)
            os.close(opens)
            link.detach()  # its number is the program's from now on
            os.read(gate, 1)  # until the caller has adopted us
            return _become(Request(**json.loads(data)), descriptors, birth)
        for each in (gate, writes, *descriptors):
            os.close(each)
        os.waitpid(between, 0)
        link.send(os.read(reads, 64))
        os.close(reads)
        os.close(opens)


def _become(request: Request, descriptors: Sequence[int], birth: _Birth) -> Program:
    """Take over what the process inherits, and return its program."""
    from gdp.host.cgroups import Cgroup  # the zygote has loaded it

    program = Program(**request.program)
    for group in request.groups:
        Cgroup(group).add(os.getpid())
    if request.new_session:
        os.setsid()
    if request.umask >= 0:
        os.umask(request.umask)
    waiting = [fcntl.fcntl(each, fcntl.F_DUPFD, _FIRST_FD) for each in descriptors]
    os.closerange(0, _FIRST_FD)
    space = waiting[3]
    for number, each in zip([0, 1, 2, *request.fds], [*waiting[:3], *waiting[5:]], strict=True):
        os.dup2(each, number, inheritable=True)
    _enter(space)
    os.chdir(request.cwd)
    for path in program.spaces:
        with open(path, "rb") as file:
            _enter(file.fileno())
    for which, limits in zip(_LIMITS, request.limits, strict=True):
        if list(resource.getrlimit(which)) != limits:
            resource.setrlimit(which, (limits[0], limits[1]))
    if program.pdeathsig:
        _prctl(_SET_PDEATHSIG, program.pdeathsig)
        if os.getppid() != request.parent:
            os._exit(128 + program.pdeathsig)
    os.environ.clear()
    os.environ.update({**birth.added, **request.environment})
    first = str(Path(program.file).resolve().parent) if program.file else "" if program.code else os.getcwd()
    paths = filter(None, request.environment.get("PYTHONPATH", "").split(os.pathsep))
    sys.path[:] = [first, *paths, *birth.path]
    _show(program.argv, request.environment)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _open_streams(is_unbuffered=bool(request.environment.get("PYTHONUNBUFFERED")))
    os.closerange(_FIRST_FD, waiting[-1] + 1)
    return program


def _finish(program: Program) -> NoReturn:
    """Run a program and end the process as an interpreter does, but free nothing that the zygote has imported.

    That would copy its pages: 80 ms of processor time. Other ends (an exception, a broken pipe) are the interpreter's.
    """
    status = 0
    try:
        _run(program)
    except SystemExit as error:
        if not isinstance(error.code, int | None):
            raise
        status = error.code or 0
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    with contextlib.suppress(OSError, ValueError):  # of an output that nothing reads
        sys.stdout.flush()
        sys.stderr.flush()
        if _NATIVE.isdisjoint(sys.modules):
            os._exit(status & 0xFF)
    sys.exit(status)


def _run(program: Program) -> None:
    if program.module:
        sys.argv = [program.module, *program.argv[3:]]
        sys.modules.pop(program.module, None)  # as a fresh interpreter, which runs it once, as __main__
        runpy.run_module(program.module, run_name="__main__", alter_sys=True)
        return
    if program.code:
        sys.argv = program.argv[1:2] + program.argv[3:]
        exec(compile(program.code, "<string>", "exec"), {"__name__": "__main__"})
        return
    sys.argv = program.argv[program.argv.index(program.file) :]
    runpy.run_path(program.file, run_name="__main__")


def _open_streams(*, is_unbuffered: bool) -> None:
    """Give standard output and standard error the buffers that a fresh interpreter gives them."""
    if not is_unbuffered:
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(line_buffering=os.isatty(1))
        return
    for name, number, errors in (("stdout", 1, "strict"), ("stderr", 2, "backslashreplace")):
        raw = io.FileIO(number, "wb", closefd=False)
        stream = io.TextIOWrapper(raw, encoding="utf-8", errors=errors, write_through=True)
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)


def _enter(space: int) -> None:
    if _LIBC.setns(space, 0):
        raise OSError(ctypes.get_errno(), "setns")


def _prctl(option: int, value: int) -> None:
    if _LIBC.prctl(option, ctypes.c_ulong(value), 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl")


def _show(argv: Sequence[str], environment: Mapping[str, str]) -> None:
    """Let ``/proc`` show these arguments and variables, written over the zygote's, which may be cut."""
    fields = Path("/proc/self/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    started = set(Path("/proc/self/environ").read_text(encoding="utf-8", errors="replace").split("\0"))
    variables = sorted((f"{name}={value}" for name, value in environment.items()), key=lambda each: each in started)
    for at, words in ((45, argv), (47, variables)):
        start, end = int(fields[at]), int(fields[at + 1])
        text = b"\0".join(map(os.fsencode, words))[: end - start - 1]
        ctypes.memmove(start, text.ljust(end - start, b"\0"), end - start)


def _settings(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that an interpreter or its libraries read before a program can change them.

    A folder of libraries that does not exist is no setting: OpenCV adds one where a process imports it.
    """
    found = {name: value for name, value in environment.items() if name.startswith(_SETTINGS) and name not in _KEPT}
    folders = [each for each in found.pop(_LIBRARIES, "").split(os.pathsep) if os.path.isdir(each)]
    return {**found, **({_LIBRARIES: os.pathsep.join(folders)} if folders else {})}


def _place() -> list[str]:
    """Return what a forked process inherits from the zygote rather than from its caller."""
    return [os.readlink(f"/proc/self/ns/{each}") for each in _SPACES]


def _groups() -> set[str]:
    """Return the names of this process's control groups."""
    return {line.rpartition("/")[2] for line in Path("/proc/self/cgroup").read_text().splitlines()}


@functools.cache
def _scripts() -> frozenset[str]:
    """Return the names of the project's console scripts."""
    return frozenset(
        each.name for each in importlib.metadata.distribution("gdp-ros").entry_points if each.group == "console_scripts"
    )


if __name__ == "__main__":
    main()
