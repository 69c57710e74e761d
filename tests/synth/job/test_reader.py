"""Job files: what is written is what is read, and every mistake is named at its place."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from synth.cli import app
from synth.errors import UserError
from synth.job import identity, reader, writer
from synth.job.schema import Job

BAD = """\
seed: -1
frames: many
render:
  sppp: 3
  spp: 0
  variant: lvm_ad_rgb
fem:
  poisson: 0.5
  load: [3, 1]
anatomy:
  mesh: nope.obj
spp: 3
"""


def problems(text: str, *overrides: str, folder: Path | None = None) -> list[str]:
    with pytest.raises(UserError) as caught:
        reader.parse_job(text, "job.yaml", folder or Path(), overrides)
    return str(caught.value).splitlines()


def test_every_mistake_at_once_with_line_and_column() -> None:
    found = problems(BAD)
    for expected in (
        "job.yaml:1:7: seed: -1 is out of range, it must be >= 0",
        "job.yaml:2:9: frames: a whole number is needed, not 'many'",
        "job.yaml:4:3: render.sppp: unknown key, did you mean 'spp'?",
        "job.yaml:5:8: render.spp: 0 is out of range, it must be >= 1",
        "job.yaml:8:12: fem.poisson[0]: 0.5 is out of range, it must be < 0.5",
        "job.yaml:9:9: fem.load: the lower end 3 is above the upper end 1",
        "job.yaml:12:1: spp: unknown key, did you mean 'render.spp'?",
    ):
        assert expected in found
    assert any(line.startswith("job.yaml:6:12: ") and "did you mean 'llvm_ad_rgb'" in line for line in found)
    missing = f"job.yaml:11:9: anatomy.mesh: {Path('nope.obj').resolve()}: no such file"
    assert missing in found
    assert [int(line.split(":")[1]) for line in found] == sorted(int(line.split(":")[1]) for line in found)


@pytest.mark.parametrize(
    ("text", "place"),
    [("render: [", "job.yaml:"), ("seed: 1\nseed: 2\n", "job.yaml:2:1"), ("- 1\n", "job.yaml:1:1")],
)
def test_what_is_not_a_job_is_said_so(text: str, place: str) -> None:
    assert problems(text)[0].startswith(place)


def test_negative_stiffness_and_nan_are_refused() -> None:
    assert "fem.young_kpa" in problems("fem: {young_kpa: -3}")[0]
    assert "finite" in problems("fem: {young_kpa: .nan}")[0]


def test_overrides_win_and_name_themselves_when_wrong() -> None:
    job = reader.parse_job(
        "render: {spp: 2}", "job.yaml", Path(), ["render.spp=8", "render.size=[64, 48]", "fem.load=0.1"]
    )
    assert (job.render.spp, job.render.size, job.fem.load) == (8, (64, 48), (0.1, 0.1))
    assert problems("", "seed")[0] == "job.yaml:1:1: a job is a block of `key: value` lines"
    assert problems("seed: 1", "render.spp=0")[0].startswith("'render.spp=0': render.spp: 0 is out of range")
    assert "section.key=value" in problems("seed: 1", "render.spp")[0]
    unknown = problems("seed: 1", "rendr.spp=1")[0]
    assert unknown == "'rendr.spp=1': rendr: unknown key, did you mean 'render'?"


def test_paths_start_at_the_job_file(tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_bytes(b"x")
    (tmp_path / "job.yaml").write_text("appearance: {photo: photo.jpg}\n")
    assert reader.load_job(str(tmp_path / "job.yaml")).appearance.photo == (tmp_path / "photo.jpg").resolve()


def test_commented_file_and_dump_read_back_as_the_same_job() -> None:
    job = Job(seed=3, fem={"load": 0.05}, appearance={"families": ["pale", "calf"]}, render={"exr": True})
    assert reader.parse_job(writer.commented(job), "job.yaml", Path()) == job
    assert reader.parse_job(writer.dump_job(job), "job.yaml", Path()) == job


def test_commented_file_explains_every_key() -> None:
    lines = writer.commented().splitlines()
    for place in reader.places():
        at = next(k for k, line in enumerate(lines) if line.strip().startswith(f"{place[-1]}:"))
        assert lines[at - 1].strip().startswith("#"), f"{place} has no comment"


@pytest.mark.parametrize("name", reader.names())
def test_named_jobs_are_valid(name: str) -> None:
    assert reader.load_job(name).sequences >= 1


def test_named_jobs_are_those_promised() -> None:
    assert {"tiny", "demo", "paper"} <= set(reader.names())
    with pytest.raises(UserError, match="did you mean 'demo'"):
        reader.load_job("demmo")


def test_identity_is_of_what_shapes_a_sequence(tmp_path: Path) -> None:
    assert identity.identify_job(Job(sequences=3)) == identity.identify_job(Job(sequences=30))
    assert identity.identify_job(Job(seed=1)) != identity.identify_job(Job(seed=2))
    first, second = tmp_path / "a.jpg", tmp_path / "b.jpg"
    for file in (first, second):
        file.write_bytes(b"picture")
    jobs = [Job(appearance={"photo": file}) for file in (first, second)]
    assert identity.identify_job(jobs[0]) == identity.identify_job(jobs[1])
    second.write_bytes(b"another")
    assert identity.identify_job(jobs[0]) != identity.identify_job(jobs[1])


def test_new_and_schema_from_the_command_line(tmp_path: Path) -> None:
    runner, path = CliRunner(), tmp_path / "my job.yaml"
    assert runner.invoke(app, ["new", str(path)]).exit_code == 0
    assert reader.load_job(str(path)) == Job()
    again = runner.invoke(app, ["new", str(path)])
    assert again.exit_code == 2
    assert "exists already" in again.stderr
    schema = runner.invoke(app, ["schema"])
    assert schema.exit_code == 0
    assert "Light paths a pixel" in schema.stdout


def test_bad_job_writes_nothing_and_exits_with_2(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["render", "tiny", "render.spp=0", "-o", str(tmp_path / "out")])
    assert done.exit_code == 2
    assert "render.spp: 0 is out of range" in done.stderr
    assert not (tmp_path / "out").exists()
