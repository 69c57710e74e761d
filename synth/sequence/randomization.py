"""Domain randomisation: what a network must not rely on is drawn at random, wider than reality.

J. Tobin et al., "Domain randomization for transferring deep neural networks from simulation to the real
world", 2017. A group's strength moves its ranges from the usual ones (0) to the widest (1), chosen by eye.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from synth.job import identity
from synth.job.microscope import BLUR_WIDTH_PX
from synth.job.schema import AttachmentSection, Job
from synth.job.types import Group, Scenery
from synth.render.appearance.family import Appearance, Colour
from synth.render.appearance.light import FreeLamp, Lighting, blackbody
from synth.render.camera.camera import CameraView, Lens
from synth.render.camera.colour_processing import KNOTS, encode_srgb
from synth.render.randomized.pattern import Pattern
from synth.render.randomized.surroundings import Randomization, Surroundings

Ends = tuple[float, float]
Colours = tuple[Colour, Colour, Colour]
Keys = dict[str, dict[str, Any]]  # values by section and key

_PATCH_MM = 10.0, 14.0  # radius of an opening in the patch as it is grown, before it is scaled
_CONTRASTS = dict.fromkeys(("spectrum", "fat", "liver", "silicone"), 0.2)
_CONTRASTS |= dict.fromkeys(("cells", "speckle", "dots"), 0.7)  # least of a kind's colours
_NATURAL: dict[str, Colours] = {
    "fat": ((0.6, 0.3, 0.05), (0.8, 0.55, 0.15), (0.9, 0.7, 0.35)),
    "liver": ((0.1, 0.01, 0.01), (0.25, 0.04, 0.03), (0.4, 0.1, 0.07)),
}
_SHEETS: dict[str, tuple[tuple[str, ...], Ends, Ends, float, float]] = {
    # Patterns, sizes as shares of the opening's radius, roughness, refractive index, largest folds and slope.
    "drape": (("weave", "spectrum"), (0.02, 0.1), (0.3, 0.6), 1.1, 0.3),
    "skin": (("spectrum", "cells", "liver"), (0.03, 0.4), (0.2, 0.5), 1.33, 0.15),
    "table": (("streaks", "spectrum"), (0.1, 1.0), (0.1, 0.4), 1.4, 0.0),
    "board": (("dots", "cells", "speckle"), (0.08, 0.6), (0.1, 0.5), 1.4, 0.0),
    "paper": (("lines", "speckle"), (0.1, 0.6), (0.4, 0.6), 1.1, 0.0),
    "metal": (("streaks",), (0.01, 0.3), (0.05, 0.3), 2.8, 0.0),
    "nothing": (("silicone",), (1.0, 1.0), (0.5, 0.5), 1.33, 0.0),
}


class Spread(NamedTuple):
    """Ends that a quantity is drawn between."""

    usual: Ends
    widest: Ends
    scale: Literal["even", "log"] = "even"


RANGES: dict[str, Spread] = {
    # Field; lengths of the anatomy are those of a patch in its usual size.
    "field_mm": Spread((32, 38), (20, 120), "log"),
    "tilt_deg": Spread((0, 20), (0, 40)),
    "dome_mm": Spread((70, 70), (40, 300), "log"),
    "gyrus_mm": Spread((10, 15), (7, 22)),
    "sulcus_mm": Spread((1.6, 2.8), (0.3, 2.8)),
    "working_distance_mm": Spread((280, 320), (150, 500)),
    # Texture.
    "tinted": Spread((0, 0), (0, 1)),
    "pattern_size": Spread((0.04, 0.1), (0.015, 0.35), "log"),  # of an extent
    "pattern_roughness": Spread((0.01, 0.02), (0.01, 0.4)),
    # Light.
    "ring_tilt_deg": Spread((2, 6.5), (2, 12)),
    "lamp_tilt_deg": Spread((2, 6.5), (2, 80)),
    "kelvin": Spread((4200, 5600), (2500, 12000)),
    "window_deg": Spread((0.7, 0.7), (0.1, 12), "log"),
    "even": Spread((0.35, 0.5), (0.2, 1.5)),
    "ambient": Spread((0.05, 0.05), (0, 0.3)),
    "drift": Spread((0, 0.03), (0, 0.3)),
    # Camera.
    "native": Spread((1.0, 1.0), (0.35, 1.0)),
    "halo_px": Spread((1, 1), (0.7, 3)),
    "aperture_mm": Spread((4, 4), (2, 8)),
    "exposure": Spread((0.98, 1.12), (0.7, 1.4), "log"),
    "full_well": Spread((8e3, 2e4), (1.5e3, 3e4), "log"),
    "read_noise": Spread((8, 14), (1, 25)),
    "vignette": Spread((0.15, 0.15), (0, 0.7)),
    "sharpening": Spread((0.15, 0.4), (0, 2.5)),
}
"""Quantities that groups draw: ends at strength 0 and 1, and whether evenly or evenly in the logarithm."""


class _Draws:
    """Draws of one group, by a generator of its own: no other group's depend on it."""

    def __init__(self, job: Job, index: int, group: Group, part: int = 0) -> None:
        self.strength = job.randomize.get(group, 0.0)
        key = (1, index, 64 + get_args(Group).index(group), part)
        self.rng = np.random.default_rng(np.random.SeedSequence(job.seed, spawn_key=key))

    def __call__(self, name: str) -> float:
        """A quantity of `RANGES`."""
        usual, widest, scale = RANGES[name]
        if scale == "even":
            return self.between(usual, widest)
        logs = [(float(np.log(low)), float(np.log(high))) for low, high in (usual, widest)]
        return float(np.exp(self.between(*logs)))

    def between(self, usual: Ends, widest: Ends) -> float:
        """A number from ends between the usual and the widest ones."""
        low, high = (a + self.strength * (b - a) for a, b in zip(usual, widest, strict=True))
        return float(self.rng.uniform(low, high))

    def happens(self, share: float) -> bool:
        """Whether something happens that does in a share of the sequences at full strength."""
        return bool(self.rng.random() < share * self.strength)

    def colour(self) -> Colour:
        """A colour from grey to saturated, from dark to white, linear RGB."""
        brightness, saturation = np.exp(self.rng.uniform(np.log(0.1), np.log(0.85))), self.rng.uniform(0, 0.9)
        hue = self.rng.uniform(0, 1, 3) ** 2
        return _rgb(np.clip(brightness * (1 - saturation + saturation * hue / hue.max()), 0.02, 0.9))

    def colours(self, contrast: float) -> Colours:
        """Three colours of any hue and brightness, at a contrast from 0 (equal) to 1."""
        middle = np.array(self.colour())
        low, between, high = (_rgb(middle + contrast * (self.colour() - middle)) for _ in range(3))
        return low, between, high

    def pattern(self, kind: str, colours: Colours, size: float, relief: float, rough: float) -> Pattern:
        slope, raised, dry = (float(self.rng.uniform(*ends)) for ends in ((0.3, 3.0), (0, relief), (0, 1)))
        return Pattern(kind, colours, size, slope, raised, dry, rough, int(self.rng.integers(2**31)))


