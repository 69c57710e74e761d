"""The dataset's card: README.md, its pictures, and nothing in it that is not taken from the dataset."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.dataset import index, location, split
from synth.dataset.folder import Folder, write_whole
from synth.dataset.store import Sequence, open_sequence
from synth.fields import FIELDS
from synth.job.law_limits import RIGID_GESTURES
from synth.job.schema import Job
from synth.publish import histogram

_CHARTS = {
    "peak_force_mn": ("Peak force", "mN"),
    "young_kpa": ("Young's modulus", "kPa"),
    "peak_motion_mm": ("Peak motion", "mm"),
    "load": ("Load F/(E a²)", "1"),
}


def write_card(folder: Folder) -> Path:
    """Writes README.md and the pictures it shows, from the index and the sequences. Returns its path."""
    rows = index.read_index(folder.root).to_pylist()
    job, done = folder.job(), [row for row in rows if row["status"] == "done"]
    pictures = folder.root / "card"
    pictures.mkdir(exist_ok=True)
    shown = []
    for name, (title, unit) in _CHARTS.items():
        values = column(done, name)
        if len(values):
            write_whole(pictures / f"{name}.svg", histogram.histogram(values, title, unit))
            shown.append({"title": title, "path": f"card/{name}.svg"})
    best = max(done, key=lambda row: row["peak_flow_px"] or 0.0, default=None)
    sequence = None if best is None else open_sequence(location.store(folder.root, best["index"]))
    example = None if sequence is None else _example(sequence, pictures)
    text = template("card.md.jinja").render(
        **_facts(job, rows, done),
        card=job.card,
        charts=shown,
        example=example,
        example_index=None if best is None else best["index"],
        identity=folder.described()["identity"],
        dataset_hash=index.dataset_hash(rows),
        variant="-" if sequence is None else sequence.attrs.get("variant", "-"),
        versions="" if sequence is None else _versions(sequence.attrs.get("versions", {})),
        fields=_fields(sequence),
        present=job.kept_fields,
        stereo_mm=job.render.stereo_mm,
        columns=columns(),
        limits=limits(folder),
        command="synth render job.yaml -o FOLDER",
    )
    path = folder.root / "README.md"
    write_whole(path, text)
    return path


def limits(folder: Folder) -> list[str]:
    """What a reader must know before trusting the data, given how it was made."""
    job, described = folder.job(), folder.described()
    found = []
    if len(described.get("generators", [])) > 1:
        found.append(
            "Several versions of the program made it: a sequence made again need not have the same bytes."
        )
    if split.read_rule(folder.root).share_anatomy:
        found.append("The split's sides share a brain: scores on it say nothing of other brains.")
    if job.store.flow == "float16":
        found.append(
            "Flow is stored in half floats: see `summary.rounding_px` of a sequence for the largest error."
        )
    if job.fem.time == "quasi-static":
        found.append(
            "The motion is quasi-static: within 3% of damped dynamics after a hold of 0.3 s, not before."
        )
    found += [
        *mechanics(job),
        "What video alone can tell is traction divided by stiffness: give a method `young_kpa`, or score it "
        "without scale.",
    ]
    load = job.fem.largest_load
    if job.fem.law == "linear" and load > 0.05:
        found.append(f"Linear elasticity is exact to some percent up to P = 0.05; loads go to {load:.2g}.")
    if job.fem.law == "corotational":
        found.append(
            "The co-rotational law is the paper's; above P = 0.05 it is no better than the linear one."
        )
    if job.fem.order == 1:
        found.append(
            "Linear tetrahedra are too stiff at a coarse mesh: compare `fem.tets` with the convergence study."
        )
    poisson = job.fem.poisson[1]
    if poisson > 0.45 and job.fem.order == 1:
        found.append(f"Linear tetrahedra lock at a Poisson's ratio of {poisson:g}.")
    elif poisson > 0.42 and not job.fem.averages_volume:
        found.append(f"Elements lock at a Poisson's ratio of {poisson:g}: motion beside a press is wrong.")
    if job.anatomy.mesh is None:
        found.append("The brain is a procedural block: its gyri look right and belong to nobody.")
    noisy = sorted({"flow_noisy", "intensity"} & set(job.store.extra))
    if noisy:
        found.append(
            f"{' and '.join(noisy)}: the published method's labels with its noise, to compare with; truth "
            "is in `flow` and `traction`."
        )
    if job.flow.backend == "ideal":
        found.append(
            "There is no recovered flow: a network trained on this has never seen a tracker's errors."
        )
    return found


def mechanics(job: Job) -> list[str]:
    """What of a living brain's mechanics is in, and what is not."""
    membrane, beat, breath = job.fem.membrane.intact, job.fem.pulse.heart_mm[1], job.fem.pulse.breath_mm[1]
    present = {"membrane": membrane, "heart beat": beat, "breath": breath}
    absent = "".join(f", no {name}" for name, size in present.items() if not size)
    said = [f"Tissue is homogeneous and isotropic: no stiffness of vessels, no bleeding{absent}."]
    if not membrane:
        said.append(
            "Force across the line of sight that is read on a cortex with its pia-arachnoid on, by what was "
            "fitted without one, is off by half of it (a soft one) or not read at all."
        )
    else:
        said.append(
            f"The pia-arachnoid is on {membrane:.0%} of the sequences (drawn), an elastic sheet; it "
            "wrinkles, does not stiffen as it stretches, and its stretch at rest is assumed, not measured."
        )
    if beat or breath:
        said.append(
            "Heart and breath raise the exposed surface by a pressure that no label holds: `force` and "
            "`traction` are the tools' alone."
        )
    low, high = job.fem.poisson
    ratio = f"{low:g}" if low == high else f"drawn from {low:g} to {high:g}"
    said.append(f"Poisson's ratio is {ratio}; tissue within seconds of a load has 0.45 to nearly 0.5.")
    skull = "is bonded to the skull round the opening and doesn't slide along it."
    if "slip" in job.fem.skull:
        skull = "slides along the skull without friction, with no fluid between them."
        if "bonded" in job.fem.skull:
            skull = "is bonded to the skull or, where the scenario says `slip`, slides along it freely."
    return [*said, f"Tissue {skull}", _contact(job)]


