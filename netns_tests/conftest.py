"""Fixtures for network namespaces: the reason to skip, and a fresh namespace for each test."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import pytest

from gdp.errors import LocalError
from gdp.host.run_registry import RunRegistry
from gdp.ports.kernel.plane import KernelPlane
from gdp.switch.table import Table
from lab.internet.laboratory import TOOLS, Laboratory
from lab.machine import LabMachine
from lab.namespaces import Space
from lab.process import python_path
from netns_tests import lifetimes
from tests.fixtures_forwarding import IN, IN_MAC, MTUS, NARROW, NARROW_MAC, PEER_MACS, WIDE, WIDE_MAC
from tests.pages import ROOT

MakeKernel = Callable[..., KernelPlane]
PORT_MACS = {IN: IN_MAC, WIDE: WIDE_MAC, NARROW: NARROW_MAC}


def pytest_configure() -> None:
    """Let the processes that tests start import the project and its laboratory."""
    os.environ["PYTHONPATH"] = python_path()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, None, None]:
    lifetimes.noted.clear()
    yield
    if complaint := lifetimes.too_short(lifetimes.noted, item.get_closest_marker("momentary")):
        pytest.fail(complaint, pytrace=False)


def _why_not() -> str:
    """Return why tests with real namespaces cannot run here; empty if they can."""
    if None in map(shutil.which, ("nsenter", "setpriv")):
        return "nsenter or setpriv is not installed (util-linux)"
    try:
        with Space(), socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0):
            return ""
    except OSError as error:
        return f"needs root, or a user namespace with its own network: {error.strerror}"


_REASON = _why_not()


def pytest_runtest_setup(item: pytest.Item) -> None:
    if _REASON and item.get_closest_marker("netns"):
        pytest.skip(_REASON)


def _make_clone(tree: Path) -> None:
    """Clone this tree into a folder that does not exist; skips the test where it is no clone itself."""
    if not (ROOT / ".git").exists():
        pytest.skip("this tree is no clone of its repository")
    _git("clone", "--quiet", str(ROOT), str(tree))
    changed = _git("-C", str(ROOT), "diff", "--name-only", "-z", "HEAD")
    added = _git("-C", str(ROOT), "ls-files", "--others", "--exclude-standard", "-z")
    for path in filter(None, f"{changed}{added}".split("\0")):
        if (ROOT / path).exists():
            (tree / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / path, tree / path)
        else:
            (tree / path).unlink()


def _git(*words: str) -> str:
    argv = ["git", "-c", "safe.directory=*", *words]
    return subprocess.run(argv, check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="session")
def in_clone(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Return a function that runs a script by its path in a clone that has nothing around it."""
    tree = tmp_path_factory.mktemp("clone") / "main"
    _make_clone(tree)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tree), str(tree / "scripts")))}

    def run(script: str, *words: str, patience_s: float) -> subprocess.CompletedProcess[str]:
        argv = [sys.executable, str(tree / script), *words]
        return subprocess.run(
            argv, cwd=tree, env=environment, capture_output=True, text=True, timeout=patience_s, check=False
        )

    return run


@pytest.fixture
def space() -> Iterator[Space]:
    """Network namespace of its own, in which the test runs."""
    with Space() as entered:
        yield entered


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[LabMachine]:
    """LabMachine in the namespace of the test, for the processes that it starts."""
    with LabMachine(tmp_path) as made:
        yield made


@pytest.fixture
def make_kernel(space: Space) -> Iterator[MakeKernel]:
    """Factory of kernel planes on p0 to p2, whose links exist; the planes are closed at the end."""
    for port, mac in PORT_MACS.items():
        space.veth(f"p{port}", f"q{port}", mac, PEER_MACS[port], MTUS[port])
    made: list[KernelPlane] = []

    def make(table: Table, **settings: int) -> KernelPlane:
        try:
            made.append(KernelPlane(["p0", "p1", "p2"], table, **settings))  # type: ignore[arg-type]
        except LocalError as error:
            pytest.skip(str(error).partition("\n")[0])
        return made[-1]

    yield make
    for plane in made:
        plane.close()


@pytest.fixture
def laboratory() -> Iterator[Laboratory]:
    """Internet without a site, in namespaces of its own; what a killed run left is removed first."""
    if missing := [tool for tool in TOOLS if shutil.which(tool) is None]:
        pytest.skip(f"not installed: {', '.join(missing)}")
    runs = RunRegistry(Path(tempfile.gettempdir()) / f"gdp-laboratories-{os.getuid()}")
    runs.sweep()
    run = runs.start()
    try:
        with Laboratory(run) as made:
            yield made
    finally:
        run.end()


@pytest.fixture(scope="session")
def image() -> Path:
    """Return the image of machines; it is made outside the namespaces of tests, which have no network."""
    from lab.debian import debian_root

    return debian_root()


@pytest.fixture(scope="session")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder with the wheels of a machine; made as ``image``."""
    from lab.cloud_site import wheelhouse  # with extras that other tests do without

    return wheelhouse(tmp_path_factory.mktemp("software") / "wheels")
