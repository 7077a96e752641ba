"""Sessions of nox: fast, core, full, docs, pages, bench, coverage, and tests for each Python and for 64-bit ARM.

    nox -s fast           static checks and tests without root, under 60 s
    nox -s core           tests without the extensions
    nox -s full           everything that CI runs, as root
    nox -s coverage       branch coverage of the product code
    nox -s docs           the documentation as a site
    nox -s pages          the age of measured pages; a nightly run fails where one is old
    nox -s bench          a benchmark, such as -- scripts/bench/messages.py --quick; its options without arguments
    nox -s pythons        imports and quick tests under every supported Python that is installed
    nox -s arm64          quick tests on emulated 64-bit ARM, in ten minutes, as root

Sessions use .venv, which scripts/setup.sh --dev makes. ``pythons`` and ``arm64`` make environments of their own.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import nox

PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
PYTHON = ".venv/bin/python"
FAST_TESTS = (
    *(f"tests/gdp/{each}" for each in ("control", "crypto", "frame", "message", "rib", "session", "switch", "trust")),
    *(f"tests/proxy/{each}" for each in ("config", "wire")),
    *(f"tests/fog/{each}" for each in ("catalog", "host", "latency", "plan")),
)  # without root, processes and sockets; most tests of the cores
ARM64 = tuple(f"--platform={each}_aarch64" for each in ("manylinux_2_28", "manylinux_2_27", "manylinux2014"))
NEEDS_ROS1 = "tests/proxy/serial/test_service_converter.py"
TEST_TOOLS = ("hypothesis", "jsonschema", "packaging", "pytest", "pytest-xdist")

nox.options.sessions = ["fast"]


@nox.session(python=False)
def fast(session: nox.Session) -> None:
    """Run ruff, the import rules and the quick tests; needs no root."""
    session.run(".venv/bin/ruff", "check", ".", external=True)
    session.run(".venv/bin/lint-imports", external=True)
    session.run(PYTHON, "-m", "pytest", "-x", "-n", "auto", *(session.posargs or FAST_TESTS), external=True)


@nox.session(python=False)
def core(session: nox.Session) -> None:
    """Run the tests of the core where no extension can be imported; arguments replace the folders."""
    session.env["GDP_WITHOUT_EXTENSIONS"] = "1"
    session.run(PYTHON, "-m", "pytest", *(session.posargs or ("tests",)), external=True)


@nox.session(python=False)
def full(session: nox.Session) -> None:
    """Run what CI runs; needs root for the tests with network namespaces."""
    session.run(".ci/run", external=True)


@nox.session(python=False)
def docs(session: nox.Session) -> None:
    """Build the site of docs/; a broken link fails the session."""
    session.run("scripts/docs.sh", *session.posargs, external=True)


@nox.session(python=False)
def bench(session: nox.Session) -> None:
    """Run a benchmark; arguments replace the default, which shows the options of the message benchmark."""
    session.run(PYTHON, *(session.posargs or ("scripts/bench/messages.py", "--help")), external=True)


@nox.session(python=False)
def pages(session: nox.Session) -> None:
    """Fail where a measured page is older than the last change of what it measures."""
    session.run(PYTHON, "scripts/bench/page_age.py", external=True)


@nox.session(python=False)
def coverage(session: nox.Session) -> None:
    """Measure branch coverage of gdp, proxy, fog and gdp_extensions; fails below the limit in pyproject.toml.

    Arguments replace the folders of tests. Nodes in namespaces count only as root; without root less is covered.
    """
    folders = session.posargs or ("tests", "netns_tests")
    # Processes in namespaces confine themselves, and may still write below /dev.
    with TemporaryDirectory(prefix="gdp-coverage-", dir="/dev/shm") as scratch:
        session.env["COVERAGE_FILE"] = f"{scratch}/.coverage"
        session.run(PYTHON, "-m", "pytest", "--cov", "--cov-report=", "--cov-fail-under=0", *folders, external=True)
        shutil.copy(f"{scratch}/.coverage", ".coverage")
    session.env["COVERAGE_FILE"] = ".coverage"
    for package in ("gdp", "proxy", "fog", "gdp_extensions"):
        words = (f"--include={package}/*", "--format=total", "--fail-under=0")
        session.log(f"{package}, %:")
        session.run(PYTHON, "-m", "coverage", "report", *words, external=True)
    session.run(PYTHON, "-m", "coverage", "report", "--skip-covered", external=True)


@nox.session(python=False)
@nox.parametrize("version", PYTHONS)
def pythons(session: nox.Session, version: str) -> None:
    """Compile and import all packages, and run the quick tests under one Python; skips a Python that is absent."""
    found = interpreter(version)
    if found is None:
        session.skip(f"Python {version} is not installed: neither python{version} in PATH nor a version of pyenv")
    folder = Path(".nox") / f"python-{version}"
    python = str(folder / "bin" / "python")
    session.run(found, "-m", "venv", "--clear", str(folder), external=True)
    session.run(python, "-m", "pip", "install", "--quiet", "-e", ".[aws,cluster,fog,scapy]", *TEST_TOOLS, external=True)
    session.run(python, "-m", "compileall", "-q", "-f", "gdp", "proxy", "fog", "gdp_extensions", external=True)
    session.run(python, "scripts/import_all.py", "gdp", "proxy", "fog", "gdp_extensions", external=True)
    session.run(python, "-m", "pytest", "-x", *FAST_TESTS, external=True)


@nox.session(python=False)
def arm64(session: nox.Session) -> None:
    """Run the quick tests, with vectors and serialisation, on emulated ARM; arguments replace the folders."""
    emulator = shutil.which("qemu-aarch64-static")
    if emulator is None or shutil.which("mmdebstrap") is None:
        session.skip("qemu-user-static or mmdebstrap is not installed")
    root = Path(".nox/arm64").absolute()
    shutil.rmtree(root, ignore_errors=True)
    root.parent.mkdir(exist_ok=True)
    packages = "--include=python3-minimal,libpython3.11-stdlib,libstdc++6,tzdata"
    words = ("--quiet", "--architectures=arm64", "--variant=extract", packages, "bookworm", str(root))
    session.run("mmdebstrap", *words, external=True)
    wheels = ("--target", str(root / "wheels"), *ARM64, "--python-version=3.11", "--only-binary=:all:", "--quiet")
    for wanted in (("--no-deps", "--require-hashes", "-r", "requirements/run.lock"), (*TEST_TOOLS, "networkx")):
        session.run(PYTHON, "-m", "pip", "install", *wheels, *wanted, external=True)
    shutil.copy(emulator, root / "emulator")
    for folder in ("work", "proc", "dev", "tmp"):
        (root / folder).mkdir(exist_ok=True)
    mounts = 'mount --rbind /dev $0/dev && mount -t proc proc $0/proc && mount --bind . $0/work && exec "$@"'
    names = (
        "PATH=/usr/sbin:/usr/bin",
        "HOME=/tmp",
        "PYTHONPATH=/work:/work/scripts:/wheels",
        "PYTHONDONTWRITEBYTECODE=1",
    )
    test = ("/emulator", "/usr/bin/python3.11", "-m", "pytest", "-o", "addopts=", "-p", "no:cacheprovider", "-q")
    serial = sorted(map(str, {*Path("tests/proxy/serial").glob("test_*.py")} - {Path(NEEDS_ROS1)}))
    starts_none = (each for each in FAST_TESTS if each != "tests/fog/host")
    folders = session.posargs or (*starts_none, "tests/vectors", *serial)
    inside = (
        "env",
        "-i",
        *names,
        "chroot",
        str(root),
        *test,
        "--rootdir=/work",
        *(f"/work/{each}" for each in folders),
    )
    session.run("unshare", "--mount", "sh", "-c", mounts, str(root), *inside, external=True)


def interpreter(version: str) -> str | None:
    """Return a working interpreter of a version, such as ``3.12``; None: there is none."""
    folders = sorted(Path("~/.pyenv/versions").expanduser().glob(f"{version}.*/bin"))
    for path in (f"python{version}", *(str(folder / "python") for folder in folders)):
        if shutil.which(path) and subprocess.run([path, "-c", ""], capture_output=True, check=False).returncode == 0:
            return path
    return None  # a command of pyenv may exist and yet not run
