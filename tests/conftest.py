"""Fixtures for all tests."""

from __future__ import annotations

import pytest
import torch

DEVICES = ["cpu", *["cuda"] * torch.cuda.is_available()]


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    """Each device there is, so that every test of an op is a test of every implementation."""
    return str(request.param)
