"""Role "body" by a file of the SMPL family: the loader itself is `ahoy_core.body`."""

from __future__ import annotations

from ahoy_core.body.load import load_body
from ahoy_core.body.model import BodyModel
from ahoy_core.formats.errors import BodyFileError
from ahoy_core.models.adapter import Adapter, Fill
from ahoy_core.models.errors import CheckpointError


def load_body_file(fill: Fill, adapter: Adapter) -> BodyModel:
    """Read a body.

    Args:
        fill: `path` is the `.npz`.
        adapter: its declaration.

    Raises:
        CheckpointError: the file cannot be used; the text names what it lacks.
    """
    try:
        return load_body(str(fill.path))
    except BodyFileError as error:
        raise CheckpointError(f"{adapter.label}: {error}; {adapter.how_to_get()}") from error
