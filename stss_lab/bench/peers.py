# SPDX-License-Identifier: MIT
"""Peers: the network by other engines, as contenders in the benchmark."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from stss_ground.errors import InputError
from stss_ground.machine import versions
from stss_ground.optional import require
from stss_lab.bench import onnx_export
from stss_lab.bench.contender import Peer, Setup
from stss_lab.bench.torch_network import TorchNetwork
from stss_ref.arrays import Array


class PyTorch(Peer):
    """PyTorch, in the memory format channels_last: it is twice as fast as the default on CPUs, and tensor cores need it.

    Args:
        setup: weights, size and threads.
        cuda: run on the first CUDA GPU; else on the CPU.
        half: compute in half precision; else in float32.
        tf32: in float32 the tensor cores may round to TF32, which is PyTorch's default for convolutions.
        compiled: use ``torch.compile``; on a GPU with CUDA graphs but without its search, which did not end within two minutes on an H200.
    """

    def __init__(
        self,
        setup: Setup,
        *,
        cuda: bool = False,
        half: bool = False,
        tf32: bool = False,
        compiled: bool = False,
    ):
        super().__init__(setup)
        self._torch = torch = require("torch")
        if cuda and not torch.cuda.is_available():
            raise InputError("PyTorch finds no CUDA GPU")
        torch.set_num_threads(setup.threads)
        self._options: dict[str, Any] = {"device": "cuda" if cuda else "cpu", "dtype": torch.float16 if half else torch.float32}
        self._cuda = cuda
        torch.backends.cudnn.benchmark = cuda  # the fastest of its convolutions, by a trial of each
        torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = tf32
        network = TorchNetwork(setup.weights, **self._options)
        mode = "reduce-overhead" if cuda else "max-autotune"
        self._network: Any = torch.compile(network.__call__, mode=mode) if compiled else network
        self.details = {
            **versions(("torch",)),
            "precision": "float16" if half else "TF32" if tf32 else "float32",
            "layout": "channels_last",
            "formulation": "gates merged, window as slices",
        }
        if cuda:
            self.details["gpu"] = str(torch.cuda.get_device_name())
        else:
            self.details["threads"] = str(torch.get_num_threads())

    def _bind(self, inputs: dict[str, Array]) -> None:
        arrays = map(self._torch.from_numpy, inputs.values())
        self._inputs = [array.to(memory_format=self._torch.channels_last, **self._options) for array in arrays]

    def run(self) -> None:
        """See `Contender`."""
        with self._torch.inference_mode():
            self._image = self._network(*self._inputs)
        if self._cuda:
            self._torch.cuda.synchronize()

    def _result(self) -> Array:
        return self._image.float().cpu().numpy()


class OnnxRuntime(Peer):
    """ONNX Runtime; inputs and output stay on the device that computes.

    Args:
        setup: weights, size and threads.
        provider: runs the graph: ``CPU``, or ``CUDA`` or ``Tensorrt`` on the first CUDA GPU.
    """

    def __init__(self, setup: Setup, *, provider: str = "CPU"):
        super().__init__(setup)
        runtime, full = require("onnxruntime"), f"{provider}ExecutionProvider"
        if full not in runtime.get_available_providers():
            raise InputError(f"ONNX Runtime has no {full}")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = setup.threads
        # Otherwise its threads spin on after a run, and slow the next contender.
        options.add_session_config_entry("session.force_spinning_stop", "1")
        self._session = runtime.InferenceSession(_model(setup), options, providers=[full])
        place = () if provider == "CPU" else ("cuda", 0)
        self._value: Callable[[Array], Any] = lambda array: runtime.OrtValue.ortvalue_from_numpy(array, *place)
        self.details = {
            **versions(("onnxruntime", "onnxruntime-gpu", "tensorrt")),
            "provider": provider,
            "precision": "float32",
            "formulation": "gates merged, window as slices",
            **({"threads": str(setup.threads)} if provider == "CPU" else {}),
        }

    def _bind(self, inputs: dict[str, Array]) -> None:
        _, _, height, width = inputs["color"].shape
        self._image = self._value(np.empty((1, 3, 2 * height, 2 * width), np.float32))
        self._binding = self._session.io_binding()
        for name, array in inputs.items():
            self._binding.bind_ortvalue_input(name, self._value(array))
        self._binding.bind_ortvalue_output("image", self._image)

    def run(self) -> None:
        """See `Contender`."""
        self._session.run_with_iobinding(self._binding)

    def _result(self) -> Array:
        return self._image.numpy()


class OpenVino(Peer):
    """OpenVINO on the CPU, set for the shortest time of one frame.

    Args:
        setup: weights, size and threads.
        float32: compute in float32; else in the precision that OpenVINO chooses, bfloat16 if the CPU has it.
    """

    def __init__(self, setup: Setup, *, float32: bool):
        super().__init__(setup)
        self._openvino = openvino = require("openvino")
        options = {"PERFORMANCE_HINT": "LATENCY", "INFERENCE_NUM_THREADS": setup.threads}
        if float32:
            options["INFERENCE_PRECISION_HINT"] = "f32"
        core = openvino.Core()
        compiled = core.compile_model(core.read_model(_model(setup)), "CPU", options)
        self._request = compiled.create_infer_request()
        precision = compiled.get_property("INFERENCE_PRECISION_HINT").get_type_name()
        self.details = {
            **versions(("openvino",)),
            "precision": precision,
            "formulation": "gates merged, window as slices",
            "threads": str(compiled.get_property("INFERENCE_NUM_THREADS")),
        }

    def _bind(self, inputs: dict[str, Array]) -> None:
        self._inputs = inputs  # the engine uses these arrays in place and does not own them, so we must
        for name, array in inputs.items():
            self._request.set_tensor(name, self._openvino.Tensor(array, shared_memory=True))

    def run(self) -> None:
        """See `Contender`."""
        self._request.infer(share_outputs=True)

    def _result(self) -> Array:
        return self._request.get_tensor("image").data


class Mnn(Peer):
    """MNN on the CPU.

    Args:
        setup: weights, size and threads.
        precision: ``high``, float32; ``normal`` and ``low`` are MNN's to choose.
    """

    def __init__(self, setup: Setup, *, precision: str = "high"):
        super().__init__(setup)
        self._mnn = mnn = require("MNN", "mnn")
        # Not MNN.tools.mnnconvert: importing that runs pip, for a package that reports its use.
        converter = require("_tools", "mnn")
        with TemporaryDirectory() as folder:
            graph, converted = Path(folder) / "network.onnx", Path(folder) / "network.mnn"
            graph.write_bytes(_model(setup))
            words = {"-f": "ONNX", "--modelFile": graph, "--MNNModel": converted, "--bizCode": "stss"}
            converter.mnnconvert(["mnnconvert", *(str(word) for pair in words.items() for word in pair)])
            if not converted.exists():
                raise InputError("MNN: cannot convert the network")
            self._interpreter = mnn.Interpreter(str(converted))
        self._session = self._interpreter.createSession({"backend": "CPU", "numThread": setup.threads, "precision": precision})
        self.details = {
            **versions(("mnn",)),
            "precision": precision,
            "formulation": "gates merged, window as slices",
            "threads": str(setup.threads),
        }

    def _tensor(self, array: Array) -> Any:
        return self._mnn.Tensor(array.shape, self._mnn.Halide_Type_Float, array, self._mnn.Tensor_DimensionType_Caffe)

    def _bind(self, inputs: dict[str, Array]) -> None:
        self._inputs = inputs

    def run(self) -> None:
        """See `Contender`; inputs are copied each time, since a run overwrites them."""
        for name, array in self._inputs.items():
            self._interpreter.getSessionInput(self._session, name).copyFrom(self._tensor(array))
        self._interpreter.runSession(self._session)

    def _result(self) -> Array:
        image = self._interpreter.getSessionOutput(self._session, "image")
        array = np.zeros(image.getShape(), np.float32)
        tensor = self._tensor(array)  # may lie in the array's memory, or in its own
        image.copyToHostTensor(tensor)
        return np.array(tensor.getNumpyData(), np.float32).reshape(array.shape)


class ExecuTorch(Peer):
    """ExecuTorch on the CPU, in float32: XNNPACK, and portable kernels where it has no operator.

    Args:
        setup: weights, size and threads.
    """

    def __init__(self, setup: Setup):
        super().__init__(setup)
        self._torch = torch = require("torch")
        network = TorchNetwork(setup.weights, memory_format=torch.contiguous_format)  # XNNPACK's passes refuse channels_last

        class Module(torch.nn.Module):
            def forward(self, color: Any, gbuffer: Any, mask: Any, history: Any) -> Any:
                return network(color, gbuffer, mask, history)

        height, width = (-(-length // 8) * 8 for length in (setup.height, setup.width))
        inputs = tuple(torch.zeros(n, c, height, width) for n, c in ((1, 6), (1, 9), (1, 1), (3, 4)))
        lower = require("executorch.exir").to_edge_transform_and_lower
        xnnpack = require("executorch.backends.xnnpack.partition.xnnpack_partitioner").XnnpackPartitioner()
        with torch.no_grad():
            program = lower(torch.export.export(Module(), inputs), partitioner=[xnnpack]).to_executorch()
        require("executorch.extension.pybindings.portable_lib")._unsafe_reset_threadpool(setup.threads)  # noqa: SLF001
        self._program = require("executorch.runtime").Runtime.get().load_program(program.buffer)
        self._method = self._program.load_method("forward")
        self.details = {
            **versions(("executorch", "torch")),
            "precision": "float32",
            "formulation": "gates merged, window as slices",
            "threads": str(setup.threads),
        }

    def _bind(self, inputs: dict[str, Array]) -> None:
        self._inputs = [self._torch.from_numpy(array) for array in inputs.values()]

    def run(self) -> None:
        """See `Contender`."""
        (self._image,) = self._method.execute(self._inputs)

    def _result(self) -> Array:
        return self._image.numpy()


def _model(setup: Setup) -> bytes:
    return onnx_export.export(setup.weights, -(-setup.height // 8) * 8, -(-setup.width // 8) * 8).SerializeToString()


PEERS: dict[str, Callable[[Setup], Peer]] = {
    "pytorch": PyTorch,
    "pytorch-compiled": partial(PyTorch, compiled=True),
    "onnxruntime": OnnxRuntime,
    "openvino": partial(OpenVino, float32=True),
    "openvino-default": partial(OpenVino, float32=False),
    "mnn": Mnn,
    "executorch": ExecuTorch,
    "pytorch-cuda": partial(PyTorch, cuda=True, half=True),
    "pytorch-cuda-compiled": partial(PyTorch, cuda=True, half=True, compiled=True),
    "pytorch-cuda-float32": partial(PyTorch, cuda=True),
    "pytorch-cuda-float32-compiled": partial(PyTorch, cuda=True, compiled=True),
    "pytorch-cuda-tf32": partial(PyTorch, cuda=True, tf32=True),
    "pytorch-cuda-tf32-compiled": partial(PyTorch, cuda=True, tf32=True, compiled=True),
    "onnxruntime-cuda": partial(OnnxRuntime, provider="CUDA"),
    "onnxruntime-tensorrt": partial(OnnxRuntime, provider="Tensorrt"),
}
"""All peers, by the name that ``--peers`` takes."""
