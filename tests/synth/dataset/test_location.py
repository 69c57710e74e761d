"""Reading a remote dataset over HTTP: the same values as from the folder."""

import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_work import sequence

from synth.dataset.store import Dataset, open_sequence
from synth.errors import UserError
from synth.job.schema import Job

JOB = Job(seed=5, sequences=2, frames=3, render={"size": (40, 30)}, flow={"backend": "ideal"})


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("place") / "out"
    out.mkdir()
    for index in range(JOB.sequences):
        sequence(JOB, index, out, lambda *_: None)
    return out


class Handler(SimpleHTTPRequestHandler):
    """Serves files and byte ranges of them, which Python's own handler does not support."""

    def do_GET(self) -> None:
        path, wanted = Path(self.translate_path(self.path)), self.headers.get("Range", "")
        if not (wanted and path.is_file()):
            return super().do_GET()
        data = path.read_bytes()
        first, _, last = wanted.removeprefix("bytes=").partition("-")
        start = int(first) if first else len(data) - int(last)
        part = data[start : int(last) + 1] if first and last else data[start:]
        self.send_response(206)
        self.send_header("Content-Range", f"bytes {start}-{start + len(part) - 1}/{len(data)}")
        self.send_header("Content-Length", str(len(part)))
        self.end_headers()
        self.wfile.write(part)
        return None

    def log_message(self, *_: Any) -> None:
        """Nothing on the terminal."""


@pytest.fixture
def server(root: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.chdir(root.parent)  # which the handler serves
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as serving:
        thread = threading.Thread(target=serving.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{serving.server_port}"
        serving.shutdown()
        thread.join()


def test_a_dataset_over_http_equals_its_folder(root: Path, server: str) -> None:
    pytest.importorskip("aiohttp", reason="fsspec's HTTP needs aiohttp")
    address = f"{server}/out"
    here, there = Dataset(root), Dataset(address)
    assert [one.index for one in there] == [0, 1]
    for name in here[1].fields:
        assert np.array_equal(there[1][name][:], here[1][name][:])
    assert np.array_equal(there[0]["flow"][2], here[0]["flow"][2])
    assert there[0].attrs == here[0].attrs
    with pytest.raises(UserError, match="no such sequence"):
        open_sequence(f"{address}/000009.zarr")
