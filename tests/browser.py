"""Opens a page in Debian's chromium without a screen, works its controls, and tells what happened.

The page's copy carries a script that listens for errors from the first moment and presses the buttons at the end.
"""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking --hide-scrollbars "
    "--disable-component-update --disable-sync --enable-unsafe-swiftshader --virtual-time-budget=20000"
).split()
LISTEN = """<script>
window.seen = {errors: []};
addEventListener("error", (e) => seen.errors.push(String(e.message)));
addEventListener("unhandledrejection", (e) => seen.errors.push(String(e.reason)));
addEventListener("securitypolicyviolation", (e) => seen.errors.push(`${e.violatedDirective} ${e.blockedURI}`));
const said = console.error;
console.error = (...words) => { seen.errors.push(words.join(" ")); said(...words); };
</script>"""
TELL = """<script>
(async () => {
  const until = async (done) => { for (let k = 0; k < 150 && !done(); k++) await new Promise((go) => setTimeout(go, 100)); };
  try { await (async () => { %s })(); } catch (error) { seen.errors.push(String(error)); }
  seen.requests = performance.getEntriesByType("resource").map((entry) => entry.name);
  const out = document.createElement("pre");
  out.id = "seen";
  out.textContent = JSON.stringify(seen);
  document.body.append(out);
})();
</script>"""


def visit(page: Path, script: str, width: int = 1200, *flags: str) -> dict[str, Any]:
    """Run ``script`` (the body of an async function that fills ``seen``) in the page; returns ``seen``."""
    assert CHROMIUM is not None
    text = page.read_text(encoding="utf-8")
    assert "<head>" in text
    text = text.replace("<head>", "<head>" + LISTEN, 1)
    cut = text.rindex("</body>")
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "page.html"
        copy.write_text(text[:cut] + TELL % script + text[cut:], encoding="utf-8")
        own = [f"--user-data-dir={scratch}/profile", f"--window-size={width},1400", "--dump-dom", *flags, copy.as_uri()]
        done = subprocess.run([CHROMIUM, *FLAGS, *own], capture_output=True, text=True, timeout=120)
    found = re.search(r'<pre id="seen">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, f"the page did not finish: {done.stderr[-2000:]}"
    return json.loads(html.unescape(found.group(1)))
