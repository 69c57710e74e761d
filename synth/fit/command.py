"""`synth fit`: heavy imports are inside, as in `cli`."""

from __future__ import annotations

import json as json_
from pathlib import Path
from typing import Annotated

import typer

Photo = Annotated[Path, typer.Argument(help="A photograph of exposed cortex, of your own microscope.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="The YAML file to write, a job.")]
Width = Annotated[float, typer.Option(min=5, max=400, help="What its width spans at the cortex [mm].")]
Marked = Annotated[Path | None, typer.Option(help="A picture of its size, white on cortex; else found.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")]


def fit(
    photo: Photo,
    out: Out = Path("appearance.yaml"),
    width_mm: Width = 35.0,
    mask: Marked = None,
    json: AsJson = False,
) -> None:
    """Measures a photograph's camera (colours, noise, blur, vignette, codec) and its nearest family."""
    from synth.errors import UserError
    from synth.fit import fitting
    from synth.fit.photograph import read_photograph
    from synth.system.checked_file import write_whole

    if out.exists() or not out.resolve().parent.is_dir():
        raise UserError(f"{out}: {'exists already' if out.exists() else 'its folder does not exist'}")
    given = read_photograph(photo, width_mm, mask)
    found = fitting.fit_camera(given)
    lines = [
        f"# Measured in {photo.name} by synth fit, on {given.cortex_mm2:.0f} mm2 of cortex.",
        f"# Blur and noise are of pixels of {given.mm_per_px:.4f} mm.",
    ]
    for section, keys in found.items():
        lines += [f"{section}:", *(f"  {name}: {json_.dumps(value)}" for name, value in keys.items())]
    write_whole(out, "\n".join(lines) + "\n")
    said = json_.dumps({"job": found, "cortex_mm2": given.cortex_mm2, "out": str(out)})
    print(said if json else "\n".join([*lines, f"wrote {out}; see it with: synth preview {out}"]))
