"""Minimal Debian with cloud-init and systemd: the image of a data centre's machines, and a machine that boots it.

I/O; needs root and mmdebstrap. The image is built once (about 40 s) with packages of this machine's apt sources, and
kept in ``$GDP_TEST_CACHE``, else in ``~/.cache/gdp-ros``; a changed recipe builds another one. Machines only read it.

Packages that user data asks for are not installed in it. They are in a repository in the image, ``/srv/packages``,
which is the only source of its apt: so a machine installs packages without a network.

A booted machine has namespaces, an overlay over the image, and systemd as process 1. Its folder, namespaces and control
group are in the record of the run, so ``Run.end`` and a sweep of the registry remove them also after the creator was
killed. The machine cannot outlive its first process.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import shutil
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from gdp.host.cgroups import Cgroup
from gdp.host.run_registry import Run
from lab.datacenter import Lease

_INCLUDED: Final = (
    "ca-certificates",
    "cloud-init",
    "dbus",
    "iproute2",
    "netbase",
    "openssh-client",
    "python3",
    "systemd",
    "systemd-sysv",
    "util-linux",
)
_OFFERED: Final = ("python3-venv", "wireguard-go")  # what user data installs beyond these
_PATIENCE_S: Final = 560.0
_REPOSITORY: Final = "srv/packages"
_CLOUD_CONFIG: Final = """datasource_list: [Ec2]
datasource:
  Ec2:
    strict_id: false  # a namespace has no SMBIOS that names Amazon
    metadata_urls: ["http://169.254.169.254"]
    max_wait: 20
    timeout: 5
