# SPDX-License-Identifier: MIT
"""The project's own backends as ports: ``stss port --backend ref|cl JOB`` (spec 11)."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from conformance.protocol.load_port import import_port
from conformance.protocol.port import Arrays, Outputs
from conformance.reference_port import ReferencePort, answer_job, serve
from stss_ground.errors import InputError
from stss_ref.weights import Weights

__all__ = ["OpenCLPort", "ReferencePort", "cl_direct", "cl_half"]

WITH_WEIGHTS = (("stss_cl.network.network", "NetworkStages"), ("stss_cl.frame", "FrameStages"))
"""Modules with the stages that take weights, and their classes that run those of the module's ``STAGES``."""


class OpenCLPort:
    """The OpenCL backend, ``stss_cl``, on the device of ``$STSS_DEVICE`` or on the best one.

    Args:
        precision: see ``stss_cl.options.PRECISIONS``.
    """

    def __init__(self, precision: str = "float32"):
        self.name = "cl" if precision == "float32" else f"cl-{precision.removeprefix('float32-')}"
        self.dtype = {"half": "float16", "bfloat16": "bfloat16"}.get(precision, "float32")
        self._precision = precision
        try:  # imported here, since that opens the OpenCL library
            self._image = import_module("stss_cl.image_space.stages")
            self._network = [(import_module(name), kind) for name, kind in WITH_WEIGHTS]
        except ImportError as error:
            raise InputError(f"backend cl: {error}") from error
        self._opened: Any = None
        self._ready: dict[str, tuple[Weights | None, Any]] = {}

    @property
    def winograd(self) -> bool:
        """Whether it uses Winograd convolutions."""
        return (
            self._precision not in ("float32-direct", "bfloat16")
            and import_module("stss_cl.device.tuning").tuning_for(self._device).winograd is not None
        )

    def stages(self) -> frozenset[str]:
        """The stages of images, and those of the network."""
        modules = [self._image, *(module for module, _ in self._network)]
        return frozenset(stage for module in modules for stage in module.STAGES)

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """See ``conformance.protocol.port.Port``; the first case opens the device, which stays open."""
        if stage in self._image.STAGES:
            return self._image.ImageStages(self._device).run_stage(stage, inputs)
        if (stages := self._stages(stage, weights)) is None:
            raise InputError(f"backend cl: it has no stage {stage}")
        return stages.run_stage(stage, inputs)

    def layers(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """Activations of the network's layers, by name, for stages that are parts of the network; else none."""
        stages = self._stages(stage, weights)
        return stages.layers_of(stage, inputs) if hasattr(stages, "layers_of") else {}

    def _stages(self, stage: str, weights: Weights | None) -> Any:
        """The object that runs a stage with weights; the previous one if the weights are those of the previous case."""
        for module, kind in self._network:
            if stage in module.STAGES:
                if kind not in self._ready or self._ready[kind][0] is not weights:
                    self._ready.pop(kind, None)  # frees its buffers
                    self._ready[kind] = weights, getattr(module, kind)(weights, self._device, self._precision)
                return self._ready[kind][1]
        return None

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


PORTS = {"ref": ReferencePort, "cl": OpenCLPort}
"""The backends by the names that ``run_job`` takes; each class is also a factory for ``module:factory``."""


def run_job(job: Path | None, backend: str, spec: str | None = None, *, dump: bool = False) -> None:
    """Compute every case of a job folder, or serve (None): `answer_job` or `serve` with a backend of ``PORTS``.

    Args:
        job: the folder.
        backend: a name of ``PORTS``.
        spec: a Python port in place of the backend, see `conformance.protocol.load_port.import_port`.
        dump: see `answer_job`.

    Raises:
        InputError: as `answer_job`; or there is no such backend, port or device.
    """
    if backend not in PORTS:
        raise InputError(f"backend: expected one of {', '.join(PORTS)}, got {backend!r}")
    port = PORTS[backend]() if spec is None else import_port(spec)
    if job is None:
        serve(port, dump=dump)
    else:
        answer_job(job, port, dump=dump)
