"""`synth fit`: heavy imports are inside, as in `cli`."""

from __future__ import annotations

import json as json_
from pathlib import Path
from typing import Annotated

import typer


def fit(
    photo: Annotated[Path, typer.Argument(help="A photograph of exposed cortex, of your own microscope.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The YAML file to write, a job.")] = Path(
        "look.yaml"
    ),
    width_mm: Annotated[
        float,
        typer.Option(
            "--width-mm", min=5, max=400, help="What the photograph's width spans at the cortex [mm]."
        ),
    ] = 35.0,
    mask: Annotated[
        Path | None,
        typer.Option(help="A picture of the same size, white where the cortex is; found if not given."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Measures the camera of one photograph (noise, blur, vignette, codec) and its nearest family."""
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
    if json:
        print(json_.dumps({"job": found, "cortex_mm2": given.cortex_mm2, "out": str(out)}))
    else:
        print("\n".join([*lines, f"wrote {out}; see it with: synth preview {out}"]))
