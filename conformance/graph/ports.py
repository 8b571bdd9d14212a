# SPDX-License-Identifier: MIT
"""Ports of any network: inference engines, a PyTorch module, a Python object, a program with job folders."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import unquote

import numpy as np

from conformance.graph.model import Model
from conformance.graph.rounding import AnyArray
from conformance.options import PortChoice
from conformance.protocol.job_folder import CASE, read_array, write_inputs
from conformance.protocol.load_port import import_port, split_command
from conformance.protocol.port import Case, PortError, foreign_code, own_members
from conformance.protocol.program import Program
from stss_ground.errors import InputError
from stss_ground.optional import require
from stss_ground.terminal import printable

Arrays = Mapping[str, AnyArray]
STAGE = "model"
"""In place of a stage's name in a program's job."""


class GraphPort(Protocol):
    """A port of the network. A Python object needs no import from here.

    Attributes:
        name: in reports.
    """

    name: str

    def run(self, inputs: Arrays) -> dict[str, AnyArray]:
        """Compute; returns the model's outputs, and any other of its tensors, by their names in the model."""
        ...


@dataclass(frozen=True)
class GraphAbilities:
    """Abilities of a port besides `GraphPort`'s members: it has any of these as its own.

    Attributes:
        layers: takes what ``run`` takes, and returns tensors of another run, if returning them changes the computation; ``run`` then
            returns only the outputs.
        restart: forgets its state.
    """

    layers: Callable[[Arrays], dict[str, AnyArray]] | None = None
    restart: Callable[[], None] | None = None


def graph_abilities_of(port: GraphPort) -> GraphAbilities:
    """A port's abilities; InputError if one cannot be read."""
    try:
        with foreign_code():
            return own_members(port, GraphAbilities)
    except PortError as error:
        raise InputError(f"{port.name}: {error}") from error


class OnnxRuntime:
    """ONNX Runtime with one of its providers. Its layers are those of a copy of the model that has all tensors as outputs.

    There it fuses less than in the original model, whose outputs are judged, too.
    """

    def __init__(self, model: Model, provider: str = "CPU"):
        runtime = require("onnxruntime", "onnx")
        full = f"{provider}ExecutionProvider"
        if full not in runtime.get_available_providers():
            raise InputError(f"--port onnxruntime:{provider}: expected one of {_short(runtime.get_available_providers())}")
        self.name = f"onnxruntime {runtime.__version__} {provider}"
        options = runtime.SessionOptions()
        options.log_severity_level = 4

        def session(what: Any) -> Any:
            return runtime.InferenceSession(what, options, providers=[full])

        self._whole, self._open = session(str(model.path)), session(_with_all_outputs(model))

    def run(self, inputs: Arrays) -> dict[str, AnyArray]:
        """See `GraphPort`."""
        return _run_session(self._whole, inputs)

    def layers(self, inputs: Arrays) -> dict[str, AnyArray]:
        """See `GraphAbilities`."""
        return _run_session(self._open, inputs)


def _run_session(session: Any, inputs: Arrays) -> dict[str, AnyArray]:
    names = [each.name for each in session.get_outputs()]
    return dict(zip(names, session.run(names, dict(inputs)), strict=True))


class OpenVino:
    """OpenVINO on the CPU, in the precision that it chooses or in ``f32``, ``bf16`` or ``f16``; its layers as those of ONNX Runtime."""

    def __init__(self, model: Model, precision: str = ""):
        openvino = require("openvino", "bench")
        options = {"INFERENCE_PRECISION_HINT": precision} if precision else {}
        core = openvino.Core()
        if precision not in ("", "f32", "bf16", "f16"):
            raise InputError(f"--port openvino:{precision}: expected f32, bf16 or f16")
        self._whole = core.compile_model(core.read_model(model.path), "CPU", options)
        self._open = core.compile_model(core.read_model(_with_all_outputs(model)), "CPU", options)
        type_name = self._whole.get_property("INFERENCE_PRECISION_HINT").get_type_name()
        self.name = f"openvino {openvino.__version__.partition('-')[0]} {type_name}"

    def run(self, inputs: Arrays) -> dict[str, AnyArray]:
        """See `GraphPort`."""
        return _run_compiled(self._whole, inputs)

    def layers(self, inputs: Arrays) -> dict[str, AnyArray]:
        """See `GraphAbilities`."""
        return _run_compiled(self._open, inputs)


