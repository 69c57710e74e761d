from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered dataset of one short sequence, as the README's commands write it."""
    import synth

    small = ["sequences=1", "seed=3", "anatomy.vertices=2500", "fem.tets=400", "render.spp=2"]
    folder = tmp_path_factory.mktemp("repo") / "out"
    job = synth.load_job("tiny", small)
    with synth.open_dataset(folder, job) as root:
        synth.write_scene(synth.simulate(job), root)
    return folder
