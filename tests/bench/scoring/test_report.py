"""The report in a real browser: no console errors, everything drawn, nothing wider than the window."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from fake_recording import Bump, Maker

from bench.recording import pixel_scale
from bench.recording.folder import open_recording
from bench.scoring import evaluate_recording, report
from bench.scoring.evaluate_recording import Settings

BROWSER = next((b for b in ("chromium", "chromium-browser", "google-chrome") if shutil.which(b)), None)

# The page reports on itself, inside frames of the widths asked for: windows have a least width, frames don't.
_PROBE = """<!DOCTYPE html><meta charset="utf-8"><body style="margin:0">
<iframe srcdoc="{page}" style="width:400px;height:3000px;border:0"></iframe>
<iframe srcdoc="{page}" style="width:1400px;height:3000px;border:0"></iframe>
<script>
function look(frame) {{
  const inner = frame.contentDocument;
  const text = [...inner.querySelectorAll("p, td, th, li, figcaption, .value")];
  return {{
    width: inner.documentElement.scrollWidth,
    charts: inner.querySelectorAll(".main-svg").length,
    cut: [...inner.querySelectorAll(".scroll")].filter(e => e.scrollWidth > e.clientWidth).length,
    fixed: inner.defaultView.getComputedStyle(inner.querySelector(".methods tbody th")).position,
    broken: [...inner.images].filter(i => !i.complete || i.naturalWidth === 0).length,
    smallest: Math.min(...text.map(e => parseFloat(inner.defaultView.getComputedStyle(e).fontSize))),
  }};
}}
addEventListener("load", () => setTimeout(() => {{
  document.body.dataset.found = JSON.stringify([...document.querySelectorAll("iframe")].map(look));
}}, 1500));
</script>"""


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium here (Debian: apt-get install chromium)")
def test_report_in_a_browser(make: Maker, tmp_path: Path) -> None:
    folder = make(frames=16, meta={"press_s": [0.2, 0.8]})
    recording = open_recording(folder)
    methods = {"bump": Bump(), "a method with a rather long name": Bump()}
    result = evaluate_recording.evaluate_recording(
        recording, methods, "bump", pixel_scale.find_scale(recording.meta, folder), Settings(), {}
    )
    page = report.render_report(result, "A title long enough to need two lines on a narrow screen, surely")
    probe = tmp_path / "probe.html"
    probe.write_text(_PROBE.format(page=html.escape(page, quote=True)), encoding="utf-8")
    assert BROWSER is not None
    done = subprocess.run(
        [
            BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=8000",
            "--window-size=1900,1000", "--enable-logging=stderr", "--dump-dom", probe.as_uri(),
        ],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not console
    match = re.search(r'data-found="([^"]*)"', done.stdout)
    assert match, done.stderr[-2000:]
    for width, found in zip((400, 1400), json.loads(html.unescape(match[1])), strict=True):
        assert found["charts"] >= 3
        assert found["broken"] == 0
        assert found["width"] <= width
        assert found["smallest"] >= 11
        assert found["fixed"] == "sticky", "a row that is scrolled keeps its name"
        assert width < 1400 or found["cut"] == 0, "at a desk every column is seen"
