"""Driver for threads over a runtime whose frames the test pushes."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import cast

import pytest

import gdp
from gdp.client.publisher import Publisher
from gdp.ports.plane import HasFileno
from gdp.runtime.runtime import Runtime
from gdp.session.driver import ThreadDriver
from gdp.session.protocol.core import SessionCore

PATIENCE_S = 20.0


class Stub:
    """Core, member, publisher and runtime in one: pushed values arrive, published values are recorded."""

    has_services = False

    def __init__(self) -> None:
        self.member = self
        self.pushing, self._pushed = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._watched: dict[int, Callable[[], None]] = {}
        self.arrived: dict[int, deque[int]] = {}
        self.published: list[bytes] = []
        self.users: set[int] = set()  # threads that took a step
        self.fails = False

    def close(self) -> None:
        self.pushing.close()
        self._pushed.close()

    def push(self, queue: int, *values: int) -> None:
        self.pushing.send(bytes([queue, *values]))

    def queue(self, number: int) -> deque[int]:
        return self.arrived.setdefault(number, deque())

    # runtime
    def watch(self, source: HasFileno, ready: Callable[[], None]) -> None:
        self._watched[source.fileno()] = ready

    def unwatch(self, source: HasFileno) -> None:
        del self._watched[source.fileno()]

    def step(self, latest_s: float | None) -> None:
        self.users.add(threading.get_ident())
        if self.fails:
            raise RuntimeError("broken")
        left_s = None if latest_s is None else max(latest_s - time.monotonic(), 0.0)
        pushed = self._pushed.fileno()
        ready, _, _ = select.select([pushed, *self._watched], [], [], left_s)
        for each in ready:
            if each == pushed:
                queue, *values = self._pushed.recv(1_000)
                self.queue(queue).extend(values)
            else:
                self._watched[each]()

    def send(self) -> bool:
        return False

    # core, member and publisher
    def handle(self, now_s: float) -> None: ...

    def get_timer(self) -> float | None:
        return None

    def flush(self, now_s: float) -> None: ...

    def publish(self, message: bytes, now_s: float) -> None:
        del now_s
        self.published.append(message)


@pytest.fixture
def stub() -> Iterator[Stub]:
    stub = Stub()
    yield stub
    stub.close()


@pytest.fixture
def driver(stub: Stub) -> Iterator[ThreadDriver]:
    driver = ThreadDriver(cast(SessionCore, stub), cast(Runtime, stub))
    yield driver
    stub.fails = False
    driver.close()


def publisher(stub: Stub) -> Publisher:
    return cast(Publisher, stub)


def take(driver: ThreadDriver, stub: Stub, queue: int) -> int:
    """Return the next value of a queue."""
    values = stub.queue(queue)
    assert driver.wait(lambda: bool(values), time.monotonic() + PATIENCE_S)
    return values.popleft()


def in_threads(count: int, work: Callable[[int], object]) -> None:
    """Run ``work`` in this many threads; their errors fail the test."""
    errors: list[BaseException] = []

    def guarded(number: int) -> None:
        try:
            work(number)
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=guarded, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE_S)
    assert not errors
    assert not any(thread.is_alive() for thread in threads)


def test_a_thread_that_waits_drives_the_node_itself(stub: Stub, driver: ThreadDriver) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while threading.get_ident() not in stub.users:  # the driver's own thread may be faster
        assert time.monotonic() < until_s
        stub.push(0, 7)
        assert take(driver, stub, 0) == 7


def test_each_of_several_waiting_threads_gets_its_own(stub: Stub, driver: ThreadDriver) -> None:
    def echo(number: int) -> None:
        for value in range(100):
            stub.push(number, value)
            assert take(driver, stub, number) == value

    in_threads(4, echo)


def test_no_message_is_lost_or_reordered_when_threads_publish_at_once(stub: Stub, driver: ThreadDriver) -> None:
    def publish(number: int) -> None:
        for value in range(500):
            driver.publish(publisher(stub), bytes([number, value // 256, value % 256]))

    in_threads(4, publish)
    driver.run(lambda: None)
    for number in range(4):
        values = [256 * high + low for thread, high, low in stub.published if thread == number]
        assert values == list(range(500))


def test_a_message_is_published_while_another_thread_waits(stub: Stub, driver: ThreadDriver) -> None:
    waiting = threading.Thread(target=take, args=(driver, stub, 0))
    waiting.start()
    driver.publish(publisher(stub), b"x")
    assert driver.wait(lambda: stub.published == [b"x"], time.monotonic() + PATIENCE_S)
    stub.push(0, 1)
    waiting.join(PATIENCE_S)
    assert not waiting.is_alive()


def taken_in(stub: Stub) -> threading.Event:
    """Return an event that is set when a thread receives a pushed value."""
    took, queue = threading.Event(), stub.queue

    def noted(number: int) -> deque[int]:
        took.set()
        return queue(number)

    stub.queue = noted  # type: ignore[method-assign]
    return took


def test_the_background_thread_drives_while_no_thread_waits(stub: Stub, driver: ThreadDriver) -> None:
    took = taken_in(stub)
    stub.push(0, 7)
    assert took.wait(PATIENCE_S)
    assert threading.get_ident() not in stub.users


def test_the_background_thread_takes_over_after_a_thread_has_led_for_long(stub: Stub, driver: ThreadDriver) -> None:
    driver.wait(lambda: False, time.monotonic() + 0.1)  # longer than the grace time: the background thread parks
    took = taken_in(stub)
    stub.push(0, 2)
    assert took.wait(PATIENCE_S)


def test_a_wait_ends_at_its_deadline(stub: Stub, driver: ThreadDriver) -> None:
    assert not driver.wait(lambda: False, time.monotonic() + 0.01)


def test_a_command_returns_its_result_and_raises_its_error(driver: ThreadDriver) -> None:
    assert driver.run(lambda: 5) == 5
    with pytest.raises(ZeroDivisionError):
        driver.run(lambda: 1 // 0)


def test_closing_ends_threads_that_wait(stub: Stub, driver: ThreadDriver) -> None:
    ended: list[BaseException] = []

    def wait() -> None:
        try:
            driver.wait(lambda: False, None)
        except gdp.ClosedError as error:
            ended.append(error)

    threads = [threading.Thread(target=wait) for _ in range(3)]
    for thread in threads:
        thread.start()
    driver.close()
    for thread in threads:
        thread.join(PATIENCE_S)
    assert len(ended) == 3


def test_a_node_that_fails_ends_the_session_with_its_error(stub: Stub, driver: ThreadDriver) -> None:
    stub.fails = True
    stub.push(0, 1)
    with pytest.raises((gdp.ClosedError, RuntimeError), match="broken"):
        driver.wait(lambda: False, time.monotonic() + PATIENCE_S)
    with pytest.raises(gdp.ClosedError, match="open a new one"):
        driver.run(lambda: None)
