# SPDX-License-Identifier: MIT
"""The reference as a port, and the answer of any Python port to a job folder (spec 11)."""

from __future__ import annotations

import os
import sys
from collections import deque
from pathlib import Path
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
from conformance.protocol.port import Arrays, Outputs
from conformance.protocol.reference_copy import reference_layers
from conformance.protocol.served import END, READY
from conformance.protocol.stages import STAGES, reference
from stss_ground.errors import DeviceError, InputError
from stss_ref.arrays import ArrayError
from stss_ref.weights import Weights

CACHED_WEIGHTS = 16


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


def serve(port: Any, *, dump: bool = False) -> None:
    """Compute the jobs whose folders come line by line on standard input, up to its end: ``PROGRAM --serve``; errors as `answer_job`."""
    weights, lines, answers = WeightsFiles(), sys.stdin.buffer, sys.stdout.buffer
    answers.write(f"{READY}\n".encode())
    answers.flush()
    for line in lines:  # bytes: on Windows text would be of a code page
        path = line.rstrip(b"\r\n")
        answer_job(Path(os.fsdecode(path)), port, dump=dump, weights=weights)
        answers.write(END.encode() + path + b"\n")
        answers.flush()


def answer_job(job: Path, port: Any, *, dump: bool = False, weights: WeightsFiles | None = None) -> None:
    """Compute every case of a job folder.

    Args:
        job: the job folder; outputs, or ``unsupported``, go into its cases.
        port: see `conformance.protocol.port.Port`; it may have ``layers`` too, as `ReferencePort` has.
        dump: write the activations of the network's layers to the folder ``layers`` of each case, and make that folder if need be.
        weights: those of earlier jobs; None: none.

    Raises:
        InputError: the job is malformed or needs more memory than there is, and the message names the file.
    """
    weights = weights or WeightsFiles()
    try:
        # A job may have any numbers: if they overflow, the overflow is the answer, and needs no warning.
        with np.errstate(all="ignore"):
            for case in case_folders(job):
                _run_case(case, port, weights, dump=dump)
    except JobError as error:
        raise InputError(str(error)) from error


def _run_case(case: Path, port: Any, weights: WeightsFiles, *, dump: bool) -> None:
    clear(case)
    stage = read_stage(case)
    if stage not in STAGES or stage not in port.stages():
        write_unsupported(case)
        return
    try:
        inputs = read_inputs(case, stage)
        tensors = weights.read(case) if STAGES[stage].weights else None
        outputs = port.run(stage, inputs, tensors)
        with_layers = dump or (case / LAYERS).exists()
        layers = port.layers(stage, inputs, tensors) if with_layers and tensors is not None else {}
    except (ArrayError, DeviceError) as error:
        raise JobError(f"{case}: {error}") from error
    except MemoryError as error:
        raise JobError(f"{case}: stage {stage} needs more memory than there is") from error
    write_outputs(case, outputs)
    if layers:
        write_outputs(case, layers, LAYERS)


class WeightsFiles:
    """Weights files, each read once: many cases of a job share one, and a backend uploads the same object only once."""

    def __init__(self):
        self._read: deque[tuple[bytes, Weights]] = deque(maxlen=CACHED_WEIGHTS)

    def read(self, case: Path) -> Weights:
        """The weights of a case; JobError if they are damaged."""
        path = case / "in" / WEIGHTS
        data = read_bytes(path, MOST_WEIGHTS_BYTES)
        for content, weights in self._read:  # to compare takes a tenth of the time of a hash
            if content == data:
                return weights
        self._read.append((data, read_weights(data, path)))
        return self._read[-1][1]
