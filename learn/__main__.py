"""`python -m learn`."""

from learn.cli import app

app()
