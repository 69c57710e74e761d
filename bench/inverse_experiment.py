"""What physics alone makes of a noisy displacement: both inverses on random contacts of known force."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from bench import compliance, inverse, machine
from bench.compliance import TO_CAMERA, Compliance, on_dome
from synth import job
from synth.fem import mesh, skin
from synth.fem.system import assemble

Floats = NDArray[np.float64]
_METHODS = {
    "Tikhonov, FEM compliance": inverse.tikhonov,
    "Tikhonov near the contact": inverse.tikhonov_near,
    "one contact, FEM compliance": inverse.one_contact,
}


def experiment(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")] = Path(
        "docs/results/inverse"
    ),
    count: Annotated[int, typer.Option(min=1, help="Random contacts.")] = 60,
    noise: Annotated[
        float, typer.Option(min=0.0, help="Noise of each component of displacement [mm].")
    ] = 0.1,
    young: Annotated[float, typer.Option(min=1e-3, help="Young's modulus [kPa].")] = 3.0,
    tets: Annotated[
        int, typer.Option(help="Of the mesh that makes the data; the inverse has its own.")
    ] = 5000,
    seed: Annotated[int, typer.Option(help="Of contacts and noise; 0 was tuned on.")] = 1,
) -> None:
    """Force of random contacts (20-300 mN, linear tissue) from noisy displacement, by physics alone."""
    known = compliance.build()
    forces, fields = contacts(known, count, young, tets, np.random.default_rng(seed))
    rng = np.random.default_rng([seed, 1])
    spoilt = [field + noise * rng.normal(size=field.shape) for field in fields]
    found: dict[str, Any] = {}
    for name, solve in _METHODS.items():
        began = time.process_time()
        said = young * np.array([solve(known, field, np.ones(len(field))) for field in spoilt])
        spent = time.process_time() - began
        found[name] = errors(forces, said) | {"cpu_ms": 1e3 * spent / count}
    tree = {
        "contacts": count,
        "noise_mm": noise,
        "young_kpa": young,
        "tets_data": tets,
        "seed": seed,
        "machine": machine.describe(),
        "methods": found,
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / "results.json").write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")
    (out / "README.md").write_text(readme(tree), encoding="utf-8")
    print(out / "README.md")


def contacts(
    known: Compliance, count: int, young_kpa: float, tets: int, rng: np.random.Generator
) -> tuple[Floats, list[Floats]]:
    """Random contacts on another mesh than the compliance's.

    20-300 mN within 65 degrees of the normal, pull or push, 3-6 mm in radius, up to 5 mm off the centre.

    Returns:
        (count, 3) forces [mN], camera axes, and count fields (P, 2) of displacement [mm].
    """
    anatomy = job.Anatomy()
    volume = mesh.block(anatomy, tets, 2)
    system = assemble(volume, "linear", 0.4)
    seen = skin.embedding(volume, on_dome(known.points, anatomy.dome_mm))
    steps = np.stack(np.meshgrid(np.linspace(-1, 1, 13), np.linspace(-1, 1, 13)), axis=-1).reshape(-1, 2)
    disc = steps[np.hypot(*steps.T) < 1]
    share = (1 - np.square(disc).sum(axis=1)) ** 2
    forces, fields = np.empty((count, 3)), []
    for k in range(count):
        radius, at, size = rng.uniform(3, 6), rng.uniform(-5, 5, 2), rng.uniform(20, 300)
        up = rng.uniform(np.cos(np.deg2rad(65)), 1)
        around = rng.uniform(0, 2 * np.pi)
        flat = np.sqrt(1 - up**2)
        way = np.array([flat * np.cos(around), flat * np.sin(around), up * rng.choice([-1, 1])])
        held = (
            share
            / share.sum()
            @ skin.embedding(volume, on_dome(at + radius * disc, anatomy.dome_mm)).toarray()
        )
        u = seen @ system.solve(np.outer(held, size * way)) / young_kpa
        forces[k] = TO_CAMERA @ (size * way)
        fields.append((u @ TO_CAMERA.T)[:, :2])
    return forces, fields


def errors(true: Floats, said: Floats) -> dict[str, float]:
    """Mean errors [mN] of the size, across the view and along it; (N, 3) each."""
    size = np.abs(np.linalg.norm(said, axis=1) - np.linalg.norm(true, axis=1))
    return {
        "size_mae_mn": float(size.mean()),
        "size_p90_mn": float(np.quantile(size, 0.9)),
        "across_mae_mn": float(np.linalg.norm((said - true)[:, :2], axis=1).mean()),
        "along_mae_mn": float(np.abs(said - true)[:, 2].mean()),
    }


def readme(tree: dict[str, Any]) -> str:
    """The result as a table."""
    lines = [
        "# Force by physics alone",
        "",
        f"{tree['contacts']} random contacts of 20-300 mN on linear tissue of {tree['young_kpa']:g} kPa,",
        f"seen from above with {tree['noise_mm']:g} mm of noise a component at 441 points; data from",
        f"{tree['tets_data']} tetrahedra, the compliance of the inverses from 3000 of their own.",
        f"At most 20 mN was asked of Tikhonov. Seed {tree['seed']}; the priors were chosen on seed 0.",
        "",
        "    bench experiment inverse",
        "",
        f"Machine: {machine.line(tree['machine'])}; CPU time of one thread.",
        "",
        "| method | size: MAE [mN] | 90% within [mN] | across the view [mN] | along it [mN] | CPU [ms] |",
        "|" + " --- |" * 6,
    ]
    for name, v in tree["methods"].items():
        lines.append(
            f"| {name} | {v['size_mae_mn']:.1f} | {v['size_p90_mn']:.1f} | {v['across_mae_mn']:.1f} | "
            f"{v['along_mae_mn']:.1f} | {v['cpu_ms']:.0f} |"
        )
    return "\n".join(
        [
            *lines,
            "",
            "Plain Tikhonov fails along the view even without noise: its spread loads imitate a load along",
            "the view by patterns across it, and a finer mesh doesn't help (tried: 9000 tetrahedra). Letting",
            "only loads near the best contact be large mends most of that; the single contact can't imitate",
            "at all, once its place and radius move freely (on a grid of places its error was 32 mN).",
            "",
        ]
    )
