# SPDX-License-Identifier: MIT
"""Write and read the state of a training run as one safetensors file; reading it executes nothing."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from stss_ground.errors import InputError
from training.network import Network

ENTRY = "stss_training"


@dataclass
class State:
    """The state from which training continues as if it had never stopped.

    Attributes:
        step: number of steps done.
        network: the network, trained in place.
        heads: `training.network.Heads`.
        average: running mean of its tensors, by name.
        optimisers: Muon and Adam, each with its parameters.
        best: highest validation PSNR so far (mean of SF and EF), dB.
        settings: options that change the numbers; a resumed run must have the same.
    """

    step: int
    network: Network
    heads: nn.Module
    average: dict[str, Tensor]
    optimisers: tuple[torch.optim.Optimizer, ...]
    best: float
    settings: dict[str, Any]


def write(path: Path, state: State) -> None:
    """Write ``state`` to ``path``, whole or not at all."""
    tensors = {f"network/{name}": t.detach().contiguous() for name, t in state.network.named_parameters()}
    tensors |= {f"heads/{name}": t.detach().contiguous() for name, t in state.heads.named_parameters()}
    tensors |= {f"average/{name}": t.contiguous() for name, t in state.average.items()}
    for name, optimiser, parameter in _name_optimisers(state):
        for kind, value in optimiser.state[parameter].items():
            tensors[f"optimiser/{name}/{kind}"] = torch.as_tensor(value).contiguous()
    # One entry, since safetensors writes several in a different order each time.
    metadata = {ENTRY: json.dumps({"step": state.step, "best": state.best, "settings": state.settings})}
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_bytes(save({name: t.cpu() for name, t in tensors.items()}, metadata))
    temporary.replace(path)


def read(path: Path, state: State, device: torch.device) -> None:
    """Read ``path`` into ``state``.

    Raises:
        InputError: the file can't be read, or was made with other settings.
    """
    try:
        with safe_open(path, "pt", device=str(device)) as file:
            entry = json.loads(file.metadata()[ENTRY])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, KeyError, TypeError, ValueError, SafetensorError) as error:
        raise InputError(f"{path}: {error}") from error
    before = entry["settings"]
    if different := [k for k in state.settings if before.get(k) != state.settings[k]]:
        name = different[0]
        raise InputError(
            f"{path}: made with {name} {before.get(name)}, not {state.settings[name]}; resume with the same settings"
        )
    state.step, state.best = entry["step"], entry["best"]
    state.network.load_state_dict(_below("network/", tensors))
    state.heads.load_state_dict(_below("heads/", tensors))
    for name, tensor in _below("average/", tensors).items():
        state.average[name].copy_(tensor)
    for name, optimiser, parameter in _name_optimisers(state):
        slots = _below(f"optimiser/{name}/", tensors)
        optimiser.state[parameter] = {k: t if t.ndim == 0 else t.to(memory_format=_layout(parameter)) for k, t in slots.items()}


def _name_optimisers(state: State) -> Iterator[tuple[str, torch.optim.Optimizer, Tensor]]:
    parameters = (*state.network.named_parameters(), *state.heads.named_parameters(prefix="heads"))
    names = {parameter: name for name, parameter in parameters}
    for optimiser in state.optimisers:
        for group in optimiser.param_groups:
            yield from ((names[parameter], optimiser, parameter) for parameter in group["params"])


def _layout(parameter: Tensor) -> torch.memory_format:
    return torch.channels_last if parameter.ndim == 4 else torch.contiguous_format


def _below(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
