"""What can be wrong with a model that a user gives. Every text says what was expected, what was found, what to do."""

from __future__ import annotations


class ModelError(ValueError):
    """A model cannot fill its role."""


class CheckpointError(ModelError):
    """A file or folder is not the checkpoint that was expected: missing, truncated, or another model's."""


class MissingPackageError(ModelError):
    """An optional package is not installed; the text names the extra."""


class UntrustedCodeError(ModelError):
    """A TorchScript file is a program; it is run only where its owner says so."""


class CommandError(ModelError):
    """An external command failed, took too long, or did not leave what it should."""
