# SPDX-License-Identifier: MIT
"""Mistakes of precision: one layer of the network, or all of them, has fewer bits than the rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from conformance.protocol.port import AnyArray
from conformance.protocol.reference_copy import Mistake, Plant, change_arguments, fault, half, returns
from stss_ref.weights import LAYERS


def of_bits(bits: int) -> Callable[[AnyArray], AnyArray]:
    """Rounds to a significand of ``bits`` bits; the exponent keeps its range."""

    def rounded(x: AnyArray) -> AnyArray:
        significand, exponent = np.frexp(x)
        return np.ldexp(np.round(np.ldexp(significand, bits)), exponent - bits).astype(x.dtype)

    return rounded


FORMATS = {"half precision": half, "bfloat16": of_bits(8), "tf32": of_bits(11)}


def rounded_at(layer: str, what: str, rounded: Callable[[Any], Any]) -> tuple[Plant, ...]:
    """Plants by which one place is rounded.

    Args:
        layer: its name in ``stss_ref.weights.LAYERS``; "": every layer.
        what: ``input``, ``output``, ``weights``; or ``factors``, input and weights, as matrix units round them.
        rounded: rounds it.
    """

    def here(name: str) -> bool:
        return layer in ("", name.removesuffix(".conv_feature").removesuffix(".conv_mask.0"))

    changes = {
        "x": lambda x, name: rounded(x) if here(name) else x,
        "weights": lambda weights, name: (
            weights | {f"{name}.weight": rounded(weights[f"{name}.weight"])} if here(name) else weights
        ),
    }
    if what == "output":
        return tuple(
            returns(each, lambda y, name: rounded(y) if layer in ("", name) else y) for each in ("conv.conv_named", "conv.gated")
        )
    names = {"input": ["x"], "weights": ["weights"], "factors": [*changes]}[what]
    return (change_arguments("conv.conv_named", **{name: changes[name] for name in names}),)


def _precision(stage: str, layer: str, what: str, name: str) -> Mistake:
    where = layer or "every layer"
    word = f"{name.split(maxsplit=1)[0]}_{what}_of_{layer or 'all'}"
    return fault(stage, word, f"{name} at the {what} of {where}", *rounded_at(layer, what, FORMATS[name]))


PLACES = (
    *((what, name) for name in ("half precision", "bfloat16") for what in ("input", "output", "weights")),
    *(("factors", name) for name in ("bfloat16", "tf32")),
)
PRECISION = tuple(_precision(layer.stage, layer.name, what, name) for layer in LAYERS for what, name in PLACES)
"""They explain wrong answers, and are not among the mistakes that the quick tier is tried on one by one."""
EVERYWHERE = tuple(_precision("network", "", what, name) for what, name in PLACES)
