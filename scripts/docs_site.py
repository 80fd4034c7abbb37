"""Build the documentation as a site: the pages, the API reference, and a search over both.

    python scripts/docs_site.py docs/site

The pages of docs, the README and the recorded results become HTML beside their pictures; `api_reference.py`
builds the API reference into `api/`. The site works from the disk, without a server. Links that lead nowhere
are errors.
"""

import html
import json
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import markdown2

import api_reference

ROOT = Path(__file__).parents[1]
ASSETS = Path(__file__).parent / "site_assets"
EXTRAS = ["fenced-code-blocks", "tables", "header-ids", "cuddled-lists"]
GROUPS = {
    "Start": (
        "README.md",
        "docs/tutorial.md",
        "docs/commands.md",
        "docs/options.md",
        "docs/rough_poses.md",
        "docs/troubleshooting.md",
    ),
    "Understand": ("docs/report.md", "docs/glossary.md", "docs/method.md", "docs/formats.md", "docs/json.md"),
    "Python": ("docs/python.md", "docs/synthetic.md"),
    "Contribute": ("CONTRIBUTING.md", "docs/architecture.md", "docs/guides.md"),
}
"""Pages in the menu; the others of docs follow, then what is measured."""
_LINK = re.compile(r'(href|src)="([^"]+)"')
_HEADING = re.compile(r'<h([123]) id="([^"]+)">(.*?)</h\1>', re.DOTALL)
_TAG = re.compile(r"<[^>]+>")


class Page(NamedTuple):
    """A page of the site."""

    source: Path
    target: str
    """Its file, in the one folder of all pages."""
    title: str
    body: str


class Entry(NamedTuple):
    """What a search finds."""

    title: str
    url: str
    text: str


def build(out: Path) -> None:
    """Write the site into a folder, in place of what stands there.

    Raises:
        ValueError: if a link leads nowhere.
    """
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    pages = [_read(path) for path in sources()]
    targets = {page.source: page.target for page in pages}
    template = (ASSETS / "page.html").read_text(encoding="utf-8")
    menu = _menu(pages)
    for page in pages:
        values = {"title": html.escape(page.title), "menu": menu, "body": _relink(page, targets, out)}
        filled = re.sub(r"\{\{(\w+)\}\}", lambda found, values=values: values[found[1]], template)
        (out / page.target).write_text(filled, encoding="utf-8")
    api_reference.build(out / "api")
    entries = [*(entry for page in pages for entry in _sections(page)), *_api_entries(out / "api")]
    index = json.dumps([entry._asdict() for entry in entries], ensure_ascii=False)
    (out / "search-index.js").write_text(f"const INDEX = {index};\n", encoding="utf-8")
    for name in ("site.css", "search.js"):
        shutil.copy(ASSETS / name, out / name)


def sources() -> list[Path]:
    """Return the Markdown files that become pages, in the order of the menu."""
    named = [ROOT / name for names in GROUPS.values() for name in names]
    others = [path for path in sorted((ROOT / "docs").glob("*.md")) if path not in named]
    measured = [ROOT / "scripts/README.md", *sorted((ROOT / "scripts/results").glob("*.md"))]
    return [*named, *others, ROOT / "CHANGELOG.md", *measured]


def _read(source: Path) -> Page:
    """Return a page, its links as they stand in the source."""
    body = str(markdown2.markdown(source.read_text(encoding="utf-8"), extras=EXTRAS))
    heading = _HEADING.search(body)
    if heading is None:
        raise ValueError(f"{source} has no title")
    relative = source.relative_to(ROOT).with_suffix("")
    name = "index" if relative.name == "README" and len(relative.parts) == 1 else "-".join(relative.parts)
    return Page(source, f"{name.removeprefix('docs-')}.html", _text(heading[3]), body)


def _relink(page: Page, targets: dict[Path, str], out: Path) -> str:
    """Return a page's body with links that hold in the site; files that it links to are copied there."""

    def relinked(found: re.Match[str]) -> str:
        kind, link = found.groups()
        path, mark, anchor = link.partition("#")
        if not path or "://" in path:
            return found[0]
        target = (page.source.parent / path).resolve()
        if target in targets:
            return f'{kind}="{targets[target]}{mark}{anchor}"'
        if not target.is_file():
            raise ValueError(f"{page.source}: {link} leads nowhere")
        place = out / "files" / target.relative_to(ROOT)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(target, place)
        return f'{kind}="{place.relative_to(out).as_posix()}"'

    return _LINK.sub(relinked, page.body)


def _menu(pages: list[Page]) -> str:
    """Return the list of all pages in their groups."""
    group_of = {ROOT / name: title for title, names in GROUPS.items() for name in names}
    lines, last = [], ""
    for page in pages:
        otherwise = "Measured" if page.source.is_relative_to(ROOT / "scripts") else "More"
        group = group_of.get(page.source, otherwise)
        if group != last:
            lines.append(f"<h4>{group}</h4>")
            last = group
        lines.append(f'<a href="{page.target}">{html.escape(page.title)}</a>')
    return "\n".join([*lines, "<h4>Reference</h4>", '<a href="api/sfm_shapefit.html">API</a>'])


def _sections(page: Page) -> Iterator[Entry]:
    """Yield the sections of a page, each from its heading to the next."""
    headings = list(_HEADING.finditer(page.body))
    ends = [heading.start() for heading in headings[1:]] + [len(page.body)]
    for heading, end in zip(headings, ends, strict=True):
        title = _text(heading[3])
        shown = title if title == page.title else f"{page.title}: {title}"
        yield Entry(shown, f"{page.target}#{heading[2]}", _text(page.body[heading.end() : end]))


def _api_entries(folder: Path) -> Iterator[Entry]:
    """Yield what the API reference says of each name: its own line of the page, and the words below it."""
    for path in sorted(folder.glob("**/*.html")):
        if path.name in ("index.html", "search.html"):
            continue
        module = ".".join(path.relative_to(folder).with_suffix("").parts)
        sections = re.split(r'<section id="([^"]+)"[^>]*>', path.read_text(encoding="utf-8"))
        for name, body in zip(sections[1::2], sections[2::2], strict=True):
            url = f"api/{path.relative_to(folder).as_posix()}#{name}"
            yield Entry(f"{module}.{name}", url, _text(body)[:2000])


def _text(body: str) -> str:
    """Return HTML without its tags, on one line."""
    return " ".join(html.unescape(_TAG.sub(" ", body)).split())


if __name__ == "__main__":
    build(Path(sys.argv[1]))
