"""The identification of a basis in a state_dict, by which stored coefficients are checked and loaded."""

from __future__ import annotations

import abc
import json
from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor, nn

from ..centers import StateFollowingCenters
from ..kernels import Kernel
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


class ConventionModule(nn.Module, abc.ABC):
    """A module whose buffer `convention` says in a state_dict what coefficients beside it mean.

    A state_dict with a convention is loaded where it means the module's own functions; one without, of
    directions alone, makes the module choose its local basis anew.
    """

    _choose_again = False  # whether directions came without what fixes their local basis
    convention: Tensor

    @abc.abstractmethod
    def _record(self) -> dict[str, Any]:
        """Return what coefficients mean here: see `record`."""

    @abc.abstractmethod
    def _adopt(self, saved: dict[str, Any] | None) -> None:
        """Take over the local basis of a saved record; None: choose the one of the present directions."""

    @abc.abstractmethod
    def _prepare(self) -> None:
        """Set up what depends on fixed tensors alone, again whenever others are loaded."""

    def check_convention(self, call: str, stored: Tensor) -> None:
        """Refuse coefficients that were saved with a `convention` in which they mean another function.

        Args:
            call: the function that was called, for the message.
            stored: the `convention` that was saved.

        Raises:
            ValueError: if they mean another function here, and why.
        """
        compare(call, decode(call, stored), self._record())

    def _keep_convention(self) -> None:
        """Register the buffer, once everything that the record tells is there."""
        self.register_buffer("convention", encode(self._record()))
        self.register_load_state_dict_post_hook(ConventionModule._after_loading)  # type: ignore[no-untyped-call]

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *arguments: Any, **keywords: Any
    ) -> None:
        key = f"{prefix}convention"
        self._choose_again = key not in state_dict and f"{prefix}centers.directions" in state_dict
        if key in state_dict:
            call = f"{type(self).__name__}.load_state_dict"
            self.check_convention(call, state_dict[key])
            saved = decode(call, state_dict[key])
            self._adopt(saved)
            stored = state_dict[key]
            device = stored.device if self.convention.is_meta else self.convention.device
            state_dict[key] = self.convention = encode(saved).to(device)
        super()._load_from_state_dict(state_dict, prefix, *arguments, **keywords)

    @staticmethod
    def _after_loading(module: nn.Module, _: object) -> None:
        assert isinstance(module, ConventionModule)
        if module._choose_again:
            module._adopt(None)
            module.convention = encode(module._record()).to(module.convention.device)
        module._prepare()

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self._prepare()  # in the new dtype, on the new device
        return self


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
    """Return class and settings that are not tensors, children included: what a state_dict does not hold."""
    plain = {
        name: value
        for name, value in vars(module).items()
        if not name.startswith("_") and name != "training" and isinstance(value, bool | int | float | str)
    }
    parts = [f"{name}={value!r}" for name, value in sorted(plain.items())]
    parts += [f"{name}={described(child)}" for name, child in sorted(module.named_children())]
    return f"{type(module).__name__}({', '.join(parts)})"


def encode(record: dict[str, Any]) -> Tensor:
    """Return a record as a uint8 tensor of JSON, which every tool that handles a state_dict can carry."""
    return torch.tensor(list(json.dumps(record, sort_keys=True).encode()), dtype=torch.uint8)


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
