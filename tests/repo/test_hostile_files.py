"""Job files, meta.yaml and tables from strangers: each is read or refused in a line, in 5 s and 1 GB."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import hostile
import pytest
from fake_recording import Maker
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from synth.job import reader

# ---- What strangers write.

_SCALARS = st.one_of(
    st.integers(-(10**30), 10**30).map(str),
    st.integers(0, 6000).map(lambda n: "9" * n or "0"),
    st.floats().map(lambda x: {"inf": ".inf", "-inf": "-.inf", "nan": ".nan"}.get(str(x), str(x))),
    st.sampled_from(
        ["null", "~", "true", "yes", "''", '"\\0"', '"\\e[31m"', "!!binary aGk=", "!!set {a, b}", "!foo 3",
         "!!python/object:os.system x", "2001-99-99", "2001-01-01", "0001-01-01T00:00:00+99:99", "1:30:00",
         "0x" + "f" * 5000, "0o777", "1e9999", "1e-9999", ".5", "1_000", "/dev/zero", "~nobody/x", "../..",
         "'" + "x" * 5000 + "'", "²", "*a", "&a", "<<", "|\n  text", "- ", "? ", "%", "@", "`", "\t"]
    ),
    st.text(max_size=20),
)  # fmt: skip


def _flow(depth: int) -> SearchStrategy[str]:
    """YAML values in one line, nested; some anchored, some aliases of what may be there."""
    if depth == 0:
        return _SCALARS
    inner = _flow(depth - 1)
    return st.one_of(
        _SCALARS,
        st.lists(inner, max_size=4).map(lambda items: f"[{', '.join(items)}]"),
        st.lists(st.tuples(_SCALARS, inner), max_size=3).map(
            lambda items: "{" + ", ".join(f"{key}: {value}" for key, value in items) + "}"
        ),
        inner.map(lambda value: f"&a {value}"),
        st.integers(1, 3000).map(lambda n: "[" * n),
        st.integers(1, 300).map(lambda n: "[" * n + "]" * n),
        st.just("*a"),
    )


def _bomb(levels: int, width: int) -> str:
    lines = [f"a0: &a0 [{', '.join(['x'] * width)}]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * width)}]" for k in range(1, levels)]
    return "\n".join(lines) + "\n"


def _yaml(keys: list[str]) -> SearchStrategy[bytes]:
    """Files of known keys with wild values, bombs, and bytes of any kind."""
    lines = st.lists(st.tuples(st.sampled_from(keys), _flow(2)), max_size=6).map(
        lambda items: "".join(f"{key}: {value}\n" for key, value in items)
    )
    blocks = st.lists(st.tuples(st.sampled_from(keys), st.sampled_from(keys), _flow(1)), max_size=3).map(
        lambda items: "".join(f"{key}:\n  {name}: {value}\n" for key, name, value in items)
    )
    text = st.one_of(
        lines,
        blocks,
        st.builds(_bomb, st.integers(1, 12), st.integers(1, 12)),
        st.builds("{}{}".format, lines, st.text(max_size=40)),
        st.integers(1, 60_000).map(lambda n: "- " * n),
        st.integers(1, 60_000).map(lambda n: "#\n" * n),
    )
    return st.one_of(text.map(lambda t: t.encode("utf-8", "surrogatepass")), st.binary(max_size=200))


_JOB = _yaml(sorted({str(place[-1]) for place in reader.places()}))
_META = _yaml(
    [
        *("scale_mm_per_px", "calibration", "scale_uncertainty", "young_kpa", "fps", "rest_frame", "press_s"),
        *("specimen", "sensor", "sync", "checkerboard", "corners", "free_s", "method", "bar_px", "colour"),
    ]
)
_CELL = st.one_of(
    st.floats().map(str),
    st.integers(-(10**25), 10**25).map(str),
    st.sampled_from(["", " ", "nan", "inf", "1e400", "²", '"', '"a', "a", "1_0", "0x1", "9" * 200_000, "\0"]),
    st.text(max_size=5),
)
_ROWS = st.lists(st.lists(_CELL, min_size=0, max_size=5).map(",".join), max_size=12).map("\n".join)
_HEADS = st.sampled_from(
    ["t_s,fx_n,fy_n,fz_n\n", "\ufefft_s;fx_n;fy_n;fz_n\n", "frame,t_s\n", "t_s,t_s\n", "", "\x1b[31m\n"]
)
_CSV = st.one_of(
    st.builds("{}{}".format, _HEADS, _ROWS).map(lambda t: t.encode("utf-8", "surrogatepass")),
    st.binary(max_size=100).map(lambda rest: b"t_s,fx_n,fy_n,fz_n\n" + rest),
)


# ---- What is done with it.


@pytest.fixture(scope="module")
def guard() -> Iterator[hostile.Guard]:
    with hostile.Guard() as one:
        yield one


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    return Maker(folder)(frames=3, size=(24, 32))


def render(guard: hostile.Guard, folder: Path, data: bytes) -> None:
    """A file is in the way of the dataset's folder: a sound job gets so far and no further."""
    (folder / "job.yaml").write_bytes(data)
    (folder / "wall").write_text("")
    answer = guard.answer("synth", "render", "job.yaml", "-o", "wall", cwd=folder)
    hostile.assert_told(answer, lines=20)
    assert answer.code == 2


