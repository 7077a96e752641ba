"""Sessions of nox: fast, full, docs, bench, coverage, and an import test for each supported Python.

    nox -s fast           static checks and tests without root, under 60 s
    nox -s full           everything that CI runs, as root
    nox -s coverage       branch coverage of the product code
    nox -s docs           the documentation as a site
    nox -s bench          a short run of the message benchmark, as root
    nox -s pythons        compile and import under every supported Python that is installed

Sessions use .venv, which scripts/setup.sh --dev makes. Only ``pythons`` makes environments of its own.
"""

from __future__ import annotations

import nox

PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
PYTHON = ".venv/bin/python"
FAST_TESTS = ("tests/gdp", "tests/proxy/serial", "tests/fog/plan", "tests/vectors", "tests/scripts/test_readability.py")

nox.options.sessions = ["fast"]
nox.options.error_on_missing_interpreters = False


@nox.session(python=False)
def fast(session: nox.Session) -> None:
    """Run ruff, the import rules and the quick tests; needs no root."""
    session.run(".venv/bin/ruff", "check", ".", external=True)
    session.run(".venv/bin/lint-imports", external=True)
    session.run(PYTHON, "-m", "pytest", "-x", *(session.posargs or FAST_TESTS), external=True)


@nox.session(python=False)
def full(session: nox.Session) -> None:
    """Run what CI runs; needs root for the tests with network namespaces."""
    session.run(".ci/run", external=True)


@nox.session(python=False)
def docs(session: nox.Session) -> None:
    """Build the documentation into site/; a broken link fails the session."""
    session.run(PYTHON, "-m", "mkdocs", "build", "--strict", *session.posargs, external=True)


@nox.session(python=False)
def bench(session: nox.Session) -> None:
    """Run a benchmark; arguments replace the default, which shows the options of the message benchmark."""
    session.run(PYTHON, *(session.posargs or ("scripts/bench/messages.py", "--help")), external=True)


@nox.session(python=False)
def coverage(session: nox.Session) -> None:
    """Measure branch coverage of gdp, proxy and fog; fails below the limit in pyproject.toml."""
    session.run(
        PYTHON,
        "-m",
        "pytest",
        "--cov",
        "--cov-report=term:skip-covered",
        *(session.posargs or ("tests",)),
        external=True,
    )


@nox.session(python=PYTHONS)
def pythons(session: nox.Session) -> None:
    """Compile every package and import the base installation under one Python."""
    session.install("-e", ".")
    session.run("python", "-m", "compileall", "-q", "-f", "gdp", "proxy", "fog")
    session.run("python", "scripts/import_all.py", "gdp")
