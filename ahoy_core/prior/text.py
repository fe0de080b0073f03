"""The prior's own words: a tokenizer of a few hundred tokens and a small text encoder, in transformers' format."""

from __future__ import annotations

import string
from functools import lru_cache
from typing import Any, Final

import torch
from torch import Tensor

from ahoy_core.prior.corpus.prompts import COLOURS, NEUTRAL, WEARABLES

IDENTITY_TOKEN: Final = "<v>"
"""[v] of the paper: the learned word for the subject; reserved in the vocabulary, trained per video."""
LIKE: Final = "person"
"""The word that the identity token starts as: one that no caption had would say something at random."""
IDENTITY_PROMPT: Final = f"a {IDENTITY_TOKEN} person"
MAX_TOKENS: Final = 24
"""Longer prompts are cut here: the corpus' longest caption has 19."""
TEXT_WIDTH: Final = 64
_ONE_BEFORE: Final = 1  # T5's bucket of the distance to the word before

_WORDS = (
    "man", "woman", "wearing", "in", "with", "and", "of", "the", "from", "front", "back", "left", "right",
    "side", "view", "standing", "sitting", "turning", "walking", "arms", "raised", "shirt", "jacket", "jeans",
    "skirt", "shorts", "dress", "sleeves", "short", "long", "stripes", "plain", "print", "dark", "light",
    "video", "photo",
)  # fmt: skip


def build_tokenizer() -> Any:
    """A unigram tokenizer: the words of captions, some neighbours, and single letters for everything else."""
    from transformers import T5TokenizerFast

    words = dict.fromkeys([*NEUTRAL.split(), *COLOURS, *WEARABLES.values(), *_WORDS])
    pieces = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0), ("▁", -2.0)]
    pieces += [(f"▁{word}", -3.0) for word in words if word != "a"]
    pieces += [("▁a", -3.0), (",", -3.0)]
    pieces += [(letter, -8.0) for letter in string.ascii_lowercase + string.digits + ".-'"]
    tokenizer = T5TokenizerFast(vocab=pieces, extra_ids=0)
    tokenizer.add_tokens([IDENTITY_TOKEN], special_tokens=True)
    return tokenizer


def build_text_encoder(vocabulary: int) -> Any:
    """An untrained encoder of `TEXT_WIDTH` for a vocabulary of some size."""
    from transformers import UMT5Config, UMT5EncoderModel

    config = UMT5Config(
        vocab_size=vocabulary, d_model=TEXT_WIDTH, d_kv=16, d_ff=128, num_layers=2, num_heads=4, dropout_rate=0.0
    )
    encoder = UMT5EncoderModel(config)
    _start_with_colours(encoder)
    return encoder


@torch.no_grad()
def _start_with_colours(encoder: Any) -> None:
    """Words of colours start as their colours, and one head of the first layer tells each word the one before it.

    "Red top" is then a top that is red from the first step on. From random tables the way from a colour's word to a
    garment's pixels is so long that training closes it before it carries anything.
    """
    tokenizer, attention = build_tokenizer(), encoder.encoder.block[0].layer[0].SelfAttention
    for table in (encoder.shared.weight, embedding_weight(encoder)):
        for name, rgb in COLOURS.items():
            number = tokenizer.convert_tokens_to_ids(f"▁{name}")
            if number < len(table):
                table[number, :3] = 4 * (torch.tensor(rgb) - 0.5)
    width = attention.key_value_proj_dim
    attention.relative_attention_bias.weight[:, 0] = 0
    attention.relative_attention_bias.weight[_ONE_BEFORE, 0] = 8
    attention.q.weight[:width] = 0
    attention.k.weight[:width] = 0
    attention.v.weight[:width] = torch.eye(width, TEXT_WIDTH)
    attention.o.weight[:, :width] = 0
    attention.o.weight[width : 2 * width, :width] = 1.5 * torch.eye(width)


def token_ids(tokenizer: Any, prompts: list[str], max_tokens: int = MAX_TOKENS) -> tuple[Tensor, Tensor]:
    """Ids and mask [B,max_tokens] of prompts of any length, the empty one included."""
    encoded = tokenizer(
        prompts, padding="max_length", truncation=True, max_length=max_tokens, return_tensors="pt"
    )  # fmt: skip
    return encoded.input_ids, encoded.attention_mask


def embed_ids(text_encoder: Any, ids: Tensor, mask: Tensor) -> Tensor:
    """Text embeddings [B,S,D], zero where there is padding (as Wan's pipeline does it)."""
    return text_encoder(ids, mask).last_hidden_state * mask[..., None]


@lru_cache(maxsize=1)
def identity_token_id(tokenizer: Any) -> int:
    """The id of `IDENTITY_TOKEN`.

    Raises:
        ValueError: when the tokenizer lacks it.
    """
    found = tokenizer.convert_tokens_to_ids(IDENTITY_TOKEN)
    if found is None or found == tokenizer.unk_token_id:
        raise ValueError(f"expected a tokenizer with {IDENTITY_TOKEN}, got none; add it with tokenizer.add_tokens")
    return int(found)


def embedding_weight(text_encoder: Any) -> torch.nn.Parameter:
    """The table that the encoder looks words up in (`get_input_embeddings()` is another copy without gradient)."""
    return text_encoder.encoder.embed_tokens.weight


def likeness_word(tokenizer: Any, text_encoder: Any) -> Tensor:
    """The embedding [D] of `LIKE`."""
    return embedding_weight(text_encoder)[tokenizer(LIKE, add_special_tokens=False).input_ids].detach().mean(0)


def add_identity_token(tokenizer: Any, text_encoder: Any) -> None:
    """Give a published tokenizer the learned word of equation 2; it starts as the word `LIKE`.

    Wan's table of embeddings has more rows than its tokenizer has words; it grows only where it has not.
    """
    if IDENTITY_TOKEN in tokenizer.get_vocab():
        return
    like = likeness_word(tokenizer, text_encoder)
    tokenizer.add_tokens([IDENTITY_TOKEN], special_tokens=True)
    if len(tokenizer) > len(embedding_weight(text_encoder)):
        text_encoder.resize_token_embeddings(len(tokenizer), mean_resizing=False)
    table = embedding_weight(text_encoder)
    with torch.no_grad():
        table[tokenizer.convert_tokens_to_ids(IDENTITY_TOKEN)] = like
    text_encoder.requires_grad_(False)
