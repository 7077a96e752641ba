"""Plugin of all tests; fixtures are in the folders' own files. ``nox -s core`` hides the extensions from tests."""

import os
import sys

pytest_plugins = ["tests.pool", "tests.quarantine"]
if os.environ.get("GDP_WITHOUT_EXTENSIONS") == "1":
    sys.modules["gdp_extensions"] = None  # type: ignore[assignment]
    collect_ignore = ["tests/gdp_extensions"]