def randomize(job: Job, index: int) -> tuple[Job, Randomization | None, Ends]:
    """Draws what the groups of a job randomise in sequence `index`.

    Returns the job with the keys that its groups draw, in place of its own values; what no key expresses,
    None without groups; and the opening's place off the picture's middle, in widths and heights. Drawn again
    from the returned job, all is the same. UserError: a folder of photographs is empty.
    """
    keys: Keys = {"render": {}}
    if (photo := job.appearance.photo) is not None and photo.is_dir():
        pictures = identity.list_pictures(photo)
        number = int(_Draws(job, index, "texture", 1).rng.integers(len(pictures)))
        keys["appearance"] = {"photo": pictures[number]}
    scale, off_centre = 1.0, (0.0, 0.0)
    if job.randomize.get("field"):
        scale, field, off_centre = _draw_field(job, index)
        keys |= field
    sheet = _draw_sheet(job, index)
    if sheet is None and job.randomize.get("surroundings"):
        keys["render"]["scenery"] = get_args(Scenery)
    if job.randomize.get("camera"):
        aperture, keys["sensor"] = _draw_sensor(job, index)
        keys["render"]["aperture_mm"] = aperture
    randomization = _draw_texture(job, index, scale, sheet) if job.randomize else None
    sections = {name: getattr(job, name).model_copy(update=values) for name, values in keys.items() if values}
    return job.model_copy(update=sections), randomization, off_centre


def _draw_texture(job: Job, index: int, scale: float, sheet: Surroundings | None) -> Randomization:
    """Tint and pattern of the tissue, with what is drawn already."""
    draw = _Draws(job, index, "texture")
    randomization = Randomization(scale, None, draw.colour(), draw("tinted"), sheet)
    if not draw.happens(0.5 if job.appearance.photo else 0.85):
        return randomization
    kind = str(draw.rng.choice(list(_CONTRASTS)))
    colours = draw.colours(draw.between((0.2, 0.4), (_CONTRASTS[kind], 1.0)))
    if draw.rng.random() < 0.5:
        colours = _NATURAL.get(kind, colours)
    size = (72.0 if kind == "spectrum" else 24.0) * draw("pattern_size")
    rough = draw("pattern_roughness")
    return replace(randomization, pattern=draw.pattern(kind, colours, size, 0.06 * draw.strength, rough))