def _contact(job: Job) -> str:
    """What loads the tissue."""
    if job.fem.contact == "traction":
        return "Every contact is a given traction on the footprint; no tip of a shape is pressed in or rubs."
    held = ", ".join(kind for kind in sorted(job.fem.kinds) if kind not in RIGID_GESTURES)
    return (
        f"Push, slide and tap are a rigid tip ({job.fem.tip}, friction {job.fem.friction:g}) in contact, "
        "as wide as the footprint, not as the instrument that is seen"
    ) + (f"; {held}: a given traction." if held else ".")


def _at_once(job: Job) -> str:
    """How many gestures a sequence shows."""
    least, most = (max(count, len(job.fem.crew), 1) for count in job.fem.instruments)
    if most == 1:
        return "One gesture"
    asked = ", as the job's `fem.crew` asks" if job.fem.crew else ""
    return f"{least if least == most else f'{least} to {most}'} gestures at once{asked},"


def column(rows: Iterable[Mapping[str, Any]], name: str) -> NDArray[np.float64]:
    """The numbers of one column that are there, (n,)."""
    return np.array([row[name] for row in rows if row.get(name) is not None], np.float64)


def share(rows: Iterable[Mapping[str, Any]], name: str) -> str:
    """How often each value of a column occurs: "pull 12, push 9"."""
    counts = Counter(str(row[name]) for row in rows if row.get(name) is not None)
    return ", ".join(f"{value} {count}" for value, count in sorted(counts.items())) or "-"


def _facts(job: Job, rows: list[dict[str, Any]], done: list[dict[str, Any]]) -> dict[str, Any]:
    frames = int(column(done, "frames").sum())
    return {
        "done": len(done),
        "total": job.sequences,
        "frames": frames,
        "width": job.render.size[0],
        "height": job.render.size[1],
        "backend": job.flow.backend,
        "size_category": size_category(len(done)),
        "ranges": [_range(done, name, *words) for name, words in _CHARTS.items()],
        "families": share(done, "family"),
        "gestures": share(done, "gesture"),
        "anatomies": len({row["anatomy"] for row in done}),
        "splits": share(done, "split") if any(row.get("split") for row in done) else "",
        "failed": [row for row in rows if row["status"] == "failed"],
        "instance": (
            f"{_at_once(job)} on one anatomy: {job.frames} frames at {job.fps:g} frames a second, from rest "
            "through the approach of the instruments and the rise of the load to its release."
        ),
        "mesh": job.anatomy.mesh is not None,
        "photo": job.appearance.photo is not None,
    }


def _range(rows: list[dict[str, Any]], name: str, title: str, unit: str) -> dict[str, str]:
    values = column(rows, name)
    if not len(values):
        return {"name": f"{title} [{unit}]", "low": "-", "middle": "-", "high": "-"}
    low, middle, high = (f"{value:.3g}" for value in np.quantile(values, (0, 0.5, 1)))
    return {"name": f"{title} [{unit}]", "low": low, "middle": middle, "high": high}


def _fields(sequence: Sequence | None) -> list[dict[str, str]]:
    present = list(FIELDS) if sequence is None else sequence.fields
    return [
        {
            "name": name,
            "axes": ", ".join(FIELDS[name].dims),
            "dtype": FIELDS[name].dtype if sequence is None else str(sequence[name].dtype),
            "unit": FIELDS[name].unit,
            "meaning": FIELDS[name].meaning,
        }
        for name in present
    ]


def columns() -> list[dict[str, str]]:
    """Name, unit and meaning of each column of the index."""
    described = []
    for field in index.SCHEMA:
        notes = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
        described.append({"name": field.name, "unit": notes.get("unit", "-"), "meaning": notes["meaning"]})
    return described


def _versions(found: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in found.items())


def size_category(count: int) -> str:
    """The Hugging Face hub's classes."""
    for limit, name in ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K")):
        if count < limit:
            return name
    return "100K<n<1M"


def _example(sequence: Sequence, pictures: Path) -> str:
    from PIL import Image

    from synth.publish import picture

    t = int(np.argmax(np.linalg.norm(sequence["force"][:], axis=1)))
    flow, traction = sequence["flow"][t], sequence["traction"][t]
    row = picture.frame_flow_force(
        sequence["rgb"][t],
        sequence["rgb"][0],
        flow,
        traction,
        sequence["tissue"][:],
        largest_px=max(float(np.hypot(flow[..., 0], flow[..., 1]).max()), 1e-6),
        largest_kpa=max(float(np.linalg.norm(traction, axis=-1).max()), 1e-9),
        captions=(f"frame {t}", "flow from the rest frame", "traction"),
    )
    Image.fromarray(row).save(pictures / "example.png")
    return "card/example.png"


def template(name: str) -> Any:
    """A page of this room, ready to render."""
    import jinja2

    text = (Path(__file__).parent / name).read_text("utf-8")
    return jinja2.Environment(trim_blocks=True, undefined=jinja2.StrictUndefined).from_string(text)
