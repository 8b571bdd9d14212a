# SPDX-License-Identifier: MIT
"""The project's own backends as ports: ``stss port --backend ref|cl JOB`` (spec 11)."""

from __future__ import annotations

import hashlib
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from conformance.protocol.job_folder import (
    LAYERS,
    MOST_WEIGHTS_BYTES,
    WEIGHTS,
    JobError,
    case_folders,
    clear,
    read_bytes,
    read_inputs,
    read_stage,
    read_weights,
    write_outputs,
    write_unsupported,
)
from conformance.protocol.layers import reference_layers
from conformance.protocol.port import Arrays, Outputs
from conformance.protocol.stages import STAGES, reference
from stss_ground.errors import DeviceError, InputError
from stss_ref.arrays import ArrayError
from stss_ref.weights import Weights

CACHED_WEIGHTS = 16
WITH_WEIGHTS = ("stss_cl.network.network", "stss_cl.frame")
"""Modules with the stages that take weights; each has ``STAGES`` and ``run_stage(stage, inputs, weights, device)``."""


class ReferencePort:
    """The reference, ``stss_ref``. It computes in the dtype of the inputs, which is float32 in a job."""

    name = "ref"
    dtype = "float32"

    def stages(self) -> frozenset[str]:
        """All stages."""
        return frozenset(STAGES)

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """See ``conformance.protocol.port.Port``."""
        return reference(stage, inputs, weights)

    def layers(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """Activations of the network's layers in this stage, by name: see ``conformance.protocol.layers``."""
        return {} if weights is None else reference_layers(stage, inputs, weights)


class OpenCLPort:
    """The OpenCL backend, ``stss_cl``, on the device of ``$STSS_DEVICE`` or on the best one.

    Args:
        precision: see ``stss_cl.network.network.PRECISIONS``.
    """

    def __init__(self, precision: str = "float32"):
        self.name = "cl" if precision == "float32" else f"cl-{precision.removeprefix('float32-')}"
        self.dtype = "float16" if precision == "half" else "float32"
        self._precision = precision
        self._image = _module("stss_cl.image_space.stages")
        self._network = [module for name in WITH_WEIGHTS if (module := _module(name)) is not None]
        self._opened: Any = None

    @property
    def winograd(self) -> bool:
        """Whether it uses Winograd convolutions."""
        return (
            self._precision != "float32-direct"
            and import_module("stss_cl.device.tuning").tuning_for(self._device).winograd is not None
        )

    def stages(self) -> frozenset[str]:
        """The stages of images, and those of the network."""
        modules = self._network if self._image is None else [self._image, *self._network]
        return frozenset(stage for module in modules for stage in module.STAGES)

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """See ``conformance.protocol.port.Port``; the first case opens the device, which stays open."""
        device = self._device
        if self._image is not None and stage in self._image.STAGES:
            return self._image.ImageStages(device).run_stage(stage, inputs)
        for module in self._network:
            if stage in module.STAGES:
                return module.run_stage(stage, inputs, weights, device, self._precision)
        raise InputError(f"backend cl: it has no stage {stage}")

    def layers(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """Activations of the network's layers, by name, for stages that are parts of the network; else none."""
        module = import_module(WITH_WEIGHTS[0])
        return module.run_layers(stage, inputs, weights, self._device, self._precision) if stage in module.STAGES else {}

    @property
    def _device(self) -> Any:
        if self._opened is None:
            self._opened = import_module("stss_cl.device.discovery").open_device()
        return self._opened


def cl_direct() -> OpenCLPort:
    """The OpenCL backend without Winograd, for ``stss conform --port stss.port:cl_direct``."""
    return OpenCLPort("float32-direct")


def cl_half() -> OpenCLPort:
    """The OpenCL backend with activations stored as half."""
    return OpenCLPort("half")


def _module(name: str) -> ModuleType | None:
    """Import a module on its first use, since it opens the OpenCL library. None if this version has no such module."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name == name:
            return None
        raise InputError(f"backend cl: {error}") from error
    except ImportError as error:
        raise InputError(f"backend cl: {error}") from error


PORTS = {"ref": ReferencePort, "cl": OpenCLPort}
"""The backends by the names that ``run_job`` takes; each class is also a factory for ``module:factory``."""


def run_job(job: Path, backend: str, *, dump: bool = False) -> None:
    """Compute every case of a job folder.

    Args:
        job: the job folder; outputs, or ``unsupported``, go into its cases.
        backend: a name in ``PORTS``.
        dump: write the activations of the network's layers to the folder ``layers`` of each case, and make that folder if need be.

    Raises:
        InputError: the job is malformed or needs more memory than there is, and the message names the file; or there is no such
            backend or device.
    """
    if backend not in PORTS:
        raise InputError(f"backend: expected one of {', '.join(PORTS)}, got {backend!r}")
    port = PORTS[backend]()
    weights = _WeightsFiles()
    try:
        # A job may have any numbers: if they overflow, that is the answer and needs no warning.
        with np.errstate(all="ignore"):
            for case in case_folders(job):
                _run_case(case, port, weights, dump=dump)
    except JobError as error:
        raise InputError(str(error)) from error


def _run_case(case: Path, port: ReferencePort | OpenCLPort, weights: _WeightsFiles, *, dump: bool) -> None:
    clear(case)
    stage = read_stage(case)
    if stage not in STAGES or stage not in port.stages():
        write_unsupported(case)
        return
    try:
        inputs = read_inputs(case, stage)
        given = weights.read(case) if STAGES[stage].weights else None
        outputs = port.run(stage, inputs, given)
        asked = dump or (case / LAYERS).exists()
        layers = port.layers(stage, inputs, given) if asked and given is not None else {}
    except (ArrayError, DeviceError) as error:
        raise JobError(f"{case}: {error}") from error
    except MemoryError as error:
        raise JobError(f"{case}: stage {stage} needs more memory than there is") from error
    write_outputs(case, outputs)
    if layers:
        write_outputs(case, layers, LAYERS)


class _WeightsFiles:
    """Weights files, each read once: many cases of a job share one, and a backend uploads the same object only once."""

    def __init__(self):
        self._read: dict[str, Weights] = {}

    def read(self, case: Path) -> Weights:
        path = case / "in" / WEIGHTS
        data = read_bytes(path, MOST_WEIGHTS_BYTES)
        digest = hashlib.sha256(data).hexdigest()
        if digest not in self._read:
            if len(self._read) == CACHED_WEIGHTS:
                self._read.pop(next(iter(self._read)))
            self._read[digest] = read_weights(data, path)
        return self._read[digest]
