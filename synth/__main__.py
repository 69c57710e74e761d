"""`python -m synth`: the command without its script."""

from synth.cli import app

app()
