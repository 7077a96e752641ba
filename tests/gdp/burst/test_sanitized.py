"""The compiled twins under AddressSanitizer and UndefinedBehaviorSanitizer, by the tests and corpus of both."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pages import ROOT

# Takes the place of the twins that ``make`` has built, before anything imports these.
_RUN = """
import sys
from importlib.machinery import ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_loader
loader = ExtensionFileLoader("gdp.burst.core", sys.argv[1])
spec = spec_from_loader("gdp.burst.core", loader)
sys.modules["gdp.burst.core"] = module_from_spec(spec)
loader.exec_module(sys.modules["gdp.burst.core"])
import pytest
sys.exit(pytest.main(["-q", "-n", "0", "-p", "no:cacheprovider", *sys.argv[2:]]))
"""


@pytest.mark.nightly
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no compiler")
def test_no_sanitizer_finds_anything_in_the_twins(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "gdp" / "burst", tmp_path, ignore=shutil.ignore_patterns("core.abi3.so"), dirs_exist_ok=True)
    if subprocess.run(["make", "-C", tmp_path, f"PYTHON={sys.executable}", "sanitized"], check=False).returncode:
        pytest.skip("this machine cannot build the burst core with sanitizers")
    libraries = [
        subprocess.check_output(["cc", f"-print-file-name={name}"], text=True).strip()
        for name in ("libasan.so", "libubsan.so")
    ]
    environment = os.environ | {
        "LD_PRELOAD": " ".join(libraries),
        "ASAN_OPTIONS": "detect_leaks=0",  # the interpreter frees nothing at its end
        "PYTHONMALLOC": "malloc",
    }
    argv: list[str | Path] = [
        sys.executable,
        "-c",
        _RUN,
        tmp_path / "core.abi3.so",
        *(ROOT / "tests/gdp" / name for name in ("burst/test_twins.py", "message/test_run.py", "ports/test_mmsg.py")),
    ]
    ran = subprocess.run(argv, env=environment, cwd=ROOT, capture_output=True, text=True, check=False, timeout=600)
    assert ran.returncode == 0 and ran.stdout.startswith("."), ran.stdout + ran.stderr  # noqa: PT018