locale: false  # the image has the locale C only
"""
_NETWORK: Final = "[Network]\nIPv6AcceptRA=no\n"  # no router advertises, for which networkd would wait 12 s
_MASKED: Final = ("console-getty.service", "getty@.service", "apt-daily.timer")
_ENABLED: Final = ("systemd-networkd.service",)
_BOOT: Final = Path(__file__).with_name("boot.sh")
_SPACES: Final = ("--mount", "--pid", "--uts", "--ipc", "--cgroup", "--fork", "--kill-child")
_COMMAND_S: Final = 120.0


def why_not() -> str:
    """Return why no machine can boot here; empty: it can."""
    if os.getuid() != 0 or Path("/proc/self/uid_map").read_text(encoding="ascii").split()[2] != "4294967295":
        return "needs root outside any user namespace: the machines mount file systems"
    if missing := [each for each in ("mmdebstrap", "nft", "unshare") if shutil.which(each) is None]:
        return f"needs {', '.join(missing)}: scripts/setup.sh --dev installs it"
    return ""


def cache_folder() -> Path:
    """Return the folder of what tests keep between runs."""
    given = os.environ.get("GDP_TEST_CACHE")
    folder = Path(given) if given else Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "gdp-ros"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def built_once(kind: str, recipe: str, build: Callable[[Path], object]) -> Path:
    """Return a folder that is kept between runs, and built if there is none of this recipe; older ones are deleted."""
    kept = cache_folder() / f"{kind}-{hashlib.sha256(recipe.encode()).hexdigest()[:12]}"
    with (cache_folder() / f"{kind}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            for older in cache_folder().glob(f"{kind}-*"):
                shutil.rmtree(older)
            fresh = Path(tempfile.mkdtemp(prefix="new-", dir=cache_folder()))
            try:
                build(fresh / "made")
                (fresh / "made").rename(kept)
            finally:
                shutil.rmtree(fresh, ignore_errors=True)
    return kept


def debian_root() -> Path:
    """Return the image's folder; it is built first if it is not there.

    Raises:
        subprocess.CalledProcessError: a package cannot be had.
    """
    recipe = repr((_codename(), _INCLUDED, _OFFERED, _CLOUD_CONFIG, _NETWORK, _MASKED, _ENABLED, _sources(Path("/"))))
    return built_once("debian", recipe, _build)


def _build(root: Path) -> None:
    offered = " ".join(_OFFERED)
    download = f'chroot "$1" apt-get install -qq --yes --no-install-recommends --download-only {offered}'
    _run(
        "mmdebstrap",
        "--quiet",
        "--variant=minbase",
        f"--include={','.join(_INCLUDED)}",
        "--skip=cleanup/apt",
        '--customize-hook=rm -f "$1"/var/cache/apt/archives/*.deb',
        f"--customize-hook={download}",
        _codename(),
        str(root),
    )
    repository = root / _REPOSITORY
    repository.mkdir(parents=True)
    records = []
    for package in sorted((root / "var/cache/apt/archives").glob("*.deb")):
        fields = _run("dpkg-deb", "--field", str(package)).rstrip()
        digest = hashlib.sha256(package.read_bytes()).hexdigest()
        records.append(f"{fields}\nFilename: ./{package.name}\nSize: {package.stat().st_size}\nSHA256: {digest}\n")
        package.rename(repository / package.name)
    (repository / "Packages").write_text("\n".join(records), encoding="utf-8")
    for source in _sources(root):
        (root / source).unlink()
    (root / "etc/apt/sources.list").write_text(f"deb [trusted=yes] file:/{_REPOSITORY} ./\n", encoding="ascii")
    for lists in (root / "var/lib/apt/lists").glob("*_*"):
        lists.unlink()
    (root / "etc/cloud/cloud.cfg.d/90_ec2.cfg").write_text(_CLOUD_CONFIG, encoding="ascii")
    drop_in = root / "etc/systemd/network/10-cloud-init-eth0.network.d"  # cloud-init makes the file without ".d"
    drop_in.mkdir(parents=True)
    (drop_in / "no-advertisements.conf").write_text(_NETWORK, encoding="ascii")
    (root / "etc/resolv.conf").write_text("nameserver 127.0.0.1\n", encoding="ascii")  # refuses at once
    for unit in _MASKED:
        (root / "etc/systemd/system" / unit).symlink_to("/dev/null")
    _run("systemctl", f"--root={root}", "enable", "--quiet", *_ENABLED)
    (root / "etc/machine-id").write_text("uninitialized\n", encoding="ascii")


def _sources(root: Path) -> list[str]:
    folder = root / "etc/apt"
    found = [*folder.glob("sources.list"), *folder.glob("sources.list.d/*")]
    return sorted(str(each.relative_to(root)) for each in found)


def _codename() -> str:
    return platform.freedesktop_os_release()["VERSION_CODENAME"]


def _run(*words: str) -> str:
    return subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True, timeout=_PATIENCE_S).stdout


class BootedMachine:
    """Machine that boots ``image``; ``ended`` is called from a thread when its first process has ended."""

    def __init__(
        self, run: Run, name: str, image: Path, lease: Lease, ended: Callable[[], None] = lambda: None
    ) -> None:
        self.name = name
        self.lease = lease
        self.root = run.directory / name / "upper"  # what the machine has written
        self._ended = ended
        self._console = bytearray()
        self._group = Cgroup(f"gdp-{run.id}-{name}")
        run.plan_cgroup(self._group.name)
        self._group.make()
        network = self.root / "etc/cloud/cloud.cfg.d/91_network.cfg"
        network.parent.mkdir(parents=True, exist_ok=True)  # a machine that boots again has it
        network.write_text(lease.network_config, encoding="ascii")
        self._master, slave = os.openpty()
        argv = ["unshare", *_SPACES, str(_BOOT), str(run.directory / name), str(image), os.ttyname(slave)]
        held = ["sh", "-c", 'read -r go && exec "$@"', "boot", *lease.namespace.command(argv, dies_with_us=False)]
        self._process = subprocess.Popen(
            held, stdin=subprocess.PIPE, stdout=slave, stderr=slave, start_new_session=True
        )
        try:
            self._group.add(self._process.pid)
            run.note_process(self._process.pid)
        finally:
            with self._process.stdin as go:  # type: ignore[union-attr]  # a pipe, as requested above
                go.write(b"go\n")
        self._slave = slave  # held open, so that the console exists between two of its users
        self._reader = threading.Thread(target=self._read, name=f"console of {name}", daemon=True)
        self._waiter = threading.Thread(target=self._wait, name=f"waits for {name}", daemon=True)
        self._reader.start()
        self._waiter.start()

    @property
    def console(self) -> str:
        """Return the output on the machine's console."""
        return self._console.decode(errors="replace").replace("\r\n", "\n")

    @property
    def is_up(self) -> bool:
        """Return whether the machine's first process lives."""
        return self._process.poll() is None

    def read(self, path: str) -> str:
        """Return a file that the machine has written; empty: it has not."""
        try:
            return (self.root / path.lstrip("/")).read_text(encoding="utf-8", errors="replace")
        except (FileNotFoundError, NotADirectoryError):
            return ""

    def run(self, *words: str) -> str:
        """Run a command in the machine, as root, and return its output.

        Raises:
            subprocess.CalledProcessError: it failed; ``stderr`` says why.
        """
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text(encoding="ascii")
        enter = ["nsenter", f"--target={children.split()[0]}", "--all", "--", *words]
        return subprocess.run(enter, check=True, capture_output=True, text=True, timeout=_COMMAND_S).stdout

    def power_off(self) -> None:
        """End the machine at once, as a provider does, and return when all its processes have ended."""
        with suppress(ProcessLookupError):  # it has powered itself off
            os.killpg(self._process.pid, signal.SIGKILL)
        self._waiter.join(_COMMAND_S)
        self._group.kill()
        self._group.remove()

    def _read(self) -> None:
        try:
            while data := os.read(self._master, 1 << 16):
                self._console += data
        except OSError:
            pass  # the terminal has no user any more
        finally:
            os.close(self._master)

    def _wait(self) -> None:
        self._process.wait()
        os.close(self._slave)
        self._ended()
