"""`python -m weights make FOLDER` trains the networks of motion, `pack` ships those of forces."""

import cv2
import typer

from learn.training.threads import set_threads
from weights import chain
from weights.interval_table import intervals
from weights.pack import pack

app = typer.Typer(no_args_is_help=True, add_completion=False)
app.command()(chain.make)
app.command()(pack)
app.command()(intervals)


@app.callback()
def main() -> None:
    """How the networks of this package are made."""
    set_threads(1)
    cv2.setNumThreads(1)


if __name__ == "__main__":
    app(prog_name="python -m weights")