def check(guard: hostile.Guard, recording: Path, name: str, data: bytes) -> None:
    path = recording / name
    before = path.read_bytes()
    try:
        path.write_bytes(data)
        answer = guard.answer("bench", "check", recording)
        hostile.assert_told(answer)
        assert "\x1b" not in answer.out
    finally:
        path.write_bytes(before)


@hostile.cases(data=_JOB)
def test_jobs(guard: hostile.Guard, recording: Path, data: bytes) -> None:
    render(guard, recording.parent, data)


@hostile.cases(data=_META)
def test_meta(guard: hostile.Guard, recording: Path, data: bytes) -> None:
    check(guard, recording, "meta.yaml", data)


@hostile.cases(data=_CSV, name=st.sampled_from(["force.csv", "frames.csv"]))
def test_tables(guard: hostile.Guard, recording: Path, data: bytes, name: str) -> None:
    check(guard, recording, name, data)


@pytest.mark.slow
@hostile.cases(slow=True, data=_JOB)
def test_many_jobs(guard: hostile.Guard, recording: Path, data: bytes) -> None:
    render(guard, recording.parent, data)


@pytest.mark.slow
@hostile.cases(slow=True, data=_META)
def test_many_metas(guard: hostile.Guard, recording: Path, data: bytes) -> None:
    check(guard, recording, "meta.yaml", data)


@pytest.mark.slow
@hostile.cases(slow=True, data=_CSV, name=st.sampled_from(["force.csv", "frames.csv"]))
def test_many_tables(guard: hostile.Guard, recording: Path, data: bytes, name: str) -> None:
    check(guard, recording, name, data)


# ---- The frame itself.


def test_the_guard_sees_what_it_is_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that hangs, takes all memory or processor, crashes or speaks at length is not let pass."""
    (tmp_path / "villain").mkdir()
    (tmp_path / "villain" / "cli.py").write_text(
        "import os, sys, time\n"
        "def app(args):\n"
        "    exec(args[0])\n"
        "    sys.exit(int(args[1]))\n"
    )  # fmt: skip
    (tmp_path / "villain" / "__init__.py").write_text("")
    monkeypatch.setattr(hostile, "SECONDS", 1)
    monkeypatch.setenv("HOSTILE_PATH", str(tmp_path))
    crimes = {
        "raise ValueError('x')": "0",
        "bytearray(2_000_000_000)": "0",
        "os.abort()": "0",
        "print('a\\nb', file=sys.stderr)": "2",
        "pass": "2",
        "pass #": "3",
        "print('x' * 3000, file=sys.stderr)": "2",
        "while True: pass": "0",
    }
    with hostile.Guard() as guard:
        for crime, code in crimes.items():
            with pytest.raises(AssertionError):
                hostile.assert_told(guard.answer("villain", crime, code))
        hostile.assert_told(guard.answer("villain", "print('why', file=sys.stderr)", "2"))
        hostile.assert_told(guard.answer("villain", "print('all')", "0"))
