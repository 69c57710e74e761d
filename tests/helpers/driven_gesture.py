"""A gesture whose instrument holds the tissue and is driven."""

import numpy as np

from synth.fem.tool_gesture import Drive, Gesture, ToolContact, grip

Vector = tuple[float, float, float]


def gesture(
    kind: str = "push",
    direction: Vector = (0.0, 0.0, -1.0),
    travel: float | None = 2.0,
    force: float | None = None,
    size: tuple[float, float] = (8.0, 8.0),
    place: tuple[float, float] = (0.0, 0.0),
) -> Gesture:
    """`direction`: a unit vector; `travel` mm or `force` mN at the peak; `size`, `place`: mm."""
    spread, closing = (6.0, 1.0) if kind == "grasp" else (1.0, 0.0)
    places, _ = grip(kind, np.array(place), np.array(direction), spread, 0.0)
    return Gesture(
        kind=kind,
        instrument="forceps" if kind == "grasp" else "dissector",
        contacts=tuple(ToolContact((float(x), float(y)), (0.0, 0.0, 0.0)) for x, y in places),
        footprint_mm=0.5 * float(np.sqrt(size[0] * size[1])),
        load=0.0,
        point_mm=place,
        direction=direction,
        force_mn=force or 0.0,
        path_mm=(0.0, 0.0),
        azimuth_deg=0.0,
        elevation_deg=50.0,
        spread_mm=spread,
        hover_mm=8.0,
        taps=1,
        timing=(0.1, 0.4, 0.6, 0.9),
        drive=Drive(travel, force, closing, size),
    )
