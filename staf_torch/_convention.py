"""What a file of coefficients has to say about the basis that they belong to, and how modules hold values."""

from __future__ import annotations

import json
from typing import Any

import torch
from torch import Tensor, nn

FORMAT = 2
"""Of the local bases; raised whenever the same coefficients come to mean another function."""

_COMPARED = {
    "format": "format of the local basis",
    "kernel": "kernel",
    "radius": "radius",
    "centers": "number of centers and states",
    "basis": "local basis",
}


def hold(module: nn.Module, name: str, value: Tensor) -> None:
    """Keep a hyperparameter: an `nn.Parameter` as one, to be learned; any other tensor as a fixed buffer."""
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    else:
        module.register_buffer(name, value)


def described(module: nn.Module) -> str:
    """Class and settings that are not tensors, children included: what a state_dict does not hold."""
    plain = {
        name: value
        for name, value in vars(module).items()
        if not name.startswith("_") and name != "training" and isinstance(value, bool | int | float | str)
    }
    parts = [f"{name}={value!r}" for name, value in sorted(plain.items())]
    parts += [f"{name}={described(child)}" for name, child in sorted(module.named_children())]
    return f"{type(module).__name__}({', '.join(parts)})"


def shown(module: nn.Module) -> str:
    """The module's own tensors for its repr: numbers by value, others by shape."""
    own = [(n, t) for n, t in (*module._parameters.items(), *module._buffers.items()) if t is not None]
    return ", ".join(
        f"{name}={float(t.detach()):.6g}" if t.dim() == 0 and not t.is_meta else f"{name}={tuple(t.shape)}"
        for name, t in own
    )


def encode(record: dict[str, Any]) -> Tensor:
    """A record as a uint8 tensor of JSON: what every tool that handles a state_dict can carry."""
    return torch.tensor(list(json.dumps(record, sort_keys=True).encode()), dtype=torch.uint8)


def decode(call: str, stored: Tensor) -> dict[str, Any]:
    """The record of `encode`, also where averaging has made its numbers floating-point.

    Raises:
        ValueError: if it is not one.
    """
    try:
        record = json.loads(bytes(stored.detach().cpu().round().to(torch.uint8).tolist()))
    except ValueError:  # of JSON, or of the decoding
        record = None
    if not isinstance(record, dict):
        raise ValueError(
            f"`{call}`: the entry `convention` must be what a StaFBasis wrote; it is not readable."
        )
    return record


def compare(call: str, saved: dict[str, Any], own: dict[str, Any]) -> None:
    """Whether coefficients that were saved with one record mean the same function beside another.

    Raises:
        ValueError: if they do not, and why.
    """
    for key, name in _COMPARED.items():
        if saved.get(key) != own[key]:
            raise ValueError(
                f"`{call}`: coefficients mean another function here, as the {name} must be the same: "
                f"saved with {saved.get(key)}, loaded into {own[key]}. Build the same basis, or fit anew."
            )
