"""Models of the exchanges: their results equal those on the page, and belong to the present files."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.pages import ROOT

MODELS = ROOT / "docs/model"
PAGE = MODELS / "README.md"
PROVERIF = os.environ.get("PROVERIF", "proverif")

needs_proverif = pytest.mark.skipif(shutil.which(PROVERIF) is None, reason="ProVerif is not installed")


def _run(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([folder / "scripts/model.sh"], capture_output=True, check=False, text=True, timeout=110)


def _copy(folder: Path) -> Path:
    shutil.copytree(MODELS, folder / "docs/model")
    (folder / "scripts").mkdir()
    shutil.copy(ROOT / "scripts/model.sh", folder / "scripts")
    return folder


def test_no_model_has_changed_since_its_proof() -> None:
    lines = (MODELS / "SHA256SUMS").read_text().splitlines()
    proved = {name: digest for digest, name in (line.split("  ") for line in lines)}
    present = [*MODELS.glob("*.pv"), *MODELS.glob("*.pvl")]
    assert proved == {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in present}


def test_every_model_has_results_and_says_what_it_follows() -> None:
    stated = {run.partition(":")[0] for run in re.findall(r"^\| `([a-z:]+)` \|", PAGE.read_text(), re.MULTILINE)}
    models = {path.stem: path.read_text() for path in MODELS.glob("*.pv")}
    assert stated == models.keys()
    for text in models.values():
        assert "Abstractions:" in text
        files = re.findall(r"\b((?:gdp|docs)/[\w/]+\.(?:py|md))", text.partition("*)")[0])
        assert files
        assert [each for each in files if not (ROOT / each).is_file()] == []


def test_every_query_of_a_model_has_a_row() -> None:
    rows = re.findall(r"^\| `([a-z:]+)` \| [A-Z]\d+ \|", PAGE.read_text(), re.MULTILINE)
    for run in set(rows):
        queries = re.findall(r"^query ", (MODELS / f"{run.partition(':')[0]}.pv").read_text(), re.MULTILINE)
        assert rows.count(run) == len(queries), run


@needs_proverif
def test_every_result_is_as_the_page_says() -> None:
    done = _run(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


@needs_proverif
@pytest.mark.parametrize(
    ("model", "check", "instead"),
    [
        ("attach", "(=RTCERT, =n, =w)", "(=RTCERT, =n, any: name)"),
        ("advertise", "pkey, =r, =MORE)", "pkey, =r, any: bitstring)"),
        ("grant", "get friends(=n) in", ""),
        ("feed", "(=me, =l, start: number)", "(=me, any: number, start: number)"),
        ("join", "event Reads(name_of(pk(sk)), t);", ""),
        ("enrol", "if mac = hmac(key, (MAC, cert, n, id, csr, kem, evidence)) then", ""),
    ],
)
def test_a_check_that_is_left_out_of_a_model_changes_a_result(
    model: str, check: str, instead: str, tmp_path: Path
) -> None:
    folder = _copy(tmp_path)
    path = folder / f"docs/model/{model}.pv"
    text = path.read_text()
    assert check in text
    path.write_text(text.replace(check, instead))
    done = _run(folder)
    assert done.returncode == 1, done.stdout + done.stderr


def test_without_the_prover_the_script_says_where_it_is_to_be_had(tmp_path: Path) -> None:
    env = {**os.environ, "PROVERIF": str(tmp_path / "none")}
    done = subprocess.run([ROOT / "scripts/model.sh"], capture_output=True, check=False, text=True, env=env)
    assert (done.returncode, "proverif.inria.fr" in done.stderr) == (3, True)
