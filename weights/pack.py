"""Networks of forces packed into the package, each with a card of its figures and limits."""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from evidence import report
from evidence.learn.shipped import list_figures, measure
from learn import checkpoint
from learn.checkpoint import ModelCard
from learn.inference import shipped_networks
from learn.inference.convert import add_onnx
from synth.errors import UserError
from synth.system.checked_file import write_whole

LARGEST_BYTES = 4_000_000  # of a file of a pretrained network
_LIMITS = (
    "Trained on rendered images alone, without recordings of real tissue.",
    "Force is proportional to Young's modulus and has at least its relative error.",
    "A membrane (pia) carries load that is not visible at the surface: errors are largest with a membrane.",
)


def pack(models: Path, data: list[Path], cache: Path | None = None) -> None:
    """Measures the networks of a folder, by name, and writes them into the package.

    `data`: the dataset that they were fitted on, then others; `cache`: folder for packed arrays.
    """
    rows = measure(data, models, cache)["rows"]
    for name in shipped_networks.NAMES:
        figures = list_figures([row for row in rows if row["model"] == name])
        pack_model(models / name, shipped_networks.MODELS / name, report.commit(), figures, _LIMITS)


def pack_model(
    model: Path, folder: Path, commit: str, metrics: Mapping[str, str], limits: Sequence[str]
) -> ModelCard:
    """Writes a pretrained network: weights.safetensors, config.json and a card, README.md.

    `model`: folder of `learn train`; `folder`: `MODELS` and the network's name, replaced if it exists;
    `commit`: of the code that trained it; `metrics`: values with their units; `limits`: a sentence each.
    Raises UserError, and writes nothing, if the model is damaged or larger than `LARGEST_BYTES`.
    """
    net, card = checkpoint.read_model(model)
    shutil.rmtree(folder, ignore_errors=True)
    checkpoint.write_model(folder, card, net.state_dict())
    card = add_onnx(folder)
    line = shipped_networks.describe(card)
    licence = f"{shipped_networks.LICENCE}, as of the code: trained on this project's renders alone"
    rows = {
        "data (hash of its sequences)": shipped_networks.hash_data(card),
        "licence": licence,
        "commit": commit,
    }
    rows |= metrics
    table = "\n".join(f"| {label} | {value} |" for label, value in rows.items())
    bullets = "\n".join(f"- {limit}" for limit in limits)
    head = f"# {folder.name}\n\n{line[:1].upper()}{line[1:]}.\n\n| what | |\n| --- | --- |\n"
    write_whole(folder / "README.md", f"{head}{table}\n\nLimits:\n\n{bullets}\n".encode())
    size = max(file.stat().st_size for file in folder.iterdir())
    if size > LARGEST_BYTES:
        shutil.rmtree(folder)
        raise UserError(
            f"{model}: has a file of {size / 1e6:.1f} MB, at most {LARGEST_BYTES / 1e6:g} may be shipped; "
            "train it with a smaller arch.width"
        )
    return card
