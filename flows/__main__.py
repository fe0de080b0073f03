"""`python -m flows` is `ahoy`."""

from flows.cli import app

app()
