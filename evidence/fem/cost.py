"""What a sequence costs: each kind of gesture, the stages of the physics, the memory of a whole sequence."""

from __future__ import annotations

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from evidence.fem import case
from synth.fem import equilibrium, multi_instrument, solver, surface_embedding, tool
from synth.fem.material import Tissue
from synth.fem.mesh import tetrahedra
from synth.job import schema

Row = dict[str, Any]

_FRAMES = 60
_LAWS = ("linear", "neo-hookean")
_KINDS = ("pull", "grasp", "slide", "tap", "two instruments")


def gestures(on: case.Patch, load: float) -> list[Row]:
    """CPU milliseconds a frame of each kind of gesture on the default mesh, the surface's motion included."""
    rows = []
    for kind in _KINDS:
        fem = _fem(kind, load)
        for law in _LAWS:
            tissue, hands = _drawn(fem, law)
            places = [place for one in hands for place in tool.focus(one)]
            volume = tetrahedra.block(case.ANATOMY, fem.tets, fem.order, places)
            carry, system = (
                surface_embedding.embed(volume, on.vertices),
                tissue.equations(volume),
            )
            courses = [tool.course(one, _FRAMES) for one in hands]
            traction = np.sum(
                [
                    tool.tractions(one, over, on.vertices, on.area)
                    for one, over in zip(hands, courses, strict=True)
                ],
                axis=0,
            )
            loads = np.stack([carry.gather(on.area[:, None] * t) for t in traction])
            start = time.process_time()
            path = equilibrium.solve_path(system, loads, np.full(_FRAMES, load))
            for u in path.displacement:
                carry.move(u)
            spent = 1e3 * (time.process_time() - start) / _FRAMES
            rows.append({"gesture": kind, "law": law, "load": load, "ms_a_frame": spent})
    return rows


def sequence(law: str, load: float) -> Row:
    """A whole sequence in a process of its own: CPU seconds by stage and peak memory.

    60 frames, 40,000 vertices, the default mesh. `fem` is the whole of `solver.deform`; of it, `equilibrium`
    depends on the load, while mesh, embedding and factor would be saved by a cache if a geometry came twice.
    """
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_sequence, law, load).result()


def _sequence(law: str, load: float) -> Row:
    on, fem = case.patch(), _fem("pull", load)
    tissue, (gesture,) = _drawn(fem, law)
    times = [time.process_time()]
    volume = tetrahedra.block(case.ANATOMY, fem.tets, fem.order, tool.focus(gesture))
    times.append(time.process_time())
    solver.deform(fem, tissue, gesture, volume, on.vertices, on.faces, _FRAMES, 25.0)
    times.append(time.process_time())
    memory = _peak_mb()
    carry = surface_embedding.embed(volume, on.vertices)
    times.append(time.process_time())
    system = tissue.equations(volume)
    times.append(time.process_time())
    part = tool.course(gesture, _FRAMES).load
    contact = gesture.contacts[0]
    kernel = tool.footprint(np.asarray(contact.point_mm), gesture.footprint_mm, on.vertices, on.area)
    peak = carry.gather(np.outer(on.area * kernel, contact.force_mn))
    equilibrium.solve_path(system, part[:, None, None] * peak, load * part)
    times.append(time.process_time())
    spent = dict(zip(("mesh", "fem", "embedding", "factor", "equilibrium"), np.diff(times), strict=True))
    return {"law": law, "load": load, "peak_rss_mb": memory} | {f"{k}_s": float(v) for k, v in spent.items()}


def _peak_mb() -> float:
    """Of this process: the kernel's high-water mark (getrusage would count the parent's before exec)."""
    status = Path("/proc/self/status").read_text("utf-8")
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) * 1024 / 1e6


def _fem(kind: str, load: float) -> schema.Fem:
    several = {"gestures": ("pull", "push"), "instruments": 2}
    chosen = several if kind == "two instruments" else {"gestures": (kind,)}
    return schema.Fem.model_validate({"load": load} | chosen)


def _drawn(fem: schema.Fem, law: str) -> tuple[Tissue, tuple[tool.Gesture, ...]]:
    tissue, rng = Tissue(1.0, 0.4, law, averaged=fem.averages_volume), np.random.default_rng(0)
    opening = case.ANATOMY.craniotomy
    first = tool.Gesture.draw(fem, opening, tissue, rng)
    return tissue, (first, *multi_instrument.further(first, fem, opening, tissue, rng))
