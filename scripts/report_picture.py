"""Take the picture of docs/report.md: `python scripts/report_picture.py OUT docs/report.png`.

OUT is what `locate`, `place` or `map` wrote; the page in it is opened in a headless Chromium.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.browser import chromium, opened

SIZE = (1440, 900)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder with a report.html")
    parser.add_argument("picture", type=Path, help="PNG to write")
    args = parser.parse_args()
    with chromium(*SIZE) as driver:
        opened(driver, (args.out / "report.html").resolve())
        driver.execute_script(
            "document.getElementById('next').hidden = true"
        )  # it names folders of this machine
        driver.save_screenshot(str(args.picture))


if __name__ == "__main__":
    main()
