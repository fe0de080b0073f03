"""Data sets whose truth is known, read into one form: what a method may see, and what it is scored against."""

from ahoy_core.captures.capture import BodyTruth, Capture, TruePicture, View, drive, true_joints
from ahoy_core.captures.read import KINDS, read_dataset

__all__ = [
    "KINDS",
    "BodyTruth",
    "Capture",
    "TruePicture",
    "View",
    "drive",
    "read_dataset",
    "true_joints",
]
