"""Fixtures for all tests."""

from __future__ import annotations

import os

import pytest
import torch

DEVICES = ["cpu", *["cuda"] * torch.cuda.is_available()]


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    """Each device there is, so that every test of an op is a test of every implementation."""
    return str(request.param)


@pytest.fixture
def looked_into(device: str) -> bool:
    """Whether ops look at what their tensors hold, which on a GPU, emulated or not, they do not wait for."""
    return device == "cpu" and "SURFCAP_EMULATED" not in os.environ
