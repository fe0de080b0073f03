"""Lags of loose parts against the closed form of the damped oscillator, and what they may and may not do."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from ahoy_core.scene.effects.secondary_motion import DAMPING, FREQUENCY, lags_of, looseness, swing_of
from ahoy_core.scene.puppet import Puppet
from tests.scene.things import moved, puppet

OMEGA = 2 * math.pi * FREQUENCY


def path(x: np.ndarray) -> torch.Tensor:
    places = torch.zeros(len(x), 1, 3)
    places[:, 0, 0] = torch.from_numpy(x)
    return places


def skirted(who: Puppet, distance: float = 0.1) -> Puppet:
    """The same with everything at hip height pushed outwards, like a skirt."""
    avatar = who.avatar
    template = avatar.template
    hips = (template.means[:, 2] > 0.6) & (template.means[:, 2] < 0.95)
    out = distance * template.rotations[:, :, 2] * hips[:, None]
    return replace(who, avatar=replace(avatar, means=template.means + out))


def shaken(who: Puppet, metres: float = 0.1) -> Puppet:
    """The same, moved from side to side once in half a second."""
    t = torch.arange(len(who.motion)) / who.motion.fps
    way = torch.stack([metres * torch.sin(4 * torch.pi * t), 0 * t, 0 * t], 1)
    return moved(who, lambda transl: transl + way)


def test_after_a_stop_it_swings_as_the_closed_form_says():
    fps, stop = 60.0, 30
    found = lags_of(path(np.minimum(np.arange(120), stop) / fps), fps)[:, 0, 0].numpy()
    damped = OMEGA * math.sqrt(1 - DAMPING**2)
    t = (np.arange(120) - stop) / fps
    # From 1 m/s to rest: the lag starts at 0 with 1 m/s.
    truth = np.where(t > 0, np.exp(-DAMPING * OMEGA * t) * np.sin(damped * t) / damped, 0.0)
    assert np.abs(found - truth).max() < 1e-5 * np.abs(truth).max() + 1e-6


@pytest.mark.parametrize("frequency", [0.5, 2.2, 6.0])
def test_shaken_it_answers_with_the_amplitude_of_a_driven_oscillator(frequency: float):
    fps, drive = 240.0, 2 * math.pi * frequency
    t = np.arange(int(6 * fps)) / fps
    found = lags_of(path(np.sin(drive * t)), fps)[int(4 * fps) :, 0, 0]
    ratio = drive / OMEGA
    gain = ratio**2 / math.hypot(1 - ratio**2, 2 * DAMPING * ratio)
    assert float(found.abs().max()) == pytest.approx(gain, rel=0.03)


def test_even_motion_lags_nothing_and_one_frame_is_still():
    assert float(lags_of(path(0.3 * np.arange(50.0)), 24.0).abs().max()) < 5e-6  # paths are float32
    assert lags_of(torch.zeros(1, 4, 3), 24.0).shape == (1, 4, 3)


def test_only_what_stands_off_the_body_is_loose_and_it_never_swings_into_the_body():
    tight = puppet("walk", frames=24, fps=24.0)
    assert swing_of(replace(tight, avatar=replace(tight.avatar, means=tight.avatar.template.means))) is None
    who = skirted(tight)
    loose = looseness(who)
    swing = swing_of(who)
    assert swing is not None and torch.equal(torch.nonzero(loose > 0)[:, 0], swing.rows)
    assert 0.005 < float(swing.lags.norm(dim=2).max()) <= 0.05 + 1e-6
    means = who.points.posed(who.relative(who.motion.pose[:1], who.motion.transl[:1])[0])[0]
    moved = swing.moved(means, 12, 0.5)
    assert torch.equal(moved[loose == 0], means[loose == 0])
    assert float((moved - means).norm(dim=1).max()) > 1e-3


def test_a_jump_in_the_recording_stays_bounded():
    who = skirted(puppet("walk", frames=12, fps=24.0))
    torn = replace(who.motion, transl=who.motion.transl + torch.tensor([100.0, 0, 0]) * (torch.arange(12) > 5)[:, None])
    swing = swing_of(replace(who, motion=torn))
    assert swing is not None and torch.isfinite(swing.lags).all() and float(swing.lags.norm(dim=2).max()) <= 0.05 + 1e-6
