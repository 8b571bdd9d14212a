# SPDX-License-Identifier: MIT
"""Methods without a network, in plain NumPy, to compare weights with.

Each has the inputs of stage ``frame``, uses the stages of ``stss_ref`` and follows the same schedule. docs/metrics.md defines them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from stss.frames.accumulation import Accumulation, accumulate_arrays, accumulates
from stss.frames.backends import DEFAULTS, NETWORK, Backend, open_backend
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import WINDOW, OnArrays
from stss.images.resample import lanczos_centres
from stss.weights.file import LoadedWeights
from stss_ground.errors import InputError
from stss_lab.baselines.fxaa import fxaa
from stss_lab.baselines.taau import Taau
from stss_lab.baselines.without_part import CHANGES, WithoutPart
from stss_ref.arrays import Image, Mask
from stss_ref.constants import HoleLimits
from stss_ref.frame import FrameInputs, NetworkInputs, prepare
from stss_ref.resample import upsample_centres

Method = Callable[[FrameInputs, NetworkInputs], Image]
"""From the inputs of stages ``frame`` and ``network`` to (2H, 2W, 3), display-referred."""


def bilinear(_: FrameInputs, prepared: NetworkInputs) -> Image:
    """The image that the network adds its residual to: the newest frame, in an EF warped to the current one, upsampled."""
    return upsample_centres(prepared.color[..., :3])


def lanczos(_: FrameInputs, prepared: NetworkInputs) -> Image:
    """As `bilinear`, with Lanczos's kernel of three lobes."""
    return lanczos_centres(prepared.color[..., :3])


def smooth_edges(inputs: FrameInputs, prepared: NetworkInputs) -> Image:
    """FXAA of `bilinear`."""
    return fxaa(np.clip(bilinear(inputs, prepared), 0, 1))


def repeat(inputs: FrameInputs, _: NetworkInputs) -> Image:
    """An EF repeats the SF before it; an SF is `bilinear`."""
    return upsample_centres(inputs.colors[0])


def extrapolate(_: FrameInputs, prepared: NetworkInputs) -> Image:
    """As `bilinear`, but without the occlusion warp: holes show the pixel that motion leads to, clamped into the frame."""
    return upsample_centres(prepared.color[..., 3:])


METHODS: Mapping[str, Callable[[], Method]] = {
    "repeat": lambda: repeat,
    "extrapolate": lambda: extrapolate,
    "bilinear": lambda: bilinear,
    "lanczos": lambda: lanczos,
    "fxaa": lambda: smooth_edges,
    "taau": Taau,
}
"""Name -> function that makes the method, to be called anew for each sequence."""

ACCUMULATING = frozenset({"taau"})
"""Methods whose outputs depend on all earlier outputs."""


LIMITS = HoleLimits(static_cosine=-np.inf)
"""A surface that turned is no hole here: temporal upsampling would lose 0.2 to 0.5 dB if silhouettes lost their history."""


class MethodBackend(OnArrays):
    """One of ``METHODS`` as a backend."""

    name = "numpy"

    def __init__(self, method: str):
        """Take the method of this name; raises InputError if there is none."""
        if method not in METHODS:
            raise InputError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
        self.method, self.window = method, None if method in ACCUMULATING else WINDOW
        self._make = METHODS[method]()

    def frame(self, inputs: FrameInputs) -> tuple[Image, Mask]:
        """See ``stss.frames.backends.Backend``."""
        prepared = prepare(inputs, limits=LIMITS)
        return self._make(inputs, prepared), prepared.mask.astype(bool)


NO_WEIGHTS = "none"
"""The label of the weights in the files of a method without a network."""


def open_method(
    method: str,
    loaded: LoadedWeights,
    backend: str = "cl",
    options: ComputeOptions = DEFAULTS,
    *,
    tell: Callable[[str], None] = lambda line: None,
) -> tuple[Backend, str]:
    """Open the backend of a method.

    Args:
        method: ``network``, one of `stss_lab.baselines.without_part.CHANGES`, or one of ``METHODS``, for which the other arguments do
            not matter.
        loaded: the network's weights.
        backend, options, tell: see ``stss.frames.backends.open_backend``; a network without a part takes of them whether images are mixed.

    Returns:
        The backend and the label of its weights.

    Raises:
        InputError: there is no such method, or the options do not fit each other.
    """
    if method in CHANGES:
        part = WithoutPart(loaded.weights, method)
        # Mixed where the whole network is: otherwise the gain by mixing would count as the part's.
        return Accumulation(part, accumulate_arrays) if accumulates(loaded, options) else part, loaded.label
    if method != NETWORK:
        return MethodBackend(method), NO_WEIGHTS
    return open_backend(backend, loaded, options, tell=tell), loaded.label
