"""Pages agree with the code: generated pages are current, commands and keys exist, code blocks run."""

import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from urllib.parse import unquote

import generate
import pytest
from fake_model import write_model
from ruamel.yaml import YAML

import synth
from bench.recording.from_sequence import export_recording
from bench.recording.meta import Meta
from synth.dataset.store import Dataset
from synth.job.reader import load_job, names
from synth.job.schema import Job

DOCS = generate.DOCS
ROOT = DOCS.parent
PAGES = [
    page
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
    if page.relative_to(ROOT).parts[:2] not in (("docs", "results"), ("docs", "reference"))
]
PLUG_INS = ("flow", "law", "method")
_TOP = "synth|learn|bench|evidence|weights|tests|examples"
OURS = re.compile(rf"(?<![\w./@-])(?:{_TOP})/[\w/]+(?:-\w+)*(?:\.[a-z0-9]+)*")


def blocks(page: Path, language: str) -> Iterator[tuple[str, str]]:
    """Fenced blocks of a language: title and text."""
    for match in re.finditer(rf"^```{language}(.*?)\n(.*?)^```", page.read_text("utf-8"), re.M | re.S):
        title = re.search(r'title="(.*?)"', match[1])
        yield title[1] if title else "", match[2]


@pytest.fixture(scope="module")
def commands() -> dict[tuple[str, ...], generate.Command]:
    """Every command, by its words."""
    return {command.words: command for command in generate.commands()}


def test_generated_pages_are_current() -> None:
    stale = [page.name for page, text in generate.pages().items() if page.read_text("utf-8") != text]
    assert not stale, "out of date: run `make docs`"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_keys_and_files_that_a_page_names_exist(
    page: Path, commands: dict[tuple[str, ...], generate.Command]
) -> None:
    text = page.read_text("utf-8")
    for line in re.sub(r" *\\\n +", " ", text).splitlines():
        if not re.match(r"(    )+(\.venv/bin/)?(synth|learn|bench) ", line):
            continue
        words = shlex.split(line.strip().removeprefix(".venv/bin/"), comments=True)
        depth = next((k for k in (3, 2) if len(words) >= k and tuple(words[:k]) in commands), 0)
        assert depth, f"{line}: there is no such command"
        command = commands[tuple(words[:depth])]
        if "--help" not in words and not command.group:
            command.click.make_context(words[depth - 1], words[depth:])
    for title, block in blocks(page, "yaml"):
        if title in ("job.yaml", "meta.yaml"):
            {"job.yaml": Job, "meta.yaml": Meta}[title].model_validate(YAML(typ="safe").load(block))
    for title, block in blocks(page, "python"):
        if title.startswith("examples/"):
            assert block.strip() in (ROOT / title).read_text("utf-8"), f"{page.name} and {title} differ"
    lost = [name for name in OURS.findall(text) if not (ROOT / name).exists()]
    assert not lost, f"{page.name} names {lost}"


def test_every_command_has_help_and_examples_that_parse(
    commands: dict[tuple[str, ...], generate.Command],
) -> None:
    for words, command in commands.items():
        assert command.click.help, words
        assert all(param.help for param in command.click.params), f"{words}: a parameter has no help"
        assert command.examples or command.group, f'{words} has no example: epilog="Example: ..."'
        for line in command.examples:
            line_words = shlex.split(line)
            assert tuple(line_words[: len(words)]) == words
            end = next((k for k, word in enumerate(line_words) if word in (">", "|")), len(line_words))
            if not command.group:
                command.click.make_context(words[-1], line_words[len(words) : end])


def test_the_help_of_a_job_names_every_job(commands: dict[tuple[str, ...], generate.Command]) -> None:
    (source,) = (param for param in commands["synth", "render"].click.params if param.name == "job")
    assert source.help
    assert set(re.findall(r"[\w-]+", source.help.partition("named job:")[2])) == set(names())


def test_every_attribute_of_a_sequence_is_on_its_page() -> None:
    page = (DOCS / "fields.md").read_text("utf-8")
    assert not [name for name in synth.sample()[0].attrs if f"`{name}`" not in page]