def vary(
    view: CameraView, appearance: Appearance, job: Job, index: int, lens: Lens, off_centre: Ends
) -> tuple[CameraView, Appearance]:
    """A view and an appearance with what groups draw: the opening off its centre (`field`) and out of focus
    (`camera`), lamps (`light`) and sensor (`camera`)."""
    draw, (across, down), (x, y) = _Draws(job, index, "camera", 1), job.render.size, off_centre
    # Radius of the circle of confusion: 2 px at most; stronger ones are rarer.
    defocus_px = 2.0 * draw.strength * draw.rng.uniform(-1, 1) ** 3
    share = defocus_px * lens.mm_per_px(view) / max(job.render.aperture_mm, 0.1)
    share = float(np.clip(share, -0.5, 0.5))  # of the plane's distance by which it is out of focus
    focus_mm = view.focus_mm + view.working_distance_mm * share / (1 - share)
    sensor, lighting, draw = appearance.sensor, appearance.light, _Draws(job, index, "camera", 2)
    if draw.strength:
        native = draw("native") if draw.rng.random() < 0.5 else 1.0
        white = _rgb(sensor.white * np.exp(draw.strength * draw.rng.uniform(-0.3, 0.3, 3)))
        sensor = replace(sensor, native=native, halo_px=draw("halo_px"), white=white)
    if job.randomize.get("light"):
        lighting = _draw_light(lighting, job, index)
    varied_view = replace(view, focus_mm=focus_mm, off_centre=(x, y * down / across))
    return varied_view, replace(appearance, sensor=sensor, light=lighting)


def _draw_field(job: Job, index: int) -> tuple[float, Keys, Ends]:
    """Scale of the tissue, keys of field and supports, and the opening's place, in widths and heights.

    The tissue is visible through a hole, from edge to edge, in a corner, or as usual.
    """
    draw, (across, down) = _Draws(job, index, "field"), job.render.size
    width, tilt = draw("field_mm"), draw("tilt_deg")
    layout = str(draw.rng.choice(["hole", "edges", "corner"])) if draw.happens(0.85) else "usual"
    hole, large, offset = (float(draw.rng.uniform(*ends)) for ends in ((0.2, 0.42), (0.3, 0.6), (0.28, 0.36)))
    # From edge to edge the corners are tissue, whatever tilt and perspective.
    edges = 0.75 * float(np.hypot(1, down / across) / np.cos(np.radians(tilt)))
    share = {"usual": 12 / 35, "hole": hole, "edges": edges, "corner": large}[layout]
    x, y = offset * draw.rng.choice([-1.0, 1.0], 2) if layout == "corner" else (0.0, 0.0)
    radius = share * width
    scale, largest = float(radius / draw.rng.uniform(*_PATCH_MM)), min(0.17 * width, 0.42 * radius)
    keys: Keys = {
        "anatomy": {
            "craniotomy": job.anatomy.craniotomy.model_copy(update={"radius_mm": radius}),
            "dome_mm": scale * draw("dome_mm"),
            "gyrus_mm": (scale * draw("gyrus_mm"),) * 2,
            "sulcus_mm": (scale * draw("sulcus_mm"),) * 2,
            "attachments": (_draw_support(draw, radius),) if draw.happens(0.5) else (),
        },
        "fem": {"footprint_mm": (0.5 * largest, largest)},
        "render": {
            "field_mm": (width,) * 2,
            "tilt_deg": (tilt,) * 2,
            "working_distance_mm": (max(draw("working_distance_mm"), 2 * width),) * 2,
        },
    }
    if radius < 8.0 or layout == "corner":  # two instruments rarely fit
        keys["fem"]["instruments"] = (1, 1)
    return scale, keys, (float(x), float(y))


def _draw_support(draw: _Draws, radius: float) -> AttachmentSection:
    """A ball or a sheet that holds the tissue below an opening of a radius, off its contacts."""
    turn, aside, depth = draw.rng.uniform((0, 0, 0.9), (2 * np.pi, 0.7, 1.6)).tolist()
    heading = float(np.cos(turn)), float(np.sin(turn))
    point = (radius * aside * heading[0], radius * aside * heading[1], -radius * depth)
    normal = (*heading, 0.0) if draw.rng.random() < 0.5 else None
    return AttachmentSection(point=point, radius_mm=radius / 2, normal=normal, thickness_mm=radius / 4)


