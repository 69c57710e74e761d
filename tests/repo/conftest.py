from pathlib import Path

import pytest
from made_once import made_once


def render(folder: Path) -> None:
    import synth

    small = ["sequences=1", "seed=3", "anatomy.vertices=2500", "fem.tets=400", "render.spp=2"]
    job = synth.load_job("tiny", small)
    with synth.open_dataset(folder / "out", job) as root:
        synth.write_scene(synth.simulate(job), root)


@pytest.fixture(scope="session")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered dataset of one short sequence, as the README's commands write it; not to be modified."""
    return made_once(tmp_path_factory, "rendered", render) / "out"