def test_recipes_state_the_size_of_every_job() -> None:
    text = (DOCS / "recipes.md").read_text("utf-8")
    rows = re.findall(r"^\| `([\w-]+)` \| [^|]* \| ([\d,]+) × (\d+), (\d+) × (\d+) \|", text, re.M)
    sizes = {name: tuple(int(value.replace(",", "")) for value in values) for name, *values in rows}
    jobs = {name: load_job(name) for name in names()}
    assert sizes == {name: (job.sequences, job.frames, *job.render.size) for name, job in jobs.items()}


METHODS = "physics", "network and physics", "D2FNet", "mean |flow|"  # columns of the README's table


def test_figures_of_the_readme_are_those_of_stored_results() -> None:
    text = (ROOT / "README.md").read_text("utf-8")
    rows = re.findall(r"^\| .*\[(.*)\]\((docs/results/.*)README.md\) \| (.*) \|$", text, re.M)
    assert len(rows) == 4
    for row_name, folder, cells in rows:
        methods = json.loads((ROOT / folder / "pool.json").read_text("utf-8"))["methods"]
        key = {"every frame": "mae_of_peak", "peaks": "peak_mae"}[row_name]
        values = [methods[name]["scores"][key]["mean"] if name in methods else None for name in METHODS]
        assert cells.split(" | ") == ["–" if value is None else f"{value:.1%}" for value in values]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_percentages_in_a_sentence_that_links_to_a_result_are_on_its_page(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text("utf-8"), flags=re.S)
    for part in re.split(r"(?<=[.!?])\s+(?=[A-Z*\[])|\n\n|\n\||\n- ", text):
        links = re.findall(r"\]\(([^)#]*results/[^)#]*\.md)\)", part)
        if not links:
            continue
        linked_text = " ".join((page.parent / link).read_text("utf-8") for link in links)
        numbers = set(re.findall(r"\d+(?:\.\d+)?", linked_text))
        for percentage in re.findall(r"\d+(?:\.\d+)?(?=%)", re.sub(r"\([^)]*\)", "", part)):
            digits = len(percentage.partition(".")[2])
            shares = {f"{100 * float(number):.{digits}f}" for number in numbers if "." in number}
            assert percentage in numbers | shares, f"{page.name}: {percentage}% is not in {links}"


HOWTO = ("instruments", "mechanics", "export", "camera", "models", *PLUG_INS)
LONG = ("models", "export", *PLUG_INS)
"""Pages that train a model, write all formats or install a package."""
GIVEN = {
    "camera": """
import numpy as np
height, width, t = 48, 64, 1
K_left = K_right = np.array([[100, 0, 31.5], [0, 100, 23.5], [0, 0, 1]])
distortion_left = distortion_right = np.zeros(5)
rotation, translation = np.eye(3), np.array([-8.0, 0, 0])
lefts = np.random.default_rng(0).integers(0, 255, (2, height, width, 3), dtype=np.uint8)
rights = np.roll(lefts, -4, axis=2)
left_blocked = right_blocked = np.zeros((2, height, width), bool)
tissue, flow = ~left_blocked[0], np.zeros((2, height, width, 2), np.float32)
confidence = np.ones((2, height, width), np.float32)
""",
    "models": """
from pathlib import Path
import learn.inference.shipped_networks as shipped
shipped.MODELS = Path("packed")
""",
}
"""What the blocks of a page assume: the user's own pictures; a folder for models outside the checkout."""

