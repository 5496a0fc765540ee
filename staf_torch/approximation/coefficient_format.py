"""The identification of a basis in a state_dict, by which stored coefficients are checked and loaded."""

from __future__ import annotations

import json
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from ..centers import StateFollowingCenters
from ..kernels import Kernel
from ..lanes.row_numbers import all_rows
from ..local_basis import Degrees

FORMAT = 2
"""Of the local bases; raised whenever the same coefficients come to mean another function."""

_COMPARED = {
    "format": "format of the local basis",
    "kernel": "kernel",
    "radius": "radius",
    "centers": "number of centers and states",
    "basis": "local basis",
}


def record(
    kernel: Kernel, centers: StateFollowingCenters, kind: str, degrees: Degrees | None
) -> dict[str, Any]:
    """Return what coefficients mean, beside the tensors of the state_dict.

    Args:
        kernel: the kernel.
        centers: its centers.
        kind: of local basis.
        degrees: what fixes that basis; None where nothing has to.
    """
    told = {"format": FORMAT, "kernel": described(kernel), "basis": kind}
    told |= {"radius": described(centers.radius), "centers": [centers.count, centers.dim]}
    return told if degrees is None else told | {"degrees": degrees._asdict()}


def described(module: nn.Module) -> str:
    """Return class and settings that are not tensors, children included: what a state_dict does not hold.

    How a learned number is parametrised (`torch.nn.utils.parametrize`) is no part of the function.
    """
    plain = {
        name: value
        for name, value in vars(module).items()
        if not name.startswith("_") and name != "training" and isinstance(value, bool | int | float | str)
    }
    parts = [f"{name}={value!r}" for name, value in sorted(plain.items())]
    children = [
        (name, child) for name, child in sorted(module.named_children()) if name != "parametrizations"
    ]
    parts += [f"{name}={described(child)}" for name, child in children]
    return f"{parametrize.type_before_parametrizations(module).__name__}({', '.join(parts)})"


def encode(record: dict[str, Any]) -> Tensor:
    """Return a record as a uint8 tensor of JSON, which every tool that handles a state_dict can carry."""
    text = json.dumps(record, sort_keys=True, default=lambda numbers: all_rows(numbers).tolist())
    return torch.tensor(list(text.encode()), dtype=torch.uint8, device="cpu")


def decode(call: str, stored: Tensor) -> dict[str, Any]:
    """Return the record of `encode`, also where averaging has made its numbers floating-point.

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
    """Refuse coefficients whose saved record differs from the module's own.

    Raises:
        ValueError: if they do not, and why.
    """
    for key, name in _COMPARED.items():
        if saved.get(key) != own[key]:
            raise ValueError(
                f"`{call}`: coefficients mean another function here, as the {name} must be the same: "
                f"saved with {saved.get(key)}, loaded into {own[key]}. Build the same basis, or fit anew."
            )
