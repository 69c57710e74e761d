"""The command `synth fit`. Heavy imports are inside, as in `synth.cli`."""

from __future__ import annotations

import json as json_
from pathlib import Path
from typing import Annotated

import typer

Photo = Annotated[Path, typer.Argument(help="A photograph of exposed cortex by your microscope.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="The job file (YAML) to write.")]
Width = Annotated[float, typer.Option(min=5, max=400, help="Width of the picture at the cortex [mm].")]
Marked = Annotated[Path | None, typer.Option(help="A mask of the cortex, white; default: detected.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")]


def fit(
    photo: Photo,
    out: Out = Path("appearance.yaml"),
    width_mm: Width = 35.0,
    mask: Marked = None,
    json: AsJson = False,
) -> None:
    """Measures a photograph's camera (colours, noise, blur, vignette, codec) and its appearance family."""
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
        f"# Blur and noise are for pixels of {given.mm_per_px:.4f} mm.",
    ]
    for section, keys in found.items():
        lines += [f"{section}:", *(f"  {name}: {json_.dumps(value)}" for name, value in keys.items())]
    write_whole(out, "\n".join(lines) + "\n")
    if json:
        print(json_.dumps({"job": found, "cortex_mm2": given.cortex_mm2, "out": str(out)}))
    else:
        print("\n".join([*lines, f"wrote {out}; draw it with: synth preview {out}"]))
