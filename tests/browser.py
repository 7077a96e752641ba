"""Headless Chromium for tests of pages, driven by Selenium; skipped with a reason where it is not installed."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

__all__ = ["ARTEFACTS", "console_errors", "needs_browser", "open_browser", "prefer_scheme", "save_picture"]

ARTEFACTS = Path(os.environ.get("GDP_ARTEFACTS", Path(__file__).resolve().parents[1] / "artefacts"))

needs_browser = pytest.mark.skipif(
    shutil.which("chromium") is None or shutil.which("chromedriver") is None or find_spec("selenium") is None,
    reason="needs chromium, chromium-driver and selenium (scripts/setup.sh --dev)",
)


@contextlib.contextmanager
def open_browser(width: int = 1_440, height: int = 900) -> Iterator[Chrome]:
    """Yield a headless browser with a fresh profile."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    words = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"]
    for word in (*words, f"--window-size={width},{height}", "--no-proxy-server", "--force-device-scale-factor=1"):
        options.add_argument(word)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver") or ""))
    try:
        driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False},
        )
        yield driver
    finally:
        driver.quit()


def prefer_scheme(driver: Chrome, *, is_dark: bool) -> None:
    """Let pages learn that the user prefers dark or light colours."""
    scheme = [{"name": "prefers-color-scheme", "value": "dark" if is_dark else "light"}]
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})


def console_errors(driver: Chrome) -> list[str]:
    """Return the warnings and errors that the page has written to its console so far."""
    lines: list[dict[str, str]] = driver.get_log("browser")  # type: ignore[no-untyped-call]
    return [each["message"] for each in lines if each["level"] in ("WARNING", "SEVERE")]


def save_picture(driver: Chrome, name: str) -> Path:
    """Save a picture of the page as an artefact, and return its path."""
    ARTEFACTS.mkdir(exist_ok=True)
    path = ARTEFACTS / f"{name}.png"
    driver.save_screenshot(str(path))
    return path
