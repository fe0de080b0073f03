"""Three ways to spend time, chosen by hand.

What each costs and scores is its row `preset` of the measured set (docs/cost.md, end to end), which `ahoy run` cites;
where a preset has no row, that is among the omissions, and its knobs rest on the sweeps of single stages alone.
"""

from __future__ import annotations

from collections.abc import Mapping

from tasks.settings import Preset, Settings

STANDARD = Settings()

PRESETS: Mapping[Preset, Settings] = {
    "draft": STANDARD.with_overrides(
        (
            "ingest.max_frames=48",
            "ingest.max_size=384",
            "texture.atlas_size=256",
            "texture.frame_stride=2",
            "texture.canonical_height=256",
            "texture.canonical_width=192",
            "coarse.map_size=128",
            "complete.regions=2",
            "identity.steps=40",
            "motions.limit=2",
            "animate.height=256",
            "animate.width=192",
            "animate.turntable_frames=36",
            "animate.motion_frames=36",
        )
    ),
    "standard": STANDARD,
    "high": STANDARD.with_overrides(
        (
            "ingest.max_size=1024",
            "ingest.max_frames=600",
            "texture.atlas_size=1024",
            "texture.canonical_height=1024",
            "texture.canonical_width=768",
            "coarse.map_size=512",
            "coarse.steps=100",
            "identity.steps=160",
            "identity.frames=48",
            "motions.limit=5",
            "avatar.steps=160",
            "animate.height=768",
            "animate.width=576",
        )
    ),
}
