"""The libraries of models must not look anything up: weights come from the paths that a user gives."""

from __future__ import annotations

import os


def stay_offline() -> None:
    """Forbid Hugging Face's libraries every request, imported or not, and quiet their progress bars."""
    os.environ["HF_HUB_OFFLINE"] = os.environ["TRANSFORMERS_OFFLINE"] = "1"
    os.environ.setdefault("HF_HUB_DISABLE_PROGRESS_BARS", "1")
    import huggingface_hub.constants

    huggingface_hub.constants.HF_HUB_OFFLINE = True
    from transformers.utils import logging

    logging.disable_progress_bar()
    logging.set_verbosity_error()
