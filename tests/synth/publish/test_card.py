"""The card: front matter that a hub reads, every field and column, and numbers that are the dataset's own."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from fake_run import in_process
from fake_work import consistent
from ruamel.yaml import YAML
from typer.testing import CliRunner

from synth.cli import app
from synth.dataset import index
from synth.dataset.folder import Folder
from synth.fields import FIELDS
from synth.job.schema import Job
from synth.publish import card, histogram, preview_video

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("card") / "out"
    job = Job(
        sequences=3,
        frames=3,
        render={"size": (64, 48)},
        flow={"backend": "ideal"},
        card={"title": "Pulls: a test", "licence": "cc-by-4.0", "summary": "Made to be read."},
    )
    in_process(job, out, consistent)
    preview_video.write_preview(out)
    return out


def text(root: Path) -> str:
    return (root / "README.md").read_text("utf-8")


def test_front_matter_is_yaml_that_names_title_licence_and_index(root: Path) -> None:
    front = YAML(typ="safe").load(text(root).split("---")[1])
    assert front["pretty_name"] == "Pulls: a test"
    assert front["license"] == "cc-by-4.0"
    assert front["size_categories"] == ["n<1K"]
    assert (root / front["configs"][0]["data_files"][0]["path"]).is_file()


def test_every_field_and_column_is_described_and_absent_ones_are_not(root: Path) -> None:
    for name, field in FIELDS.items():
        assert (f"| `{name}` | {', '.join(field.dims)} |" in text(root)) != field.optional
    for name in index.SCHEMA.names:
        assert f"| `{name}` |" in text(root)


def test_numbers_are_those_of_the_index(root: Path) -> None:
    stiffness = [row["young_kpa"] for row in index.read_index(root).to_pylist()]
    line = next(line for line in text(root).splitlines() if line.startswith("| Young's modulus"))
    assert [float(cell) for cell in line.split("|")[2:5]] == pytest.approx(
        [min(stiffness), float(np.median(stiffness)), max(stiffness)], rel=5e-3
    )
    assert "3 sequences (9 frames, 64 × 48 px)" in text(root)
    assert "Made to be read." in text(root)


def test_the_mechanics_stand_on_the_card(root: Path) -> None:
    for line in card.mechanics(Folder(root).job()):
        assert line in text(root)


@pytest.mark.parametrize(
    ("fem", "said"),
    [
        (
            {},
            "no membrane, no heart beat, no breath|Poisson's ratio is 0.4;|is bonded to the skull round"
            "|Every contact is a given traction|by what was fitted without one",
        ),
        (
            {
                "membrane": {"intact": 0.5},
                "pulse": {"breath_mm": 1.0},
                "poisson": [0.4, 0.49],
                "skull": "slip",
            },
            "no bleeding, no heart beat.|on 50% of the sequences|Heart and breath raise"
            "|drawn from 0.4 to 0.49|slides along the skull",
        ),
        (
            {"contact": "rigid", "gestures": ["push", "pull"], "skull": ["bonded", "slip"]},
            "rigid tip (flat, friction 0.2)|; pull: a given traction.|where the scenario says `slip`",
        ),
    ],
)
def test_the_card_says_which_mechanics_are_in_and_which_are_not(fem: dict[str, Any], said: str) -> None:
    words = "\n".join(card.mechanics(Job.model_validate({"fem": fem})))
    for phrase in said.split("|"):
        assert phrase in words
    assert ("fitted without one" in words) == ("membrane" not in fem)
    absent = {"on 50%": "membrane", "Heart and breath raise": "pulse", "rigid tip": "contact"}
    assert not [phrase for phrase, key in absent.items() if key not in fem and phrase in words]


def test_every_picture_that_is_shown_exists_and_markdown_holds_together(root: Path) -> None:
    shown = re.findall(r"\]\(([^)]+)\)", text(root))
    assert len(shown) >= 5
    for path in shown:
        assert (root / path).is_file(), path
    lines = text(root).splitlines()
    for k, line in enumerate(lines):
        if line.startswith("#") and k:
            assert lines[k - 1] == "", f"no blank line before {line}"
        if line.startswith("|") and not lines[k + 1].startswith("|"):
            assert lines[k + 1] == "", f"the table runs into: {lines[k + 1]}"


def test_the_command_writes_it_anew(root: Path) -> None:
    before = text(root)
    (root / "README.md").unlink()
    assert CliRunner().invoke(app, ["card", str(root)]).exit_code == 0
    assert text(root) == before


def test_failed_sequences_have_a_line_each(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, real = text(root), index.read_index
    rows = real(root).to_pylist()
    rows += [rows[0] | {"index": 100 + k, "status": "failed", "reason": f"why {k}"} for k in range(22)]
    monkeypatch.setattr(index, "read_index", lambda folder: SimpleNamespace(to_pylist=lambda: rows))
    lines = card.write_card(Folder(root)).read_text("utf-8").splitlines()
    (root / "README.md").write_text(before, "utf-8")
    first = lines.index("- 000100: why 0")
    assert lines[first - 2 : first] == ["22 of 3 sequences failed and are not in the dataset:", ""]
    assert lines[first + 19 : first + 22] == ["- 000119: why 19", lines[first + 20], ""]
    assert lines[first + 20].startswith("- and 2 more")


def test_histogram_counts_what_it_is_given() -> None:
    picture = histogram.histogram(np.array([1.0, 1.0, 1.0, 3.0, np.nan]), "a < b", "mN", bins=2)
    tree = ElementTree.fromstring(picture)
    filled = re.search(r"\.(\w+)\{fill: #3b6ea5", next(tree.iter(SVG + "style")).text or "")
    assert filled
    bars = [one.get("d", "") for one in tree.iter(SVG + "path") if one.get("class") == filled[1]]
    tops = [[float(n) for n in re.findall(r"[\d.]+", bar)[1::2]] for bar in bars]
    heights = [max(top) - min(top) for top in tops]
    assert heights[0] == pytest.approx(3 * heights[1], rel=0.01)
    assert "a < b (n = 4)" in [text.strip() for text in tree.itertext()]
    assert ElementTree.fromstring(histogram.histogram(np.array([]), "none", "")) is not None


def test_a_chart_has_the_same_bytes_whatever_the_users_settings() -> None:
    values = np.array([0.0001234, 0.0005, 0.001])
    first = histogram.histogram(values, "small", "mN")
    with matplotlib.rc_context({"font.size": 20.0, "svg.hashsalt": None, "svg.fonttype": "path"}):
        assert histogram.histogram(values, "small", "mN") == first
    texts = {text.strip() for text in ElementTree.fromstring(first).itertext()}
    assert {"0.00025", "0.00050"} <= texts  # coordinates are rounded, what is said is not
    assert "date" not in first.lower()


def test_bars_say_their_counts() -> None:
    tree = ElementTree.fromstring(histogram.bars([2, 7], ["pull", "a & b"], "Gesture"))
    assert {"pull", "a & b", "2", "7", "Gesture"} <= {text.strip() for text in tree.itertext()}
