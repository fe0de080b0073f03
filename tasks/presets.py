"""Three ways to spend time, picked from what was measured (docs/cost.md, end to end).

What each costs and scores is its row `preset`, which `ahoy run` cites. `draft` is what knobs are changed around.
`standard` takes what paid on both captures: maps of 256, an atlas of 512 and larger canonical views, every frame in the
texture: ST-LPIPS .153 and .163 for draft's .163 and .179, at .02 and .26 dB less. More steps than draft's bought little
in either training, and fewer in the avatar's cost little (its row `avatar.steps=30`). How often landmarks are read and
how long the fit is iterated is draft's too: beyond that whole runs gained with one state of the code and lost with the
next. `high` has sizes for larger pictures than the captures', where they gained nothing when they were last run: .05 dB
less than standard on one of them for 4.6 times the time, ST-LPIPS .152 for .153.
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
            "identity.frames=48",
            "motions.limit=5",
            "avatar.steps=160",
            "animate.height=768",
            "animate.width=576",
        )
    ),
}
