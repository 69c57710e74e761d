"""`python -m learn`: the command without its script."""

from learn.cli import app

app()
