"""The avatar, coarse (paper section 3.1) and full (3.3): training, file, deformation."""

from ahoy_core.avatar.avatar import Avatar, AvatarInfo, Posed
from ahoy_core.avatar.coarse import CoarseResult, train_coarse
from ahoy_core.avatar.config import CoarseConfig
from ahoy_core.avatar.files import load_avatar, save_avatar
from ahoy_core.avatar.full import FullResult, train_full
from ahoy_core.avatar.full_config import FullConfig
from ahoy_core.avatar.full_inputs import FullInputs
from ahoy_core.avatar.supervision import CoarseInputs

__all__ = [
    "Avatar",
    "AvatarInfo",
    "CoarseConfig",
    "CoarseInputs",
    "CoarseResult",
    "FullConfig",
    "FullInputs",
    "FullResult",
    "Posed",
    "load_avatar",
    "save_avatar",
    "train_coarse",
    "train_full",
]
