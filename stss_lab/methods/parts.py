# SPDX-License-Identifier: MIT
"""`stss parts`: the gain by each of the paper's parts: trained weights with and without it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from stss.frames.backends import NETWORK, Backend
from stss.frames.display_frame import OnArrays
from stss.quality.compare import Comparison
from stss.run.options import RunOptions
from stss.sequence.reader import Sequence as Frames
from stss.weights.file import LoadedWeights
from stss_ground.errors import InputError
from stss_lab.methods.methods_table import Engines, MethodResult, run_methods
from stss_ref.arrays import Array, Image, Mask
from stss_ref.decoder import decoder
from stss_ref.encoder import encoder
from stss_ref.erm import erm
from stss_ref.frame import FrameInputs, NetworkInputs, prepare_for
from stss_ref.history import history_embedding
from stss_ref.resample import pad_to_8
from stss_ref.weights import Weights

Change = Callable[[NetworkInputs], NetworkInputs]


def _repeat_newest(inputs: NetworkInputs) -> NetworkInputs:
    return replace(inputs, history=np.repeat(inputs.history[-1:], 3, axis=0))


def _trust_all(inputs: NetworkInputs) -> NetworkInputs:
    return replace(inputs, mask=np.ones_like(inputs.mask))


def _repeat_first(inputs: NetworkInputs) -> NetworkInputs:
    return replace(inputs, color=np.tile(inputs.color[..., :3], 2))


def _blank(inputs: NetworkInputs) -> NetworkInputs:
    return replace(inputs, gbuffer=np.zeros_like(inputs.gbuffer))


CHANGES: Mapping[str, Change] = {"history": _repeat_newest, "mask": _trust_all, "gbuffer": _blank, "second": _repeat_first}
"""Part -> the network's inputs without it: history, three copies of the newest frame; mask, 1 everywhere; G-buffer, 0; second colour,
the first."""
ERM = "erm"
"""Its output becomes its mean over the frame, channel by channel."""
PARTS = ("history", "mask", ERM, "gbuffer", "second")
COLUMNS = {"SF": ("SF", "all"), "EF": ("EF", "all"), "EF, holes": ("EF", "holes")}
"""Heading -> kind of frame and region."""


class WithoutPart(OnArrays):
    """`stss_ref` without one of ``PARTS``, or with all (None), as a backend (`stss.frames.backends.Backend`)."""

    name = "ref"

    def __init__(self, weights: Weights, part: str | None):
        self.method = NETWORK if part is None else f"{NETWORK} without {part}"
        self._weights, self._part = weights, part

    def frame(self, inputs: FrameInputs) -> tuple[Image, Mask]:
        """See `stss.frames.backends.Backend`; holes are those of the whole."""
        prepared = prepare_for(self._weights, inputs)
        change = CHANGES.get(self._part or "")
        changed = prepared if change is None else change(prepared)
        image = network(changed, self._weights, mean_erm=self._part == ERM)
        return image, prepared.mask.astype(bool)


def network(inputs: NetworkInputs, weights: Weights, *, mean_erm: bool) -> Image:
    """Stage network (`stss_ref.network.network`); with ``mean_erm`` the ERM's output (H/8, W/8, 64) is the same everywhere."""
    height, width, _ = inputs.color.shape
    planes: list[Array] = [inputs.color, inputs.gbuffer, inputs.mask[..., None], inputs.history]
    color, gbuffer, mask, history = map(pad_to_8, planes)
    x1, x2, x3, x4 = encoder(color, gbuffer, mask[..., 0], weights)
    reshaded = erm(x4, gbuffer, mask[..., 0], weights)
    if mean_erm:
        reshaded = np.broadcast_to(reshaded.mean(axis=(0, 1)), reshaded.shape)
    return decoder(reshaded, history_embedding(history, weights), x1, x2, x3, color, weights)[: 2 * height, : 2 * width]


@dataclass(frozen=True)
class PartsResult:
    """The scores of a set of weights: of the whole network, and without each part."""

    weights: str
    whole: Comparison
    without: Mapping[str, Comparison]


def take_away(
    sequence: Frames,
    truth: Path,
    out: Path,
    weights: Sequence[LoadedWeights],
    parts: Sequence[str],
    options: RunOptions,
    *,
    on_frame: Callable[[str], None] = lambda name: None,
) -> list[PartsResult]:
    """Run each set of weights whole and without each part, into ``out/WEIGHTS/PART``, and compare all with the truth.

    Args:
        sequence: the input.
        truth: folder of the frames that outputs should equal.
        out: folder; made if need be.
        weights: names without folder and ending must differ.
        parts: some of ``PARTS``.
        options: as for ``stss run``.
        on_frame: called with the part when a frame has been made or compared.

    Raises:
        InputError: there is no such part, two weights have one name, or as ``stss run`` and ``stss compare``.
    """
    for part in parts:
        if part not in PARTS or parts.count(part) > 1:
            raise InputError(f"parts: expected some of {', '.join(PARTS)}, each once; got {','.join(parts)}")
    names = [Path(loaded.source).stem for loaded in weights]
    if len({*names}) < len(names):
        raise InputError(f"weights: expected files of different names, got {', '.join(names)}")
    results: list[PartsResult] = []
    for name, loaded in zip(names, weights, strict=True):

        def engine(part: str | None, loaded: LoadedWeights = loaded) -> tuple[Backend, str]:
            return WithoutPart(loaded.weights, part), loaded.label

        engines: Engines = {NETWORK: partial(engine, None), **{part: partial(engine, part) for part in parts}}
        reads = [Path(loaded.source)]
        rows = run_methods(sequence, truth, out / name, engines, options, on_frame=on_frame, reads=reads)
        results.append(_result(name, rows))
    return results


def _result(name: str, rows: Sequence[MethodResult]) -> PartsResult:
    whole, *without = (row.comparison for row in rows)
    return PartsResult(name, whole, dict(zip((row.method for row in rows[1:]), without, strict=True)))


def print_parts(results: Sequence[PartsResult], console: Console) -> None:
    """Print a row for each set of weights, PSNR over RGB, and one for each part, the difference without it."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for heading in ("weights", "without", *COLUMNS):
        table.add_column(heading, justify="left" if heading in ("weights", "without") else "right", no_wrap=True)
    for result in results:
        whole = _psnr(result.whole)
        table.add_row(result.weights, "nothing", *("-" if value is None else f"{value:.2f}" for value in whole))
        for part, comparison in result.without.items():
            pairs = zip(_psnr(comparison), whole, strict=True)
            table.add_row("", part, *("-" if a is None or b is None else f"{a - b:+.2f}" for a, b in pairs))
    console.print(table)
    counts = {mean.name: mean.frames for mean in results[0].whole.means}
    console.print(f"means of {counts.get('SF', 0)} SF and {counts.get('EF', 0)} EF; PSNR over RGB, dB", highlight=False)


def _psnr(comparison: Comparison) -> list[float | None]:
    means = {mean.name: mean.scores for mean in comparison.means}
    return [means[kind][region].psnr_rgb if kind in means else None for kind, region in COLUMNS.values()]


def to_json(results: Sequence[PartsResult]) -> str:
    """As JSON: weights -> ``whole`` and each part -> the object of `Comparison.to_json`."""
    data = {r.weights: {name: json.loads(c.to_json()) for name, c in {"whole": r.whole, **r.without}.items()} for r in results}
    return json.dumps(data, indent=2, allow_nan=False)
