"""Booted machine: namespaces, an overlay over the image, and systemd as process 1.

I/O; needs root. The machine's folder, namespaces and control group are in the record of the run, so ``Run.end`` and a
sweep of the registry remove them also after the creator was killed. The machine cannot outlive its first process.
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from gdp.host.cgroups import Cgroup
from gdp.host.run_registry import Run
from netns_tests.datacenter.router import Lease

_BOOT: Final = Path(__file__).with_name("boot.sh")
_SPACES: Final = ("--mount", "--pid", "--uts", "--ipc", "--cgroup", "--fork", "--kill-child")
_PATIENCE_S: Final = 120.0


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
        return subprocess.run(enter, check=True, capture_output=True, text=True, timeout=_PATIENCE_S).stdout

    def power_off(self) -> None:
        """End the machine at once, as a provider does, and return when all its processes have ended."""
        with suppress(ProcessLookupError):  # it has powered itself off
            os.killpg(self._process.pid, signal.SIGKILL)
        self._waiter.join(_PATIENCE_S)
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
