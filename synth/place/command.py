"""What `synth place` does: finds, draws, writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from synth.errors import UserError
from synth.place import openings, page, picture
from synth.place.openings import Survey
from synth.system.text_lines import hang
from synth.system.whole_file import made_folder, part_of, write_whole

_ROOM_BYTES = 32 << 20  # the page, with the charts' program in it


@dataclass(frozen=True)
class Placed:
    """What was found, and the folder with its picture, page and job."""

    found: Survey
    folder: Path

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        said = [
            {
                **openings.craniotomy(site, self.found.radius_mm).model_dump(include={"point", "direction"}),
                "relief_mm": round(site.relief_mm, 3),
                "filled": round(site.filled, 3),
            }
            for site in self.found.chosen
        ]
        return {
            "openings": said,
            "others": len(self.found.others),
            "radius_mm": self.found.radius_mm,
            "note": self.found.note,
            "out": str(self.folder),
        }

    def lines(self) -> list[str]:
        """For a terminal: a line an opening, then the job's lines of the best."""
        said = hang("note: ", self.found.note) if self.found.note else []
        said.append(f"   {'point [mm]':<28}  {'direction':<24}  relief [mm]")
        for number, site in enumerate(self.found.chosen, 1):
            x, y, z = site.point
            u, v, w = site.direction
            point, direction = f"[{x:.2f}, {y:.2f}, {z:.2f}]", f"[{u:.3f}, {v:.3f}, {w:.3f}]"
            said.append(f"{number:<2} {point:<28}  {direction:<24}  {site.relief_mm:.2f}")
        said += [f"{self.folder}: openings.png, openings.html to click, job.yaml:", ""]
        best = openings.lines(self.found.path, self.found.chosen[0], self.found.radius_mm, self.folder)
        return [*said, *best.splitlines()]


def place(brain: Path, radius_mm: float, count: int, folder: Path) -> Placed:
    """Finds a brain's openings and writes openings.png, openings.html and job.yaml, all or none of them.

    Raises:
        UserError: the brain cannot be used, or the folder holds another's job.
    """
    import cv2
    import plotly.offline  # noqa: F401  # the page's, of the extra `bench`: found missing before the search

    if (folder / "job.yaml").exists():
        raise UserError(f"{folder / 'job.yaml'}: exists already")
    found = openings.find_openings(brain, radius_mm, count)
    with made_folder(folder, _ROOM_BYTES):
        drawn = picture.draw_openings(found)
        good, coded = cv2.imencode(".png", drawn[..., ::-1])
        assert good
        page.write_page(found, folder / "openings.html")
        with part_of(folder / "openings.png") as part:
            part.write_bytes(coded.tobytes())
        best = openings.lines(brain, found.chosen[0], radius_mm, folder)
        head = "# The best opening of `synth place`; the others are in openings.html.\n"
        write_whole(folder / "job.yaml", head + best + openings.also(found.chosen[1:], radius_mm))
    return Placed(found, folder)
