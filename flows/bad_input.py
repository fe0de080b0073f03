"""What a command says of options, files and values that cannot be used: a line each, without a traceback."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape

EXIT_BAD_INPUT = 2


@contextmanager
def bad_input_said(console: Console, *also: type[Exception]) -> Iterator[None]:
    """Turn errors of the block's input, and those named, into lines on the console and the status `EXIT_BAD_INPUT`."""
    unusable: tuple[type[Exception], ...] = (ValueError, OSError, *also)
    try:
        yield
    except ValidationError as error:
        for problem in error.errors():
            _complain(console, f"--{'.'.join(map(str, problem['loc']))}: {problem['msg']}, got {problem['input']!r}")
        raise typer.Exit(EXIT_BAD_INPUT) from None
    except unusable as error:
        _complain(console, str(error))
        raise typer.Exit(EXIT_BAD_INPUT) from None


def _complain(console: Console, message: str) -> None:
    console.print("[red]error:[/]", escape(message), highlight=False, soft_wrap=True)
