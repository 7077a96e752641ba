"""``scripts/setup.sh`` in a copy with stubs for Python, pip and Debian's tools: nothing is downloaded."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.pages import ROOT

UP_TO_DATE = "setup: up to date\n"
# A Python that makes "environments" which contain itself, and notes what its pip installs.
PYTHON = """#!/bin/bash
case "$*" in
    --version) echo "Python 3.11.0" ;;
    "-m venv"*) mkdir -p "${!#}/bin" && cp "$0" "${!#}/bin/python" ;;
    "-m pip"*) echo "$*" >>"$SETUP_LOG" ;;
    *sysconfig*) dirname "$0" ;;
    *"import pip"*) [[ "$0" == */.venv/* ]] ;;
esac
"""


@dataclass(frozen=True)
class Clone:
    """Copy of what ``setup.sh`` reads."""

    folder: Path

    def setup(self, *options: str, code: int = 0) -> tuple[str, list[str]]:
        """Run it; return what it said, and the locks that pip was given."""
        log = self.folder / "pip.log"
        log.write_text("")
        environment = os.environ | {
            "PATH": f"{self.folder / 'bin'}:/usr/bin:/bin",
            "PYTHON": str(self.folder / "bin" / "python3"),
            "SETUP_LOG": str(log),
        }
        argv = [str(self.folder / "scripts" / "setup.sh"), *options]
        ran = subprocess.run(argv, env=environment, capture_output=True, text=True, timeout=60, check=False)
        assert ran.returncode == code, ran.stderr
        assert ran.stdout == ""
        return ran.stderr, re.findall(r"-r requirements/(\w+)\.lock", log.read_text())


@pytest.fixture
def clone(tmp_path: Path) -> Clone:
    """Return a copy without an environment."""
    shutil.copytree(ROOT / "requirements", tmp_path / "requirements")
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "bin").mkdir()
    (tmp_path / "scripts").mkdir()
    text = (ROOT / "scripts" / "setup.sh").read_text()
    (tmp_path / "scripts" / "setup.sh").write_text(text)
    stubs = {f"bin/{tool}": "#!/bin/bash\n" for tool in re.findall(r"command -v ([a-z][\w.-]+)", text)}
    stubs |= {f"bin/{tool}": "#!/bin/bash\n" for tool in ("nsenter", "setpriv", "unshare", "zsh", "fish")}
    stubs |= {f"scripts/{name}.sh": "#!/bin/bash\n" for name in ("setup_ros1", "setup_cloud_schema")}
    stubs |= {"bin/apt-get": '#!/bin/bash\necho "apt-get $*" >&2; exit 1\n', "bin/python3": PYTHON}
    for name, stub in stubs.items():
        (tmp_path / name).write_text(stub)
    for program in (*(tmp_path / "bin").iterdir(), *(tmp_path / "scripts").iterdir()):
        program.chmod(0o755)
    return Clone(tmp_path)


@pytest.mark.parametrize(
    ("first", "then"),
    [("", "--ros2"), ("", "--dev"), ("--ros2", "--dev"), ("--ros2", "--dev --ros2"), ("--ros2", "--ros2 --dev")],
    ids=lambda option: option or "plain",
)
def test_an_environment_of_less_is_completed(clone: Clone, first: str, then: str) -> None:
    clone.setup(*first.split())
    said, locks = clone.setup(*then.split())
    assert locks == ["build", "dev" if "--dev" in then else "ros2"]
    assert UP_TO_DATE not in said


@pytest.mark.parametrize(
    ("first", "then"),
    [("", ""), ("--ros2", ""), ("--ros2", "--ros2"), ("--dev", ""), ("--dev", "--ros2"), ("--dev", "--dev")],
    ids=lambda option: option or "plain",
)
def test_an_environment_of_as_much_or_more_is_left_and_says_so(clone: Clone, first: str, then: str) -> None:
    assert clone.setup(*first.split())[1]
    assert clone.setup(*then.split()) == (UP_TO_DATE, [])


def test_a_script_that_asks_for_quiet_gets_no_line_of_an_environment_that_is_up_to_date(clone: Clone) -> None:
    clone.setup("--quiet")
    assert clone.setup("--quiet") == ("", [])


@pytest.mark.parametrize(
    "script", ["ring_topology.sh", "fog_demo.sh", "internet_demo.sh", "memory_demo.sh", "fleet_demo.sh", "test.sh"]
)
def test_scripts_that_run_it_first_ask_for_quiet(script: str) -> None:
    calls = re.findall(r"scripts/setup\.sh.*", (ROOT / "scripts" / script).read_text())
    assert calls
    assert all("--quiet" in call for call in calls)


def test_a_changed_lock_is_installed_again(clone: Clone) -> None:
    clone.setup()
    with (clone.folder / "requirements" / "run.lock").open("a") as lock:
        lock.write("# changed\n")
    assert clone.setup()[1] == ["build", "run"]


@pytest.mark.parametrize("options", [["--devel"], ["dev"], ["--ros2", "--all"]])
def test_an_unknown_option_is_refused_before_anything_is_made(clone: Clone, options: list[str]) -> None:
    said, locks = clone.setup(*options, code=2)
    assert said == f"setup: unknown option {options[-1]}; there are --ros2, --dev and --quiet\n"
    assert locks == []
    assert not (clone.folder / ".venv").exists()


@pytest.mark.parametrize(("option", "lock"), [("", "run"), ("--ros2", "ros2"), ("--dev", "dev")])
def test_it_says_how_many_packages_it_fetches_and_from_which_list(clone: Clone, option: str, lock: str) -> None:
    pinned = (clone.folder / "requirements" / f"{lock}.lock").read_text()
    count = len(set(re.findall(r"(?m)^([\w.-]+)(?:\[.*\])?==", pinned)))
    said, _ = clone.setup(*option.split())
    assert f"installing this package and the {count} packages of requirements/{lock}.lock" in said
