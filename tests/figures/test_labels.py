"""Numbers as figures say them."""

from __future__ import annotations

import pytest

from staf_torch.figures.theory import _power


@pytest.mark.parametrize(
    ("number", "said"),
    [(1e-3, "10^{-3}"), (10.0, "10^{1}"), (1.0, "10^{0}"), (0.002, "0.002"), (20.0, "20"), (3e-5, "3e-05")],
)
def test_powers_of_ten_are_written_as_such_and_other_numbers_in_full(number: float, said: str) -> None:
    assert _power(number) == said
