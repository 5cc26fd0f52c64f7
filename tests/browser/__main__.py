"""`make browser`: pages in a real browser, pictures of them in build/browser. 0 when all holds, 1 otherwise.

The browser is Debian's chromium, driven by playwright; both are installed where the user may, else the one command that
does it is said, and the status is 1. With --if-there nothing is installed, and without a browser the status is 0.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("chromium", "chromium-browser", "google-chrome")
COMMAND = "apt-get install --yes chromium"
PATIENCE = 600
"""s, for what is installed."""


def main() -> int:
    """Open the pages and look at them."""
    words = argparse.ArgumentParser(prog="make browser", description=__doc__)
    words.add_argument("--if-there", action="store_true", help="no failure where there is no browser to be had")
    words.add_argument("--out", type=Path, default=ROOT / "build" / "browser", help="folder of the pictures")
    options = words.parse_args()
    lacking = chromium(not options.if_there) or playwright(not options.if_there)
    if lacking:
        print(f"browser: {lacking}", file=sys.stderr)
        return 0 if options.if_there else 1
    from playwright.sync_api import Error, sync_playwright

    from tests.browser.pages import Look, failures

    with sync_playwright() as driver:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]
        try:
            browser = driver.chromium.launch(executable_path=browser_command(), args=flags, timeout=60_000)
        except Error as error:
            print(f"browser: {browser_command()} does not start: {str(error).splitlines()[0]}", file=sys.stderr)
            return 0 if options.if_there else 1
        options.out.mkdir(parents=True, exist_ok=True)
        report = failures(Look(browser, options.out), ROOT)
        browser.close()
    for failure in report:
        print(f"FAILED: {failure}", file=sys.stderr)
    print(f"pictures are in {options.out}; {len(report)} failures")
    return 1 if report else 0


def browser_command() -> str | None:
    """The browser's file."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


def chromium(install: bool) -> str:
    """Nothing when a browser is there or was installed, else what to do."""
    if browser_command():
        return ""
    if not install:
        return f"there is no chromium, and no page was opened: {COMMAND}"
    before = [] if os.geteuid() == 0 else ["sudo", "-n"] if shutil.which("sudo") else None
    if shutil.which("apt-get") and before is not None:
        for words in (["update"], ["install", "--yes", "--no-install-recommends", "chromium"]):
            if not ran([*before, "apt-get", "--quiet", *words]):
                break
    return "" if browser_command() else f"there is no chromium, and it may not be installed from here: sudo {COMMAND}"


def playwright(install: bool) -> str:
    """Nothing when the driver is there or was installed, else what to do."""
    if install and importlib.util.find_spec("playwright") is None:
        ran([sys.executable, "-m", "pip", "install", "--quiet", "--editable", f"{ROOT}[browser]"])
        importlib.invalidate_caches()
    if importlib.util.find_spec("playwright") is None:
        return f"the driver is not there: {sys.executable} -m pip install 'selfmotion[browser]'"
    return ""


def ran(words: list[str]) -> bool:
    """Whether a command did what it should, in time."""
    try:
        return subprocess.run(words, stdin=subprocess.DEVNULL, timeout=PATIENCE, check=False).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


if __name__ == "__main__":
    sys.exit(main())
