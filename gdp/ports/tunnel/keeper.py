"""Keeper of one WireGuard device: a process that makes the device, and removes it when its owner ends in any way.

I/O; a command that ``keeper_process`` starts before the owner confines itself::

    python -m gdp.ports.tunnel.keeper IFNAME ALIAS BACKEND OWNER_PID [UPLINK]

Standard input is a socket pair to the owner. The keeper writes one JSON object a line (``Report``). It ends when the
owner's end is closed or the owner dies, and then nothing of the device is left. Without WireGuard in the kernel it
also runs ``wireguard-go``, and starts it again when it dies. The keeper holds the TUN device, so the device, its
addresses, its routes and the VXLAN devices on it stay meanwhile.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gdp.errors import LocalError
from gdp.intervals import ATTACH_S, LOOK_S, STEADY_S, UPKEEP_S
from gdp.limits import FLIGHT_MAX_BYTES
from gdp.ports.confine.system import prctl
from gdp.ports.netlink import LINK_GROUP, Notifications, RefusedError
from gdp.ports.readiness import readable
from gdp.ports.sockets import AS_ROOT
from gdp.ports.tunnel.control import ControlLostError
from gdp.ports.tunnel.devices import (
    Device,
    add_device,
    find_device,
    make_up,
    refusal_text,
    remove_device,
    remove_own_device,
    set_alias,
    set_mtu,
    set_queue_length,
    without_addresses,
)
from gdp.ports.tunnel.socket_buffers import SocketBuffers
from gdp.ports.tunnel.uapi import SOCKET_FOLDER, UserspaceControl, socket_path
from gdp.ports.tunnel.uplink_routes import UplinkRoutes, mark_of

_PROGRAM: Final = "wireguard-go"
_TUN: Final = Path("/dev/net/tun")
_TUNSETIFF: Final = 0x400454CA
_IFREQ: Final = struct.Struct("16sH22x")
_IFF_TUN, _IFF_NO_PI, _IFF_VNET_HDR = 0x1, 0x1000, 0x4000
_TUN_PI, _TUN_VNET_HDR = 4, 5  # IFLA_TUN_PI, IFLA_TUN_VNET_HDR
_DEATH_SIGNAL, _NO_NEW_PRIVS = 1, 38  # PR_SET_PDEATHSIG, PR_SET_NO_NEW_PRIVS
_END_S: Final = 0.3
_QUEUE_PACKETS: Final = FLIGHT_MAX_BYTES // 1_024  # a whole window while wireguard-go waits for a processor
_RESTART_MIN_S, _RESTART_MAX_S = 0.1, 5.0
_SAID_MAX_BYTES: Final = 4096
_INSTALL: Final = "modprobe wireguard, or apt-get install --no-install-recommends wireguard-go"


@dataclass(slots=True)
class _Child:
    """A running ``wireguard-go``; what it prints explains its end."""

    process: subprocess.Popen[bytes]
    pidfd: int
    begun_s: float
    buffers: SocketBuffers
    said: bytes = b""
    has_output: bool = True

    @property
    def output(self) -> tuple[int, ...]:
        """Return the descriptor of its output while that is open."""
        assert self.process.stdout is not None
        return (self.process.stdout.fileno(),) if self.has_output else ()

    @property
    def reason(self) -> str:
        """Return its last line about an error, or how it ended."""
        if self.process.returncode is not None and self.process.returncode < 0:
            return f"it was ended by signal {-self.process.returncode}"
        lines = [line for line in self.said.decode(errors="replace").splitlines() if line.startswith("ERROR")]
        return lines[-1] if lines else f"it ended with status {self.process.returncode}"

    def read(self) -> None:
        """Read what it printed, without waiting."""
        assert self.process.stdout is not None
        with contextlib.suppress(BlockingIOError):
            while more := os.read(self.process.stdout.fileno(), _SAID_MAX_BYTES):
                self.said = (self.said + more)[-_SAID_MAX_BYTES:]
            self.has_output = False

    def end(self) -> None:
        """End it, with SIGTERM first so that it removes its socket."""
        self.process.terminate()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.close()

    def close(self) -> None:
        """Close the descriptors of a process that ended."""
        self.read()
        assert self.process.stdout is not None
        self.process.stdout.close()
        os.close(self.pidfd)


class _Owner:
    """The socket pair to the owner."""

    def __init__(self) -> None:
        self._socket = socket.socket(fileno=os.dup(0))
        self._watched: dict[int, Callable[[], None]] = {}

    def fileno(self) -> int:
        """Return its descriptor; it is readable once the owner is gone."""
        return self._socket.fileno()

    def watch(self, fd: int, ready: Callable[[], None]) -> None:
        """Call ``ready`` from within ``wait`` whenever a descriptor is readable."""
        self._watched[fd] = ready

    def forget(self) -> None:
        """Treat the owner as gone: it died while another process holds its end of the socket pair."""
        self._socket.shutdown(socket.SHUT_RDWR)

    def report(self, **fields: object) -> None:
        """Write one report; an owner that is gone is seen by ``poll`` afterwards."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self._socket.sendall(json.dumps(fields).encode() + b"\n")

    def wait(self, *others: int, timeout_s: float | None = None) -> bool:
        """Wait for the owner's end or for one of the other descriptors; return whether the owner is still there."""
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            left_s = None if end_s is None else max(end_s - time.monotonic(), 0.0)
            ready = set(readable((self.fileno(), *others, *self._watched), left_s))
            for fd in ready & self._watched.keys():
                self._watched[fd]()
            if self.fileno() in ready:
                return False
            if not ready or ready - self._watched.keys():
                return True


