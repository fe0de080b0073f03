"""The coarse avatar: training, the avatar file, and its deformation (paper section 3.1)."""

from ahoy_core.avatar.avatar import Avatar, AvatarInfo, Posed
from ahoy_core.avatar.coarse import CoarseResult, train_coarse
from ahoy_core.avatar.config import CoarseConfig
from ahoy_core.avatar.files import load_avatar, save_avatar
from ahoy_core.avatar.supervision import CoarseInputs

__all__ = [
    "Avatar",
    "AvatarInfo",
    "CoarseConfig",
    "CoarseInputs",
    "CoarseResult",
    "Posed",
    "load_avatar",
    "save_avatar",
    "train_coarse",
]
