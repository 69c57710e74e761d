"""Job files: read as written, errors reported with their place; named jobs can all be drawn."""

from pathlib import Path
from typing import get_args

import pytest

from synth.errors import UserError
from synth.job import identity, job_writer, reader
from synth.job.schema import Family, Job
from synth.render.appearance.family import FAMILIES
from synth.sequence.draw import draw_scenario

BAD = """\
seed: -1
frames: many
render:
  sppp: 3
  spp: 0
fem:
  poisson: [0.4, 0.5]
  load: [3, 1]
  young_kpa: [1, .nan]
anatomy:
  mesh: nope.obj
"""


def test_every_error_is_reported_with_line_and_column() -> None:
    with pytest.raises(UserError) as error:
        reader.parse_job(BAD, "job.yaml", Path())
    places = [": ".join(line.split(": ")[:2]) for line in str(error.value).splitlines()]
    assert [place.removeprefix("job.yaml:") for place in places] == [
        "1:1: seed",
        "2:1: frames",
        "4:3: render.sppp",
        "5:3: render.spp",
        "7:18: fem.poisson[1]",
        "8:3: fem.load",
        "9:18: fem.young_kpa[1]",
        "10:1: anatomy",
        "11:3: anatomy.mesh",
    ]


@pytest.mark.parametrize("text", ["render: [", "seed: 1\nseed: 2\n", "- 1\n"])
def test_what_is_not_a_job_is_refused(text: str) -> None:
    with pytest.raises(UserError):
        reader.parse_job(text, "job.yaml", Path())


def test_overrides_take_precedence_and_are_named_if_wrong() -> None:
    overrides = ["render.spp=8", "render.size=[64, 48]", "fem.load=0.1"]
    job = reader.parse_job("render: {spp: 2}", "job.yaml", Path(), overrides)
    assert (job.render.spp, job.render.size, job.fem.load) == (8, (64, 48), (0.1, 0.1))
    for override in ("render.spp=0", "rendr.spp=1", "render.spp", "frames=2"):
        with pytest.raises(UserError, match=override):
            reader.parse_job("seed: 1", "job.yaml", Path(), [override])


def test_commented_file_and_dump_read_back_as_the_same_job() -> None:
    tool = {"timing": ["0.1 s", "0.2 s", "0.3 s", "0.4 s"]}
    fem = {"load": 0.05, "instrument": "spatula", "instrument_list": [tool]}
    job = Job(seed=3, fem=fem, appearance={"families": ["pale", "calf"]})
    assert reader.parse_job(job_writer.document_job(job), "job.yaml", Path()) == job
    assert reader.parse_job(job_writer.dump_job(job), "job.yaml", Path()) == job


def test_the_identity_does_not_depend_on_the_number_of_sequences() -> None:
    assert identity.identify_job(Job(sequences=3)) == identity.identify_job(Job(sequences=30))
    assert identity.identify_job(Job(seed=1)) != identity.identify_job(Job(seed=2))


HOME = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize("name", reader.names())
def test_a_named_job_is_read_and_drawn(name: str) -> None:
    job = reader.load_job(name)
    for index in range(min(job.sequences, 5)):
        assert draw_scenario(job, index).gestures


def test_out_of_distribution_appearance_and_anatomy_are_not_in_the_training_data() -> None:
    paths = ("mission", f"{HOME}/weights/mission-bench.yaml", f"{HOME}/evidence/curves/mission-ood.yaml")
    train, bench, ood = map(reader.load_job, paths)
    assert not set(ood.appearance.families) & {*train.appearance.families, *bench.appearance.families}
    assert ood.anatomy.gyrus_mm[1] <= train.anatomy.gyrus_mm[0]
    assert ood.anatomy.sulcus_mm[1] <= train.anatomy.sulcus_mm[0]
    assert ood.fem == train.fem == bench.fem
    assert len({job.seed for job in (train, bench, ood)}) == 3


def test_every_family_has_its_ranges() -> None:
    assert get_args(Family) == tuple(FAMILIES)


def test_a_named_job_is_found_beside_a_folder_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`synth render mission -o mission` is continued where it was begun; a file of that name is read."""
    usual = reader.load_job("mission")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mission").mkdir()
    assert reader.load_job("mission") == usual
    (tmp_path / "tiny").write_text("sequences: 77\n")
    assert reader.load_job("tiny").sequences == 77
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError):
        reader.load_job("folder")
