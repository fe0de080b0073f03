"""What can be wrong with a file: one class per cause, so that callers can tell them apart."""

from __future__ import annotations


class VideoError(ValueError):
    """A video cannot be used. The text says what was expected, what was found, and what to do."""


class MissingVideoError(VideoError):
    """There is no such file."""


class NotAFileError(VideoError):
    """The path is a folder, a pipe or a device."""


class EmptyFileError(VideoError):
    """The file has no bytes."""


class NotAVideoError(VideoError):
    """The file's content is no known video container."""


class StillImageError(NotAVideoError):
    """The file is a still picture, whatever its name says."""


class RefusedContainerError(VideoError):
    """The container is outside the allow-list, e.g. a playlist that names other files."""


class DamagedVideoError(VideoError):
    """The container is a video's, but its index is missing or no picture in it can be decoded."""


class NoVideoStreamError(VideoError):
    """The file holds sound or subtitles, but no moving picture."""


class NoFramesError(VideoError):
    """The video stream has no frames at all."""


class UnsupportedCodecError(VideoError):
    """No decoder for this codec is built in."""


class OversizedVideoError(VideoError):
    """One picture would have more pixels than we are willing to decode."""


class EmptySelectionError(VideoError):
    """The video is fine, but the chosen time range holds no frame."""


class PlyError(ValueError):
    """A `.ply` file cannot be read as Gaussians."""


class NpzError(ValueError):
    """A `.npz` file cannot be read."""


class ImageError(ValueError):
    """An image file cannot be read or an array cannot be written as an image."""


class BodyFileError(ValueError):
    """A file of a licensed body (SMPL, SMPL+H, SMPL-X) or its texture coordinates cannot be used."""


class BvhError(ValueError):
    """A `.bvh` file cannot be read as a motion."""


class SpzError(ValueError):
    """A `.spz` file cannot be read as Gaussians."""


class GlbError(ValueError):
    """A `.glb` file cannot be read as Gaussians."""


class CameraFileError(ValueError):
    """A camera file of COLMAP or nerfstudio cannot be read."""
