"""Take a picture of a report: `python scripts/report_picture.py OUT docs/report.png`.

OUT is what `locate`, `place` or `map` wrote; the page in it is opened in a headless Chromium. The PNG keeps
the words of the page, by which a test sees whether it is older than the program.
"""

import argparse
import io
import sys
from collections.abc import Sequence
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.browser import chromium, opened

SIZE = (1440, 900)
CLICK = (
    "[...document.querySelectorAll('#cameras tbody tr')].find(row => row.textContent.includes(%r)).click()"
)
WORDS = """
    const shown = ['banner', 'tiles', 'looks', 'summary'];
    return shown.map((id) => document.getElementById(id).innerText).join('\\n');
"""


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder with a report.html")
    parser.add_argument("picture", type=Path, help="PNG to write")
    parser.add_argument("--camera", help="name of a camera that is clicked on first")
    args = parser.parse_args(argv)
    with chromium(*SIZE) as driver:
        page = args.out / "report.html"
        page = page if page.exists() else args.out / "0/report.html"  # of `map`
        opened(driver, page.resolve())
        if args.camera:
            driver.execute_script(CLICK % args.camera)
            driver.execute_async_script("setTimeout(arguments[0], 3000)")  # it flies there
        driver.execute_script("scrollTo(0, 0)")
        kept = PngInfo()
        kept.add_itxt("words", driver.execute_script(WORDS))
        Image.open(io.BytesIO(driver.get_screenshot_as_png())).save(args.picture, pnginfo=kept, optimize=True)


if __name__ == "__main__":
    main()
