"""Page of the live view in headless Chromium: what it shows, keys, and a silent console. Pictures are artefacts."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from gdp.management.control_socket import CONTROL_SOCKET, ControlHandlers, serve_control_in_thread
from gdp_extensions.dashboard.server import POLL_S, DashboardServer
from tests.browser import console_errors, needs_browser, open_browser, prefer_scheme, save_picture
from tests.gdp_extensions.dashboard.synthetic_nodes import SyntheticNetwork, serve_network
from tests.gdp_extensions.dashboard.test_server import running

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

pytestmark = [needs_browser, pytest.mark.filterwarnings("ignore::ResourceWarning")]

PATIENCE_S = 20.0


class Page:
    """The page of a running server."""

    def __init__(self, driver: Chrome, server: DashboardServer) -> None:
        self.driver = driver
        self.server = server
        driver.get(server.url)
        self.until("return !!document.body.dataset.updated && performance.getEntriesByName('first-picture').length")

    def run(self, script: str) -> object:
        """Return the value of a script."""
        value: object = self.driver.execute_script(script)
        return value

    def until(self, script: str) -> object:
        """Return the value of a script once it is true."""
        end_s = time.monotonic() + PATIENCE_S
        while not (value := self.run(script)):
            assert time.monotonic() < end_s, script
        return value

    def press(self, *keys: str) -> None:
        """Press keys, one after another."""
        from selenium.webdriver import ActionChains

        ActionChains(self.driver).send_keys(*keys).perform()

    def text(self, css: str) -> str:
        """Return the text of an element."""
        return str(self.run(f"return document.querySelector({css!r}).innerText"))


Open = Callable[..., Page]


@pytest.fixture(scope="module")
def browser() -> Iterator[Chrome]:
    """A browser of all tests: each page has an origin of its own, and so its own storage."""
    with open_browser() as driver:
        yield driver


@pytest.fixture
def opened(browser: Chrome, tmp_path: Path) -> Iterator[Open]:
    """A function that opens the page of a network."""
    with ExitStack() as stack:

        def open_page(network: SyntheticNetwork, *states: Path, is_dark: bool = False) -> Page:
            nodes = stack.enter_context(serve_network(network, tmp_path))
            server = stack.enter_context(running(nodes, states, poll_s=POLL_S))
            prefer_scheme(browser, is_dark=is_dark)
            stack.callback(console_errors, browser)  # those of the closed page are no other's
            stack.callback(browser.get, "about:blank")
            return Page(browser, server)

        yield open_page


def ring() -> SyntheticNetwork:
    """Return a ring of five."""
    return SyntheticNetwork(5, 4, 24, is_ring=True)


def test_a_click_on_a_name_shows_its_path_and_tree(opened: Open) -> None:
    page = opened(ring())
    save_picture(page.driver, "dashboard-ring-light")
    page.run("document.querySelector('#list .row').click()")
    page.until("return document.querySelector('#detail').innerText.includes('switch by switch')")
    detail = page.text("#detail").splitlines()
    assert detail[0] == "/plan"
    assert [line.split()[0] for line in detail if "→" in line] == ["switch0", "switch1", "switch2", "switch3"]
    assert page.text("#hint") == "Path and tree of /plan"
    save_picture(page.driver, "dashboard-ring-name")
    assert console_errors(page.driver) == []


def test_the_page_is_used_by_keyboard_alone(opened: Open) -> None:
    from selenium.webdriver.common.keys import Keys

    page = opened(ring())
    page.press("/", "camera", Keys.ARROW_DOWN, Keys.ENTER)
    assert page.text("#detail h3") == "/robot0/camera/image"
    page.press("g", Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, Keys.ENTER)
    assert page.text("#detail h3").startswith(("switch", "robot", "rib"))
    page.press(Keys.ESCAPE)
    assert page.text("#detail h2") == "Selection"
    before = page.run("return document.documentElement.dataset.theme")
    page.press("t")
    assert page.run("return document.documentElement.dataset.theme") != before
    page.press("?")
    assert page.run("return document.getElementById('help').open")
    page.press(Keys.ESCAPE)
    assert page.run("return document.getElementById('help').open") is False
    assert console_errors(page.driver) == []


def test_every_control_is_reached_by_tab(opened: Open) -> None:
    from selenium.webdriver.common.keys import Keys

    page = opened(ring())
    reached = set()
    for _ in range(40):
        page.press(Keys.TAB)
        reached.add(page.run("return document.activeElement.id || document.activeElement.textContent"))
    assert {"theme", "keys", "search", "list", "graph", "zoom-in", "zoom-fit", "events", "Active"} <= reached


def test_dark_follows_the_system(opened: Open) -> None:
    page = opened(ring(), is_dark=True)
    assert page.run("return document.documentElement.dataset.theme") == "dark"
    save_picture(page.driver, "dashboard-ring-dark")
    assert console_errors(page.driver) == []


def test_a_change_is_on_the_page_at_the_next_poll(opened: Open) -> None:
    network = ring()
    page = opened(network)
    network.stopped.add("robot3")
    page.until("return [...document.querySelectorAll('#events li')].some((each) => each.innerText.includes('robot3'))")
    assert page.run("return document.querySelector('#state').dataset.state") == "live"


def test_two_hundred_nodes_and_five_thousand_names_are_shown(opened: Open) -> None:
    page = opened(SyntheticNetwork(60, 136, 5_000), is_dark=True)
    page.until("return document.querySelector('#names-count').innerText === '5001'")
    assert int(str(page.run("return document.querySelectorAll('#list .row').length"))) < 60
    page.until("return document.querySelector('#totals').innerText.includes('200')")
    save_picture(page.driver, "dashboard-200-dark")
    page.press("t")
    save_picture(page.driver, "dashboard-200-light")
    assert console_errors(page.driver) == []


def test_a_fog_cluster_shows_its_machines_and_events(opened: Open, tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir()
    machine = {"name": "m1", "stage": "preempted", "type": "c5.large", "spot": True, "region": "us-east-1"}
    cluster = {"name": "planner", "wanted": 3, "serving": 2, "usd_per_hour": 0.08, "machines": [machine]}
    event = {"unix_s": 5.0, "cluster": "planner", "text": "planner m1: preempted"}
    handlers = ControlHandlers(
        reload=lambda: None,
        status=dict,
        drain=lambda: None,
        snapshot=lambda: {"role": "supervisor", "clusters": [cluster], "events": [event]},
    )
    with serve_control_in_thread(state / CONTROL_SOCKET, handlers):
        page = opened(ring(), state)
        page.until("return !document.getElementById('clusters-card').hidden")
        assert "planner: 2 of 3 serve, $0.080 an hour" in page.text("#clusters")
        assert "preempted" in page.text("#clusters table")
        assert "planner m1: preempted" in page.text("#events")
        save_picture(page.driver, "dashboard-cluster-light")
        assert console_errors(page.driver) == []


def test_a_label_with_markup_stays_text(opened: Open) -> None:
    network = ring()
    label = "<img src=x onerror=document.title='taken'>"
    network.rename("robot1", label)
    page = opened(network)
    page.until("return document.querySelector('#totals').innerText.includes('11')")
    page.press("/", "robot1")
    page.run("document.querySelector('#list .row').click()")
    assert label in page.text("#detail")
    assert page.run("return document.title") == "GDP live view"
    assert console_errors(page.driver) == []
