"""Notifications to the service manager: they come from the loop, and only this process sends them."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.host.service_notifier import ServiceNotifier
from gdp.links.relay_loop import RelayLoop


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.setblocking(False)
        yield listening


def environment(manager: socket.socket, **more: str) -> dict[str, str]:
    return {"NOTIFY_SOCKET": manager.getsockname(), "PATH": "/bin", **more}


def received(manager: socket.socket) -> list[str]:
    texts = []
    while True:
        try:
            texts.append(manager.recv(512).decode())
        except BlockingIOError:
            return texts


def test_the_first_beat_says_ready_and_each_one_that_the_loop_turns(manager: socket.socket) -> None:
    notifier = ServiceNotifier.from_environment(environment(manager, WATCHDOG_USEC="30000000"))
    assert received(manager) == []
    notifier.beat()
    notifier.beat()
    notifier.close()
    notifier.close()
    assert received(manager) == ["READY=1\nWATCHDOG=1", "WATCHDOG=1", "STOPPING=1"]
    assert notifier.period_s == 10.0


def test_a_service_without_a_watchdog_says_ready_once(manager: socket.socket) -> None:
    notifier = ServiceNotifier.from_environment(environment(manager))
    notifier.beat()
    notifier.beat()
    assert received(manager) == ["READY=1"]
    notifier.close()


def test_the_watchdog_of_another_process_is_not_fed(manager: socket.socket) -> None:
    other = environment(manager, WATCHDOG_USEC="30000000", WATCHDOG_PID=str(os.getppid()))
    notifier = ServiceNotifier.from_environment(other)
    notifier.beat()
    notifier.beat()
    assert received(manager) == ["READY=1"]
    notifier.close()


def test_children_do_not_inherit_the_address(manager: socket.socket) -> None:
    variables = environment(manager, WATCHDOG_USEC="30000000", WATCHDOG_PID=str(os.getpid()))
    ServiceNotifier.from_environment(variables).close()
    assert variables == {"PATH": "/bin"}


def test_an_address_in_the_abstract_namespace_is_reached() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind("")  # the kernel gives it an abstract address
        address = "@" + listening.getsockname()[1:].decode()
        notifier = ServiceNotifier.from_environment({"NOTIFY_SOCKET": address})
        notifier.beat()
        assert listening.recv(64) == b"READY=1"
        notifier.close()


def test_ready_is_said_again_while_the_manager_cannot_take_it(manager: socket.socket) -> None:
    notifier = ServiceNotifier.from_environment(environment(manager))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
        other.connect(manager.getsockname())
        other.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while other.send(b"x"):
                pass  # until the manager's queue is full
    notifier.beat()
    received(manager)
    notifier.beat()
    assert received(manager) == ["READY=1"]
    notifier.close()


@pytest.mark.parametrize("timeout", ["-1", "0", "soon"])
def test_a_timeout_that_is_no_number_is_refused(manager: socket.socket, timeout: str) -> None:
    with pytest.raises(LocalError, match="WATCHDOG_USEC"):
        ServiceNotifier.from_environment(environment(manager, WATCHDOG_USEC=timeout))


def test_an_address_without_a_manager_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match="NOTIFY_SOCKET"):
        ServiceNotifier.from_environment({"NOTIFY_SOCKET": str(tmp_path / "none")})


def test_a_loop_beats_only_where_a_manager_listens(manager: socket.socket) -> None:
    registered: list[tuple[float, Callable[[object], None]]] = []
    ServiceNotifier.from_environment({}).follow(lambda period, look: registered.append((period, look)))
    assert registered == []
    notifier = ServiceNotifier.from_environment(environment(manager, WATCHDOG_USEC="3000000"))
    notifier.follow(lambda period, look: registered.append((period, look)))
    ((period, look),) = registered
    look(None)
    assert (period, received(manager)) == (1.0, ["READY=1\nWATCHDOG=1"])
    notifier.close()


def test_the_relays_loop_calls_each_function_in_its_own_period() -> None:
    loop, calls = RelayLoop(), list[object]()
    loop.every(1_000.0, calls.append)
    loop.wake_at(0.0)
    loop.step()
    loop.wake_at(0.0)  # other timers are due more often
    loop.step()
    loop.close()
    assert len(calls) == 1
