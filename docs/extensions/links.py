"""Links of the built pages that lead nowhere: to a file or an anchor that is not there. Nothing is asked of the network.

``python docs/extensions/links.py build/docs`` prints each with its page; exit code 1 where there are any.
"""

from __future__ import annotations

import sys
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class _Page(HTMLParser):
    """Targets and anchors of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.anchors |= {value for key in ("id", "name") if (value := values.get(key))}
        self.targets += [value for key in ("href", "src") if (value := values.get(key)) and tag != "base"]


@cache
def _read(page: Path) -> _Page:
    found = _Page()
    found.feed(page.read_text(encoding="utf-8"))
    return found


def broken(root: Path) -> list[str]:
    """``page: target`` of every link below ``root`` to what is not there; addresses of other hosts are left alone."""
    root, found = root.resolve(), []
    for page in sorted(root.rglob("*.html")):
        for target in _read(page).targets:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            file = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            if file.is_dir():
                file /= "index.html"
            anchor = unquote(parts.fragment)
            there = file.is_file() and file.is_relative_to(root)
            if not there or (anchor and file.suffix == ".html" and anchor not in _read(file).anchors):
                found.append(f"{page.relative_to(root)}: {target}")
    return found


if __name__ == "__main__":
    told = broken(Path(sys.argv[1]))
    print("\n".join(told) or "no broken link")
    sys.exit(bool(told))
