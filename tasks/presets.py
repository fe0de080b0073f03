"""Three ways to spend time, picked from what was measured (docs/cost.md, end to end).

What each costs and scores is its row `preset`, which `ahoy run` cites. `draft` is what knobs are changed around.
`standard` takes what paid: maps of 256 (perceptual distance .166 for .179), 30 iterations of the fit and every frame in
the texture (either gains on both captures), an atlas of 512; more steps than draft's bought nothing in either training.
Four passes of the landmarks gain on both captures beside draft's knobs, but beside these the self-check of one then
prefers the fill, and its pictures are .3 dB worse. `high` has sizes for larger pictures than the captures', where they
gain nothing: on the one that it was run on .05 dB less than standard for 4.6 times the time, ST-LPIPS .152 for .153.
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