def main(words: Sequence[str]) -> None:
    """Make the device and keep it until the owner ends.

    Args:
        words: name of the device, alias of the owner's devices, ``auto``, ``kernel`` or ``wireguard-go``, the owner's
            process id, and the device that outer packets leave by, if routing does not decide that.
    """
    ifname, alias, backend, owner_pid, uplinks = words[0], words[1], words[2], int(words[3]), words[4:]
    owner = _Owner()
    signal.signal(signal.SIGTERM, lambda *_: owner.forget())
    prctl(_DEATH_SIGNAL, signal.SIGTERM)
    if os.getppid() != owner_pid:
        return
    prctl(_NO_NEW_PRIVS, 1)
    keeper = _Keeper(ifname, alias, owner)
    try:
        for uplink in uplinks:
            keeper.follow(uplink)
        keeper.run(backend)
    except RefusedError as error:
        keeper.owner.report(event="failed", text=f"tunnel {ifname}: the device cannot be made: {refusal_text(error)}")
    except (LocalError, OSError) as error:
        keeper.owner.report(event="failed", text=f"tunnel {ifname}: {error}")
    finally:
        keeper.close()


class _Keeper:
    """The device and, without WireGuard in the kernel, its ``wireguard-go``."""

    def __init__(self, ifname: str, alias: str, owner: _Owner) -> None:
        self.owner = owner
        self._ifname = ifname
        self._alias = alias
        self._control = UserspaceControl(ifname)
        self._tun = -1  # descriptor of the TUN device; the kernel removes the device with its last descriptor
        self._tun_flags = 0
        self._child: _Child | None = None
        self._kernel_ifindex = 0
        self._routes: UplinkRoutes | None = None
        self._early: list[str] = []  # warnings before the device was ready
        self._has_small_buffers = False

    def follow(self, uplink: str) -> None:
        """Let the device's packets leave by an uplink, until it is closed."""
        self._routes = routes = UplinkRoutes(uplink, mark_of(self._ifname))
        if routes.warning:
            self._early.append(routes.warning)

        def sync() -> None:
            """Follow a change of routes."""
            try:
                routes.sync()
            except LocalError as error:
                self.owner.report(event="warning", text=f"routes of {uplink}: {error}")

        self.owner.watch(routes.fileno(), sync)

    def run(self, backend: str) -> None:
        """Make the device, report it, and keep it until the owner ends."""
        if remove_own_device(self._ifname, self._alias):  # its wireguard-go ends with it
            _wait_until(lambda: not _is_listening(self._ifname))
        reason = "" if backend == "wireguard-go" else self._make_kernel_device()
        if self._kernel_ifindex:
            self._report_ready("kernel", "")
            self.owner.wait()
            return
        if backend == "kernel":
            raise LocalError(f"no WireGuard: {reason}; {_INSTALL}")
        program = self._program(reason)
        self._tun_flags = self._probe(program)
        self._make_tun()
        self._start(program)
        self._report_ready(_PROGRAM, reason or "the configuration states it")
        self._supervise(program)

    def close(self) -> None:
        """Remove everything that was made."""
        if self._child is not None:
            self._child.end()
            if not _is_listening(self._ifname):  # else the next run of this switch has it already
                socket_path(self._ifname).unlink(missing_ok=True)
        if self._tun >= 0:
            os.close(self._tun)
        if self._kernel_ifindex:
            remove_device(self._kernel_ifindex)
        if self._routes is not None:
            self._routes.close()

    def _report_ready(self, backend: str, reason: str) -> None:
        self.owner.report(event="ready", backend=backend, reason=reason)
        for text in self._early:
            self.owner.report(event="warning", text=text)

    def _make_kernel_device(self) -> str:
        """Make the device in the kernel; return why that is not possible."""
        try:
            add_device(self._ifname, "wireguard")
        except RefusedError as error:
            if error.number not in (errno.EOPNOTSUPP, errno.ENODEV):
                raise
            return "this kernel has no WireGuard"
        device = self._found()
        self._kernel_ifindex = device.ifindex
        set_alias(device.ifindex, self._alias)
        self._prepare(device)
        return ""

    def _program(self, reason: str) -> str:
        program = shutil.which(_PROGRAM, path=f"{os.environ.get('PATH', '')}:/usr/bin:/usr/sbin:/usr/local/bin")
        if program is None:
            kernel = f"{reason} and " if reason else ""
            raise LocalError(f"no WireGuard: {kernel}{_PROGRAM} is not installed; {_INSTALL}")
        if not _TUN.exists():
            raise LocalError(
                f"{_PROGRAM} needs {_TUN}, which does not exist; modprobe tun, or give it to the container"
            )
        if _is_listening(self._ifname):
            raise LocalError(f"another {_PROGRAM} serves {socket_path(self._ifname)}; end it first")
        try:
            SOCKET_FOLDER.mkdir(mode=0o755, parents=True, exist_ok=True)
            if not os.access(SOCKET_FOLDER, os.W_OK | os.X_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            socket_path(self._ifname).unlink(missing_ok=True)  # of a killed process
        except OSError as error:
            raise LocalError(f"{_PROGRAM} needs to write to {SOCKET_FOLDER} ({error.strerror}); {AS_ROOT}") from error
        return program

    def _probe(self, program: str) -> int:
        """Return the flags with which this version of the program opens TUN devices."""
        with contextlib.closing(Notifications(LINK_GROUP)) as news:
            child = self._spawn(program, {})
            try:
                end_s = time.monotonic() + ATTACH_S
                while (device := find_device(self._ifname)) is None or device.kind != "tun":
                    if child.process.poll() is not None or time.monotonic() > end_s:
                        child.read()
                        raise LocalError(f"{_PROGRAM} does not start: {child.reason}")
                    self.owner.wait(child.pidfd, news.fileno(), timeout_s=end_s - time.monotonic())
                    news.has_news()
            finally:
                child.end()
                socket_path(self._ifname).unlink(missing_ok=True)
        has_header = device.data.get(_TUN_PI, b"\1") == b"\1"
        has_offloads = device.data.get(_TUN_VNET_HDR, b"\0") == b"\1"
        return _IFF_TUN | (0 if has_header else _IFF_NO_PI) | (_IFF_VNET_HDR if has_offloads else 0)

    def _make_tun(self) -> None:
        if self._tun >= 0:
            os.close(self._tun)
            self._tun = -1
        try:
            self._tun = os.open(_TUN, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)
            fcntl.ioctl(self._tun, _TUNSETIFF, _IFREQ.pack(self._ifname.encode(), self._tun_flags))
        except PermissionError as error:
            raise LocalError(f"{_TUN}: not permitted; {AS_ROOT}") from error
        device = self._found()
        set_alias(device.ifindex, self._alias)
        set_queue_length(device.ifindex, _QUEUE_PACKETS)
        self._prepare(device)

    def _prepare(self, device: Device) -> None:
        """Switch the device on, with IPv6 and without addresses of the kernel's choice."""
        switch = Path(f"/proc/sys/net/ipv6/conf/{self._ifname}/disable_ipv6")
        try:
            if switch.read_text(encoding="ascii").strip() != "0":
                switch.write_text("0", encoding="ascii")
        except OSError as error:
            raise LocalError(f"tunnels need IPv6 inside, and this system has it off ({switch}: {error})") from error
        without_addresses(device.ifindex)
        make_up(device.ifindex)

    def _start(self, program: str) -> None:
        """Start the program on the TUN device; return when it serves."""
        mtu = self._found().mtu
        socket_path(self._ifname).unlink(missing_ok=True)
        child = self._spawn(program, {"WG_TUN_FD": str(self._tun)})
        end_s = time.monotonic() + ATTACH_S
        while not self._serves():
            if child.process.poll() is not None or time.monotonic() > end_s:
                child.end()
                raise LocalError(f"{_PROGRAM} does not start: {child.reason}")
            if not self.owner.wait(child.pidfd, timeout_s=LOOK_S):  # no event says that it serves
                child.end()
                raise SystemExit
        self._child = child
        set_mtu(self._found().ifindex, mtu)  # the program sets its own default

    def _serves(self) -> bool:
        """Return whether the program replies and has opened its UDP sockets."""
        try:
            return self._control.state().listen_port != 0
        except ControlLostError:
            return False

    def _supervise(self, program: str) -> None:
        """Start the program again whenever it ends, until the owner ends."""
        delay_s = 0.0
        while True:
            child = self._child
            if child is not None:
                self._enlarge_buffers(child)
                if not self.owner.wait(child.pidfd, *child.output, timeout_s=UPKEEP_S):
                    return
                child.read()
                if child.process.poll() is None:
                    continue
                child.close()
                self._child = None
                delay_s = 0.0 if time.monotonic() - child.begun_s > STEADY_S else max(delay_s, _RESTART_MIN_S)
                self.owner.report(event="died", text=child.reason)
            if not self.owner.wait(timeout_s=delay_s):
                return
            delay_s = min(max(2 * delay_s, _RESTART_MIN_S), _RESTART_MAX_S)
            try:
                is_same = self._is_present()
                if not is_same:
                    self._make_tun()
                self._start(program)
            except (LocalError, OSError) as error:
                self.owner.report(event="died", text=str(error))
            else:
                self.owner.report(event="restarted", is_same=is_same)

    def _enlarge_buffers(self, child: _Child) -> None:
        """Enlarge the buffers of sockets that the program opened; the first refusal is a warning."""
        try:
            child.buffers.enlarge()
        except LocalError as error:
            if not self._has_small_buffers:
                self._has_small_buffers = True
                self.owner.report(event="warning", text=str(error))

    def _is_present(self) -> bool:
        """Return whether our TUN device still exists; another program may have removed it."""
        device = find_device(self._ifname)
        if device is not None and device.alias != self._alias:
            raise LocalError(f"another program made a device {self._ifname}")
        return device is not None

    def _found(self) -> Device:
        device = find_device(self._ifname)
        if device is None:
            raise LocalError("another program removed the device")
        return device

    def _spawn(self, program: str, environment: dict[str, str]) -> _Child:
        keeper_pid = os.getpid()

        def prepare() -> None:
            """Let the kernel end the program when this process dies, and let its threads interrupt no sender."""
            prctl(_DEATH_SIGNAL, signal.SIGTERM)
            with contextlib.suppress(OSError):  # where a container refuses, each frame interrupts its sender
                if os.sched_getscheduler(0) == os.SCHED_OTHER:  # a real-time class stays
                    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
            if os.getppid() != keeper_pid:
                os._exit(1)

        process = subprocess.Popen(
            [program, "-f", self._ifname],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={"LOG_LEVEL": "error", **environment},
            pass_fds=[self._tun] if environment else [],
            preexec_fn=prepare,  # noqa: PLW1509  this process has one thread
        )
        assert process.stdout is not None
        os.set_blocking(process.stdout.fileno(), False)
        pidfd = os.pidfd_open(process.pid)
        return _Child(process, pidfd, time.monotonic(), SocketBuffers(process.pid, pidfd))


def _is_listening(ifname: str) -> bool:
    """Return whether a process serves the control socket of this name."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(socket_path(ifname)))
        except OSError:
            return False
        return True


def _wait_until(is_true: Callable[[], bool]) -> None:
    """Return when this is true, at the latest after a second; the next step reports what is wrong then."""
    end_s = time.monotonic() + 1.0
    while not is_true() and time.monotonic() < end_s:
        time.sleep(LOOK_S)


if __name__ == "__main__":
    main(sys.argv[1:])
