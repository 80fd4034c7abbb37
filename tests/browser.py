"""A headless Chromium for tests, with what it logs and what it asks the network for."""

import json
import shutil
import tempfile
import time
from contextlib import contextmanager

import pytest

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",  # WebGL without a graphics card
    "--enable-unsafe-swiftshader",
)
_PATIENCE_S = 90.0  # drawing WebGL without a graphics card on a busy machine


@contextmanager
def chromium(width=1400, height=1000):
    """Yield a driver of Chromium, or skip the test with a reason."""
    paths = {name: shutil.which(name) for name in ("chromium", "chromedriver")}
    missing = [name for name, path in paths.items() if path is None]
    if missing:
        pytest.skip(f"{' and '.join(missing)} not installed; the browser tests need both")
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    options = webdriver.ChromeOptions()
    options.binary_location = paths["chromium"]
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    with tempfile.TemporaryDirectory() as profile:
        for flag in [*FLAGS, f"--window-size={width},{height}", f"--user-data-dir={profile}"]:
            options.add_argument(flag)
        service = webdriver.ChromeService(paths["chromedriver"])
        driver = webdriver.Chrome(options=options, service=service)
        try:
            size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            scheme = {"name": "prefers-color-scheme", "value": "light"}
            driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})
            yield driver
        finally:
            driver.quit()


def opened(driver, path):
    """Open a report and wait until it is drawn."""
    driver.set_page_load_timeout(_PATIENCE_S)
    driver.get(path.as_uri())
    wait_for(driver, "return document.documentElement.dataset.ready === 'yes'")


def wait_for(driver, condition):
    """Wait until a script returns something true, and return that."""
    end = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end:
        if found := driver.execute_script(condition):
            return found
        time.sleep(0.05)
    raise AssertionError(f"in {_PATIENCE_S} s it never came true: {condition}")


def complaints(driver):
    """Return what the console shows as an error or a breach of the page's policy."""
    return [entry["message"] for entry in driver.get_log("browser") if entry["level"] in {"SEVERE", "ERROR"}]


def requests(driver):
    """Return the addresses that were asked for since the last call, files and data apart."""
    messages = (json.loads(entry["message"])["message"] for entry in driver.get_log("performance"))
    asked = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    own = ("file:", "data:", "blob:", "chrome:", "chrome-untrusted:")  # the last two are the browser's own
    return [url for url in asked if not url.startswith(own)]