def _draw_sheet(job: Job, index: int) -> Surroundings | None:
    """Surroundings in place of the rim of a craniotomy; None: that rim."""
    draw = _Draws(job, index, "surroundings")
    if not draw.happens(0.85):
        return None
    kind = str(draw.rng.choice(list(_SHEETS)))
    patterns, sizes, roughness, refraction, folds = _SHEETS[kind]
    colours = draw.colours(draw.rng.uniform(0.05, 1))
    if kind == "metal" or draw.rng.random() < 0.3:  # grey, as instruments are
        grey = np.exp(draw.rng.uniform(np.log(0.02), np.log(0.6)))
        colours = (_rgb([0.7 * grey] * 3), _rgb([grey] * 3), _rgb([1.3 * grey] * 3))
    elif kind == "paper":
        colours = ((0.05, 0.05, 0.2), (0.4, 0.4, 0.5), (0.85, 0.85, 0.8))
    size = float(np.exp(draw.rng.uniform(*np.log(sizes))))
    relief, rough = 0.1 if folds else 0.01, float(draw.rng.uniform(*roughness))
    pattern = draw.pattern(str(draw.rng.choice(patterns)), colours, size, relief, rough)
    longer, lip, folded, rise = draw.rng.uniform((1, 0.01, 0, -0.2), (1.2, 0.25, folds, folds)).tolist()
    corners = float(draw.rng.choice([2, 2, 3, 8]))
    return Surroundings(kind, pattern, corners, longer, lip, rise * bool(folds), folded, refraction)


def _draw_light(lighting: Lighting, job: Job, index: int) -> Lighting:
    """One to six lamps, in a ring around the lens or anywhere down to grazing."""
    draw = _Draws(job, index, "light")
    ring, random_count = draw.happens(0.25), draw.happens(1.0)
    count = 6 if ring else int(draw.rng.integers(1, 7)) if random_count else 2
    shares = draw.rng.uniform(0.15, 1, count) ** (not ring)
    ring_tilt_deg, first_turn_deg = draw("ring_tilt_deg"), float(draw.rng.uniform(0, 360))
    lamps = []
    for k, share in enumerate((shares / shares.sum()).tolist()):
        lean, turn = draw("lamp_tilt_deg"), float(draw.rng.uniform(0, 360))
        lean, turn = (ring_tilt_deg, first_turn_deg + 60 * k) if ring else (lean, turn)
        colour = blackbody(draw("kelvin"))
        if draw.happens(0.25):
            colour = colour * draw.rng.uniform(0.3, 1.3, 3)
        lamps.append(FreeLamp(lean, turn, share, _rgb(colour), draw("window_deg")))
    even, ambient = draw("even"), draw("ambient")
    return replace(lighting, lamps=tuple(lamps), even=even, ambient=ambient, drift=draw("drift"))


def _draw_sensor(job: Job, index: int) -> tuple[float, dict[str, Any]]:
    """Radius of the aperture [mm], and keys of sensor, video processor and codec."""
    draw, (width, height) = _Draws(job, index, "camera"), job.render.size
    rng, s = draw.rng, draw.strength
    matrix = np.eye(3) + s * rng.uniform(-0.25, 0.25, (3, 3))
    gamma, gain = np.exp(s * rng.uniform((-0.4, -0.1), (0.3, 0.25)))
    level = encode_srgb(np.array(KNOTS)) ** gamma
    level = gain * (level + s * rng.uniform(-0.3, 0.3) * level * (1 - level) * (2 * level - 1))
    curves = np.clip(level * (1 + s * rng.uniform(-0.06, 0.06, (3, 1))), 0, 1)
    bits = float(np.exp(rng.uniform(np.log(0.05), 0)))  # a pixel
    return draw("aperture_mm"), {
        "exposure": (draw("exposure"),) * 2,
        "full_well": (draw("full_well"),) * 2,
        "read_noise": (draw("read_noise"),) * 2,
        "vignette": draw("vignette"),
        "blur_px": (draw.between((0.4, 1.2), (0, 2.5 * BLUR_WIDTH_PX / width)),) * 2,
        "matrix": _rows(matrix / matrix.sum(axis=1, keepdims=True)),
        "curves": _rows(np.maximum.accumulate(curves, axis=1)),
        "sharpening": (draw("sharpening") * float(rng.uniform(1 - s, 1)),) * 2,
        "chroma": str(rng.choice(["4:4:4", "4:2:2", "4:2:0"])) if draw.happens(1) else "4:4:4",
        "bitrate_mbps": bits * width * height * job.fps * 1e-6 if draw.happens(0.5) else None,
    }


def _rgb(value: Any) -> Colour:
    return float(value[0]), float(value[1]), float(value[2])


def _rows(values: Any) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in values.tolist())
