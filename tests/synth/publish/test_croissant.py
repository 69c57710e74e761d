"""The description for machines: clean for the public validator, whole by our list, readable by others."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from fake_run import in_process
from fake_work import consistent

from synth.dataset import index
from synth.dataset.folder import Folder
from synth.job.schema import Job
from synth.publish import croissant

JOB = Job(
    sequences=4,
    frames=2,
    render={"size": (32, 24)},
    flow={"backend": "ideal"},
    card={
        "title": "Pulls",
        "licence": "cc-by-4.0",
        "authors": ["A. Person"],
        "url": "https://example.org/pulls",
        "published": "2027-01-31",
    },
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("croissant") / "out"
    in_process(JOB, out, consistent)
    croissant.write_croissant(Folder(out))
    return out


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_public_validator_is_content_and_reads_the_records(root: Path) -> None:
    import mlcroissant

    dataset = mlcroissant.Dataset(jsonld=str(root / croissant.NAME))
    assert not dataset.metadata.issues.errors
    assert not dataset.metadata.issues.warnings
    records = list(dataset.records("sequences"))
    assert [record["sequences/index"] for record in records] == [0, 1, 2, 3]
    assert [record["sequences/content_hash"].decode() for record in records] == [
        row["content_hash"] for row in index.read_index(root).to_pylist()
    ]


def test_every_required_key_is_there_and_its_loss_is_seen(root: Path) -> None:
    described = json.loads((root / croissant.NAME).read_text())
    assert croissant.missing(described) == []
    for key in croissant.REQUIRED:
        assert croissant.missing({name: value for name, value in described.items() if name != key}) == [key]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of rdflib's own
def test_a_reader_of_linked_data_sees_the_same(root: Path) -> None:
    rdflib = pytest.importorskip("rdflib", reason="rdflib comes with mlcroissant")
    document = json.loads((root / croissant.NAME).read_text("utf-8"))
    graph = rdflib.Graph().parse(data=json.dumps(document), format="json-ld")
    schema, cr = rdflib.Namespace("https://schema.org/"), rdflib.Namespace("http://mlcommons.org/croissant/")
    (dataset,) = graph.subjects(rdflib.RDF.type, schema.Dataset)
    assert str(graph.value(dataset, schema.name)) == document["name"]
    assert len(list(graph.subjects(rdflib.RDF.type, cr.Field))) == len(index.SCHEMA)
    rai = rdflib.Namespace("http://mlcommons.org/croissant/RAI/")
    assert len(list(graph.objects(dataset, rai.dataLimitations))) == len(document["rai:dataLimitations"])


def test_what_nobody_said_is_not_made_up(root: Path) -> None:
    path = root / "dataset.json"
    before = path.read_text()
    document = json.loads(before)
    document["job"]["card"] = {}
    path.write_text(json.dumps(document))
    unsaid = croissant.missing(croissant.describe(Folder(root)))
    path.write_text(before)
    assert unsaid == ["creator", "license", "url", "datePublished"]


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
def test_the_folder_loads_with_datasets(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(os.environ, "HF_HUB_OFFLINE", "1")
    monkeypatch.setitem(os.environ, "HF_HOME", str(tmp_path))
    import datasets

    loaded = datasets.load_dataset(str(root), split="train", cache_dir=str(tmp_path))
    assert loaded["index"][:] == [0, 1, 2, 3]
    assert set(index.SCHEMA.names) <= set(loaded.column_names)
