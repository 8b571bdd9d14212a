# SPDX-License-Identifier: MIT
"""The network without one of its parts, to see what each brings in given weights; nothing is trained."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from stss.frames.display_frame import OnArrays
from stss_ref.arrays import Array, Image, Mask
from stss_ref.decoder import decoder
from stss_ref.encoder import encoder
from stss_ref.erm import erm
from stss_ref.frame import FrameInputs, NetworkInputs, prepare_for
from stss_ref.history import history_embedding
from stss_ref.resample import pad_to_8
from stss_ref.weights import Weights

ERM = "without-erm"
"""The ERM's output becomes its mean over the frame, channel by channel."""
CHANGES: Mapping[str, Callable[[NetworkInputs], NetworkInputs]] = {
    "without-history": lambda inputs: replace(inputs, history=np.repeat(inputs.history[-1:], 3, axis=0)),
    "without-mask": lambda inputs: replace(inputs, mask=np.ones_like(inputs.mask)),
    ERM: lambda inputs: inputs,
    "without-gbuffer": lambda inputs: replace(inputs, gbuffer=np.zeros_like(inputs.gbuffer)),
    "without-second": lambda inputs: replace(inputs, color=np.tile(inputs.color[..., :3], 2)),
}
"""Method -> the network's inputs without the part: the newest frame thrice; trust everywhere; no G-buffer; the first colour twice."""


class WithoutPart(OnArrays):
    """`stss_ref` without a part: one of ``CHANGES``, as a backend (`stss.frames.backends.Backend`)."""

    name = "ref"

    def __init__(self, weights: Weights, method: str):
        self.method, self._weights = method, weights

    def frame(self, inputs: FrameInputs) -> tuple[Image, Mask]:
        """See `stss.frames.backends.Backend`; the holes are those of the whole."""
        prepared = prepare_for(self._weights, inputs)
        image = network(CHANGES[self.method](prepared), self._weights, mean_erm=self.method == ERM)
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
