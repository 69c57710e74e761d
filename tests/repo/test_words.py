"""One word a thing: the terms of the field, in code, on disk and in prose."""

import re
import subprocess

from sources import ROOT

OLD = {
    r"(?<!by )(?<!np\.)(?<!torch\.)eyes?": "monocular, stereo, left or right camera",
    r"com(es?|ing) along|came along|rides? along": "pretrained, bundled; is stored",
    r"rooms?": "package",
    r"films?": "video; of a liquid: layer",
    r"spoil(s|t|ed)?": "corrupted",
    r"beats?|beating": "pulse",
    r"(unseen|other) (worlds?|looks?)": "out of distribution, unseen appearance",
    r"(a|an|the|its|this|one|own|default|today's|third|old|older) looks?": "appearance",
    r"readers? of (the )?force|force readers?|force readings?": "method, force estimator; estimate",
    r"told|said|asked": "given, reported, requested",
    r"kept": "stored, cached",
    r"seen": "observed, visible",
    r"beside": "next to, with",
    r"ghost(s|less)?|strays?": "false positive, off-target force",
    r"inspace|allow creep": "motion, widen_small_forces",
    r"forgive|vacate|pass turn": "clear_failures, discard, invalidate_workers",
    r"sway(s|ed)?": "camera motion, surface motion",
    r"blush|wine": "the name of what is coloured",
    r"regained|doubted": "reinitialised, low_confidence",
}
"""Patterns of words that went, and what stands for them; an underscore counts as a space."""
TEXT = (".py", ".pyi", ".md", ".yaml", ".toml", ".jinja", ".css", ".cff", ".yml", "Makefile", "Dockerfile")
WORDS = re.compile("|".join(rf"(?<![a-z])(?:{old})(?![a-z])" for old in OLD), re.IGNORECASE)
EXEMPT = ("CHANGELOG.md", "tests/repo/test_words.py")
LIQUID = ("synth/render/", "docs/reference/python.md")
"""Where a film is a layer of liquid, or Mitsuba's."""


def test_old_words_are_gone() -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    found = []
    for name in listed.splitlines():
        if not name.endswith(TEXT) or name in EXEMPT or not (ROOT / name).is_file():
            continue
        for number, line in enumerate((ROOT / name).read_text("utf-8").splitlines(), 1):
            for match in WORDS.finditer(line.replace("_", " ")):
                if not (name.startswith(LIQUID) and match[0].lower() == "film"):
                    found.append(f"{name}:{number}: {match[0]}")
    assert not found, f"{len(found)} old words:\n" + "\n".join(found[:200])
