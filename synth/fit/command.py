"""`synth fit`: heavy imports are inside, as in `cli`."""

from __future__ import annotations

import json as json_
import sys
from pathlib import Path
from typing import Annotated

import typer

_FRAME_S = 4.0  # CPU of a frame that is tried, 480 x 360, on one core
_START_S = 8.0


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
    sheet: Annotated[
        Path | None,
        typer.Option(help="Also write the photograph beside frames before and after, as this picture."),
    ] = None,
    rounds: Annotated[int, typer.Option(min=2, max=50, help="Times that all parameters are improved.")] = 7,
    anatomies: Annotated[int, typer.Option(min=1, max=20, help="Anatomies that are rendered each time.")] = 3,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Fits a family of the job to one photograph: colours, vessels, highlights, blur, noise, vignette, codec.

    Small frames are rendered with parameters that are tried, and the parameters changed until the frames'
    statistics are the photograph's. Instruments, highlights and what is no cortex are left out.
    """
    from rich.console import Console
    from rich.progress import Progress

    from synth.errors import UserError
    from synth.fit import fitting

    for target in (out, sheet):
        if target is not None and not target.resolve().parent.is_dir():
            raise UserError(f"{target}: its folder does not exist")
    if sheet is not None and sheet.suffix.lower() not in (".png", ".jpg", ".jpeg", ".webp"):
        raise UserError(f"{sheet}: is no name of a picture (.png, .jpg, .webp)")
    if out.exists():
        raise UserError(f"{out}: exists already")
    frames = (rounds + 2) * anatomies
    print(
        f"{frames} small frames: about {(frames * _FRAME_S + _START_S) / 60:.1f} CPU-minutes", file=sys.stderr
    )
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("rounds", total=rounds)

        def said(turn: int, distance: float) -> None:
            bar.update(task, completed=turn)
            bar.console.print(f"round {turn} of {rounds}: distance {distance:.3f}", highlight=False)

        found = fitting.fit_photograph(photo, out, width_mm, mask, sheet, rounds, anatomies, said)
    if json:
        print(json_.dumps(fitting.as_dict(found) | {"out": str(out)}))
        return
    print("\n".join([*fitting.summary(found), f"wrote {out}; see it with: synth preview {out}"]))
