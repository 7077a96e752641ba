"""Complete files of each provider on the page of clusters: they load, and a launch can be tried with them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from fog.cli.app import app as fog
from fog.latency.known import Latencies
from fog.site import open_site
from gdp.cli import switch
from gdp.cli.gdp import main as gdp
from tests.fog.test_site import border
from tests.pages import ROOT, Block, blocks

_PAGE = ROOT / "docs/how-to/clusters.md"
_BORDER = "/var/lib/gdp/lab"
_FILES = {block.title: block for block in blocks(_PAGE) if block.language == "yaml"}
Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Return a function that writes a file of the page, with a border in this folder in place of the page's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FOG_STATE", str(tmp_path / "state"))
    monkeypatch.setattr(Latencies, "refresh", lambda *_: None)  # it would measure in the internet

    def write(title: str) -> Path:
        block: Block = _FILES[title]
        path = tmp_path / title
        path.parent.mkdir(parents=True, exist_ok=True)
        if _BORDER in block.text:
            border(tmp_path)
            (path.parent / "dist").mkdir()
            (path.parent / "dist/gdp_ros-0.1.0-py3-none-any.whl").touch()
        path.write_text(block.text.replace(_BORDER, str(tmp_path / "border")))
        return path

    return write


def _dry_run(site: Path) -> Result:
    shutil.copy(ROOT / "examples/echo.launch.py", site.parent)
    return CliRunner().invoke(fog, ["launch", str(site.parent / "echo.launch.py"), "--site", str(site), "--dry-run"])


def test_the_page_has_one_site_for_each_provider() -> None:
    sites = [title for title in _FILES if title.endswith("fog.yaml")]
    assert sites == ["fog.yaml", "aws/fog.yaml", "skypilot/fog.yaml"]


def test_the_files_of_local_are_enough_for_a_dry_run(write: Write) -> None:
    with pytest.raises(SystemExit) as leaving:
        gdp(["lab", "robot"])
    assert not leaving.value.code
    for title in ("robot/switch.yaml", "robot/proxy.yaml", "fog.yaml"):
        write(title)
    Path("robot/revocations").mkdir()
    checked = CliRunner().invoke(switch.app, ["--config", "robot/switch.yaml", "--check"])
    assert (checked.exit_code, "configuration good" in checked.output) == (0, True)
    done = _dry_run(Path("fog.yaml"))
    assert done.exit_code == 0, done.output
    assert "nothing is started" in done.output or "USD" in done.output


def test_the_file_of_aws_is_enough_for_a_dry_run(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    moto = pytest.importorskip("moto", reason="moto of the extra `dev` is not installed")
    for key in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(key, "testing")
    with moto.mock_aws():
        done = _dry_run(write("aws/fog.yaml"))
    assert done.exit_code == 0, done.output
    assert "us-east-1" in done.output


def test_the_file_of_skypilot_is_a_site(write: Write) -> None:
    assert open_site(write("skypilot/fog.yaml")).config.provider == "skypilot"
