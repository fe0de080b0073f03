"""The CPU backend gives the same bits on any number of threads, twice in a row, called concurrently and after fork."""

from __future__ import annotations

import hashlib
import multiprocessing
import multiprocessing.connection
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from ahoy_core.splat import rasterization
from tests.splat.scenes import Scene, random_scene, run


def busy_scene(seed: int = 0, threads: int | None = 2) -> Scene:
    return random_scene(seed, n=200, width=64, height=57, count=2, rasterize_mode="antialiased", num_threads=threads)


def digest(scene: Scene, gradients: bool = True) -> str:
    """Hash of all bits of the image, the alphas and, if asked for, the gradients."""
    rendered = run(rasterization, scene) if gradients else run(rasterization, scene, ())
    tensors = [rendered.colors, rendered.alphas, *rendered.grads.values()]
    return hashlib.sha256(b"".join(t.contiguous().numpy().tobytes() for t in tensors)).hexdigest()


def test_one_two_and_four_threads_give_the_same_image_bit_for_bit() -> None:
    assert len({digest(busy_scene(threads=n), gradients=False) for n in (1, 2, 3, 4, 7)}) == 1


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_gradients_repeat_bit_for_bit_at_a_fixed_number_of_threads(threads: int) -> None:
    assert len({digest(busy_scene(threads=threads)) for _ in range(5)}) == 1


def test_the_number_of_threads_follows_pytorch() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        assert digest(busy_scene(threads=None)) == digest(busy_scene(threads=3))
    finally:
        torch.set_num_threads(before)


def test_calls_from_several_threads_at_once_do_not_disturb_each_other() -> None:
    scenes = [busy_scene(seed) for seed in range(4)]
    alone = [digest(scene) for scene in scenes]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(digest, scenes * 6))
    assert together == alone * 6


def _send_digest(pipe: multiprocessing.connection.Connection) -> None:
    torch.set_num_threads(1)
    pipe.send(digest(busy_scene()))


def test_a_forked_process_renders_the_same() -> None:
    expected = digest(busy_scene())
    receiver, sender = multiprocessing.Pipe(duplex=False)
    child = multiprocessing.get_context("fork").Process(target=_send_digest, args=(sender,))
    child.start()
    try:
        assert receiver.poll(120), "the forked process hangs"
        assert receiver.recv() == expected
    finally:
        child.kill()
        child.join()
    assert digest(busy_scene()) == expected