def _run_compiled(model: Any, inputs: Arrays) -> dict[str, AnyArray]:
    return {name: np.array(array) for out, array in model(dict(inputs)).items() for name in out.get_names()}


class PyTorch:
    """A PyTorch module that takes the model's inputs, in order, and gives its outputs."""

    def __init__(self, model: Model, spec: str):
        self._torch = require("torch", "bench")
        self._module: Any = import_port(spec).eval()
        self._model, self.name = model, f"pytorch {spec}"

    def run(self, inputs: Arrays) -> dict[str, AnyArray]:
        """See `GraphPort`."""
        with self._torch.inference_mode():
            results = self._module(*(self._torch.from_numpy(inputs[each.name]) for each in self._model.inputs))
        several = results if isinstance(results, tuple | list) else (results,)  # pyrefly: ignore[implicit-any-type-argument]
        return {name: tensor.numpy() for name, tensor in zip(self._model.outputs, several, strict=True)}


class GraphProgram(Program):
    """A program whose job is one case: ``stage`` is ``model``, and it leaves outputs and any other tensors in ``out``."""

    def run(self, inputs: Arrays) -> dict[str, AnyArray]:
        """See `GraphPort`."""
        case = Case(STAGE, inputs)
        (outputs,) = self.compute([case], lambda job: write_model_case(job, case), lambda folder, _: _read_all(folder / "out"))
        return outputs


def write_model_case(job: Path, case: Case) -> None:
    """Write the inputs of one call into a job's folder."""
    write_inputs(job / CASE, case)


def _read_all(folder: Path) -> dict[str, AnyArray]:
    return {unquote(path.stem): read_array(path) for path in sorted(folder.glob("*.npy"))}


ENGINES: dict[str, Callable[..., GraphPort]] = {"onnxruntime": OnnxRuntime, "openvino": OpenVino, "pytorch": PyTorch}
"""``--port NAME`` or ``NAME:OPTION``."""


def load_graph_port(model: Model, choice: PortChoice) -> GraphPort:
    """Load the port of ``model`` to be judged.

    Raises:
        InputError: not exactly one of ``choice.spec`` and ``choice.program`` is given, or there is no such port.
    """
    spec = choice.spec
    if (spec is None) == (choice.program is None):
        raise InputError("expected either --port or --exec PROGRAM")
    if choice.program is not None:
        return GraphProgram(split_command(choice.program), choice.timeout, keep=False)
    engine, _, option = (spec or "").partition(":")
    try:
        if engine in ENGINES:
            return ENGINES[engine](model, *([option] if option else []))
    except (InputError, PortError):
        raise
    except Exception as error:
        # An engine's errors are of many kinds.
        raise InputError(f"--port {spec}: {printable(f'{type(error).__name__}: {error}'.splitlines()[0][:200])}") from error
    port = import_port(spec or "")
    if lacking := [name for name in ("name", "run") if not hasattr(port, name)]:
        raise InputError(f"--port {spec}: expected a port, got a {type(port).__name__} without {', '.join(lacking)}")
    return port


def _with_all_outputs(model: Model) -> bytes:
    """The model with each of its tensors that can be judged among its outputs."""
    onnx = require("onnx", "onnx")
    proto = onnx.load(model.path)
    there = {each.name for each in proto.graph.output}
    infos = {each.name: each for each in onnx.shape_inference.infer_shapes(proto).graph.value_info}
    for name in model.tensors:
        if name not in there:
            proto.graph.output.append(infos.get(name) or onnx.ValueInfoProto(name=name))
    return proto.SerializeToString()


def _short(providers: list[str]) -> str:
    return ", ".join(name.removesuffix("ExecutionProvider") for name in providers)
