"""Words for devices, and what is said of those that cannot be used."""

from __future__ import annotations

import pytest
import torch

from torch_surfcap import InputError, devices

CPU = torch.device("cpu")


def machine(monkeypatch: pytest.MonkeyPatch, kernels: bool, gpus: int) -> None:
    monkeypatch.setattr(devices, "has_kernels", lambda: kernels)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)


@pytest.mark.parametrize(("kernels", "gpus"), [(False, 0), (False, 2), (True, 0), (True, 2)])
def test_auto_takes_what_can_be_used(kernels: bool, gpus: int, monkeypatch: pytest.MonkeyPatch) -> None:
    machine(monkeypatch, kernels, gpus)
    assert devices.resolve("cpu") == CPU
    usable = kernels and gpus > 0
    assert devices.resolve("auto") == (torch.device("cuda", 0) if usable else CPU)
    if usable:
        assert devices.resolve("cuda") == torch.device("cuda", 0)
        assert devices.resolve("cuda:1") == torch.device("cuda", 1)


@pytest.mark.parametrize(
    ("kernels", "gpus", "word", "message"),
    [
        (
            False,
            1,
            "cuda",
            r"found cuda, expected cpu: this build has no CUDA kernels \(TORCH_SURFCAP_CUDA=1 pip",
        ),
        (True, 0, "cuda:0", "found cuda:0, expected cpu: torch finds no GPU"),
        (True, 1, "cuda:1", "found cuda:1, expected cuda:0: torch finds no other"),
        (True, 3, "cuda:3", "found cuda:3, expected cuda:0 to cuda:2: torch finds no other"),
        (True, 1, "gpu", "found gpu, expected one of auto, cpu, cuda, cuda:0"),
        (True, 1, "cuda:", "found cuda:, expected one of"),
        (True, 1, "cuda:-1", "found cuda:-1, expected one of"),
    ],
)
def test_what_cannot_be_used(
    kernels: bool, gpus: int, word: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine(monkeypatch, kernels, gpus)
    with pytest.raises(InputError, match=f"device: {message}") as caught:
        devices.resolve(word)
    assert "\n" not in str(caught.value)


def test_what_is_free(device: str) -> None:
    there = torch.device(device)
    before = devices.free_bytes(there)
    assert before > 0
    with devices.current(there):
        devices.reset_peak(there)
        held = torch.zeros(1 << 22, device=there)
    peak = devices.peak_bytes(there)
    assert (peak is None) == (device == "cpu")
    if peak is not None:
        assert peak >= held.nbytes
        assert devices.free_bytes(there) <= before - held.nbytes
    assert devices.name(there)