READER = """
import json, runpy, sys
exports, scripts = json.loads(sys.argv[1]), sys.argv[2:]
if exports:
    from synth.cli import app
for words in exports:
    assert not app(words, standalone_mode=False), words
for script in scripts:
    sys.argv = [script]
    runpy.run_path(script, run_name="__main__")
"""
"""Runs the commands of a page and then its scripts, in one interpreter: starting costs more than running."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(page_name, marks=[pytest.mark.trial] * (Path(page_name).name in LONG))
        for page_name in ("README", "docs/tutorial", *(f"docs/howto/{name}" for name in HOWTO))
    ],
)
def test_code_blocks_of_a_page_run(name: str, out: Path, tmp_path: Path) -> None:
    """Its scripts run with the files that it shows; its package installs and its entry point loads."""
    page = ROOT / f"{name}.md"
    pip = "-m pip install -q --no-build-isolation --no-deps --no-index --target site ."
    (tmp_path / "out").symlink_to(out)
    export_recording(Dataset(out)[0], tmp_path / "recordings/000000")
    write_model(tmp_path / "model")

    def run(words: Iterable[str], path: str = "") -> None:
        environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{path}"}
        result = subprocess.run([sys.executable, *words], cwd=tmp_path, stderr=-1, text=True, env=environment)
        assert result.returncode == 0, f"{page.stem}: {words}: {result.stderr[-2000:]}"

    exports = re.findall(r"^    synth (export out .*)", page.read_text("utf-8"), re.M)
    scripts = []
    for k, (title, text) in enumerate(blocks(page, "python")):
        packages = re.findall(r"^(?:from|import) (\w+)", text, re.M)
        if all(map(importlib.util.find_spec, packages)):
            scripts.append(Path(title or f"block{k}.py").name)
            (tmp_path / scripts[-1]).write_text(GIVEN.get(page.stem, "") + text)
    (tmp_path / "reader.py").write_text(READER)
    run(["reader.py", json.dumps([*map(shlex.split, exports)]), *scripts])
    for title, text in blocks(page, "toml"):
        (tmp_path / title).write_text(text)
        run(pip.split())
        load = f"(p,) = importlib.metadata.entry_points(group='sulcus.{page.stem}'); p.load()()"
        run(["-c", f"import importlib.metadata; {load}"], "site")


GAP = """
import json, sys
from learn.cli import app as learn
from synth.cli import app as synth
for program, *words in json.loads(sys.argv[1]):
    assert not {"synth": synth, "learn": learn}[program](words, standalone_mode=False), words
"""
SMALL = {
    "render": "sequences=8 frames=3 anatomy.vertices=2500 fem.tets=400 render.size=[96,72] render.spp=1",
    "train": "epochs=1",
    "eval": "--json",
}


@pytest.mark.trial
def test_the_commands_that_measure_the_gap_run_in_small(tmp_path: Path) -> None:
    """Both networks are scored on both displacements of the same held-out sequences."""
    lines = re.findall(
        r"^    ((?:synth|learn) (\w+) .*\bdata\b.*)", (DOCS / "howto/gap.md").read_text("utf-8"), re.M
    )
    commands = [[*shlex.split(line), *SMALL[name].split()] for line, name in lines]
    assert [name for _, name in lines] == ["render", *2 * ["train"], *4 * ["eval"]]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", GAP, json.dumps(commands)]
    result = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stderr[-2000:]
    scores = [json.loads(line) for line in result.stdout.splitlines() if line.startswith('{"model"')]
    assert [(Path(score["model"]).name, score["input"]) for score in scores] == [
        (network, tested) for network in ("ideal", "recovered") for tested in ("ideal", "recovered")
    ]
    assert len({json.dumps([sequence["name"] for sequence in score["sequences"]]) for score in scores}) == 1
    assert all(sequence["force_mae"] > 0 for score in scores for sequence in score["sequences"])


@pytest.mark.trial
def test_the_site_is_whole_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    """Beyond `--strict`, which ignores pictures and data files."""
    shutil.copytree(DOCS, tmp_path / "docs")
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    environment = {**os.environ, "PYTHONPATH": "docs"}
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stdout + result.stderr
    site = tmp_path / "site"
    fences = len(list(blocks(DOCS / "science.md", "math")))
    assert (site / "science.html").read_text("utf-8").count("<math") == fences
    faults, pages = [], [page for page in site.rglob("*.html") if page.name != "404.html"]
    for page in pages:
        for tag, link in re.findall(r"""<(\w+)\b[^>]*? (?:src|href)="([^"#]+)""", page.read_text("utf-8")):
            if re.match(r"([a-z]+:|//)", link):
                faults += [f"{page.name} loads {link}"] * (tag != "a" and not link.startswith("data:"))
            elif not (page.parent / unquote(link)).resolve().is_file():
                faults.append(f"{page.relative_to(site)}: {link}")
    assert len(pages) > 20
    assert not faults, "\n".join(faults)
