"""Take a picture of a report: `python scripts/report_picture.py OUT docs/report.png`.

OUT is what `locate`, `place` or `map` wrote; the page in it is opened in a headless Chromium.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.browser import chromium, opened

SIZE = (1440, 900)
CLICK = (
    "[...document.querySelectorAll('#cameras tbody tr')].find(row => row.textContent.includes(%r)).click()"
)

# Folders of this machine are named from where it was started.
SHORTEN = (
    "const told = document.getElementById('command'); told.textContent = told.textContent.replaceAll(%r, '')"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder with a report.html")
    parser.add_argument("picture", type=Path, help="PNG to write")
    parser.add_argument("--camera", help="name of a camera that is clicked on first")
    args = parser.parse_args()
    with chromium(*SIZE) as driver:
        page = args.out / "report.html"
        page = page if page.exists() else args.out / "0/report.html"  # of `map`
        opened(driver, page.resolve())
        driver.execute_script(SHORTEN % f"{Path.cwd()}/")
        if args.camera:
            driver.execute_script(CLICK % args.camera)
            driver.execute_async_script("setTimeout(arguments[0], 3000)")  # it flies there
        driver.execute_script("scrollTo(0, 0)")
        driver.save_screenshot(str(args.picture))


if __name__ == "__main__":
    main()
