"""What can go wrong with the server, said so that the user knows what to do."""

from __future__ import annotations


class ServerError(Exception):
    """The server cannot be started or reached; the message says what to do."""


class NoServerError(ServerError):
    """No Prefect server answers."""
