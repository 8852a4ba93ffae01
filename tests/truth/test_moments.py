"""Heads of Gaussian networks start at the standard deviation that they are told."""

from __future__ import annotations

import pytest
import torch

from zoo.nn.moments import GaussianHead, Transfer


@pytest.mark.parametrize("transfer", ["square", "exponential"])
@pytest.mark.parametrize("initial", [0.2, 3.0])
def test_a_head_starts_at_its_initial_standard_deviation(
    transfer: Transfer, initial: float
) -> None:
    head = GaussianHead(4, 2, transfer=transfer, floor=1e-3, initial=initial)
    _, std = head(torch.randn(5, 4))
    torch.testing.assert_close(std, torch.full((5, 2), initial + 1e-3))
