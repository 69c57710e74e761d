"""`python -m bench`: the command without its script."""

from bench.cli import app

app()
