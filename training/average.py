# SPDX-License-Identifier: MIT
"""Average the weights of runs that continued one another: the mean is better than each (Wortsman et al. 2022, Model soups)."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from stss.weights.file import ALIASED, MADE_FOR, load, save
from stss_cl.liveness import drop_tiny
from stss_ground.errors import InputError
from stss_ground.output.places import require_places
from training.command import command


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.average``."""
    parser = argparse.ArgumentParser(prog="python -m training.average", description=__doc__)
    parser.add_argument("weights", nargs="+", help="safetensors files")
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    require_places({"--out": options.out}, map(Path, options.weights))
    loaded = [load(name) for name in options.weights]
    for what, choices in (
        ("second colour", {each.weights.second_color for each in loaded}),
        ("hole test", {each.weights.hole_test for each in loaded}),
        ("hole fill", {each.weights.hole_fill for each in loaded}),
    ):
        if len(choices) > 1:
            raise InputError(f"weights: expected one {what}, found {' and '.join(sorted(choices))}")
    tensors = {
        name: np.asarray(np.mean([each.weights[name] for each in loaded], axis=0, dtype=np.float64), np.float32)
        for name in loaded[0].weights
    }
    save(
        options.out,
        drop_tiny(loaded[0].weights | tensors),
        {
            "average_of": json.dumps([_unfold(dict(each.metadata)) for each in loaded]),
            **({MADE_FOR: ALIASED} if all(each.made_for_aliased for each in loaded) else {}),
        },
    )


def _unfold(value: Any) -> Any:
    """JSON within text becomes its value: the escapes of a mean of means would double each time."""
    if isinstance(value, str) and value[:1] in ("[", "{"):
        return _unfold(json.loads(value))
    if isinstance(value, dict):
        return {key: _unfold(each) for key, each in cast(dict[str, Any], value).items()}
    return [_unfold(each) for each in cast(list[Any], value)] if isinstance(value, list) else value


if __name__ == "__main__":
    command(main)
