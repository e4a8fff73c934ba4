"""fit(): a ball from its photographs, better than a voxel; the same every time; what it refuses."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from tests.fitting.sphere import CENTER, RADIUS, ball
from tests.fitting.stages import begun
from torch_surfcap import Capture, FitResult, InputError, devices, fit
from torch_surfcap.field.field import RayOutput
from torch_surfcap.fitting import course
from torch_surfcap.fitting.budget import estimate, shortage
from torch_surfcap.fitting.levels import first_field, plan_levels, subject_box
from torch_surfcap.fitting.settings import FitSettings
from torch_surfcap.metrics import surface_scores
from torch_surfcap.report import score_views

QUICK: dict[str, Any] = {"levels": 2, "voxel": 1 / 40}


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def errors(mesh: trimesh.Trimesh) -> np.ndarray:
    """Distance of the vertices to the ball's surface."""
    return np.linalg.norm(mesh.vertices - np.array(CENTER), axis=1) - RADIUS


@pytest.mark.parametrize("opacity", ["transparency", "distance"])
def test_ball(opacity: str, device: str) -> None:
    """One closed piece, half a voxel from the truth on average or less, nowhere two; the colours explain the pictures."""
    result = fit(ball(side=48), opacity=opacity, sh_degree=0, device=device, **QUICK)
    assert result.field.voxels.device.type == device
    voxel = result.chosen["voxel"]["value"]
    assert voxel == 1 / 40
    assert result.mesh.body_count == 1
    assert result.mesh.is_watertight
    assert result.mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.1)
    assert np.sqrt(np.mean(errors(result.mesh) ** 2)) < 0.5 * voxel
    assert np.abs(errors(result.mesh)).max() < 2 * voxel
    capture = ball(side=48)
    backdrop = torch.zeros(48 * 48, 3)
    with torch.no_grad():
        seen = RayOutput(*(x.cpu() for x in result.field(*capture.cameras.rays(0), backdrop)))
    assert capture.masks is not None
    mask = capture.masks[0].flatten()
    photograph = (capture.photograph(0).view(-1, 3) * mask[:, None]).clamp(0, 1)
    assert (seen.color - photograph).square().mean() < 10**-2.4  # 24 dB
    assert ((1 - seen.transmittance) - mask).abs().mean() < 0.02
    depth = (seen.depth[mask > 0.999] - 1.5).abs()  # the centre is 1.5 away
    assert depth.max() < RADIUS + 2 * voxel
    levels = [row["level"] for row in result.history]
    assert levels == sorted(levels)
    assert set(levels) == {0.0, 1.0}
    assert (result.gain - 1).abs().median() < 0.03  # the cameras are equal
    assert result.gain.shape == (12, 3)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("opacity", ["transparency", "distance"])
def test_higher_degrees(opacity: str, degree: int, device: str) -> None:
    given: dict[str, Any] = {"opacity": opacity, "sh_degree": degree, "device": device}
    result = fit(ball(side=48), levels=1, voxel=1 / 24, **given)
    assert result.field.sh_degree == degree
    assert np.median(np.abs(errors(result.mesh))) < 1 / 24
    assert result.history[-1]["loss"] < 0.2 * result.history[0]["loss"]
    assert (result.field.sh[..., 1:, :] != 0).any()


@pytest.mark.parametrize("visit", ["cells", "box"])
def test_what_rays_visit_changes_next_to_nothing(visit: str, device: str) -> None:
    """Without integration ranges, and even through the whole box, the same surface comes out."""
    result = fit(ball(8, 32), sh_degree=0, levels=1, voxel=0.05, descent={"visit": visit}, device=device)
    usual = fit(ball(8, 32), sh_degree=0, levels=1, voxel=0.05, device=device)
    assert np.isnan(result.history[0]["samples"])
    assert usual.history[0]["samples"] > 0
    assert abs(np.abs(errors(result.mesh)).mean() - np.abs(errors(usual.mesh)).mean()) < 0.1 * 0.05


@pytest.mark.parametrize("images", ["device", "host"])
def test_plates_are_the_background(images: str, device: str) -> None:
    capture = ball(8, 32, plates=True)
    result = fit(capture, sh_degree=0, levels=1, voxel=0.05, images=images, device=device)
    assert np.abs(errors(result.mesh)).max() < 2 * 0.05


def test_the_world_may_lie_anywhere() -> None:
    """The mesh of a subject 100 km from the origin is that of the subject at the origin, and shows as much."""
    capture, shift = ball(8, 32), torch.tensor([6e4, -6.4e4, 4.8e4], dtype=torch.float64)
    away = capture.moved(shift)
    settings: dict[str, Any] = {"levels": 2, "voxel": 0.05, "sh_degree": 1, "view_spacing": 4}
    near, far = (fit(c, **settings) for c in (capture, away))
    moved = far.mesh.copy().apply_translation(-shift.numpy())
    assert surface_scores(moved, near.mesh, samples=20_000)["chamfer"] < 0.02 * 0.05
    corners = torch.tensor([r.chosen["box"]["value"] for r in (near, far)], dtype=torch.float64)
    torch.testing.assert_close(corners[1] - shift.repeat(2), corners[0], rtol=0, atol=1e-6)
    scores = [score_views(r.field, r.mesh, c, [0]) for r, c in ((near, capture), (far, away))]
    assert scores[1] == pytest.approx(scores[0], rel=1e-3)


def same(one: FitResult, two: FitResult) -> bool:
    return torch.equal(one.field.voxels, two.field.voxels) and torch.equal(one.field.table, two.field.table)


@pytest.mark.parametrize("opacity", ["transparency", "distance"])
def test_same_seed_same_bits_on_any_threads(opacity: str, threads: None) -> None:
    settings: dict[str, Any] = {"opacity": opacity, "sh_degree": 1, "levels": 2, "voxel": 0.05}
    results = []
    for count, seed in ((1, 0), (2, 0), (2, 1)):
        torch.set_num_threads(count)
        results.append(fit(ball(8, 32), seed=seed, **settings))
    assert same(results[0], results[1])
    assert np.array_equal(results[0].mesh.faces, results[1].mesh.faces)
    assert np.abs(results[0].mesh.vertices - results[1].mesh.vertices).max() < 1e-12
    assert [r["loss"] for r in results[0].history] == [r["loss"] for r in results[1].history]
    assert not same(results[1], results[2])


def test_progress() -> None:
    """Called before the first level with the budget, and once for every row of the history."""
    seen: list[Any] = []
    result = fit(ball(6, 32), seen.append, sh_degree=0, levels=2, voxel=0.05)
    assert seen[0].row == {}
    assert len(seen[0].budget.level_bytes) == 2
    assert seen[0].budget.seconds > 0
    assert [s.row["loss"] for s in seen[1:]] == [row["loss"] for row in result.history]
    assert {s.levels for s in seen} == {2}
    assert seen[-1].voxels == result.field.transparency.numel()


def test_budget_grows_with_levels_and_degree() -> None:
    capture = ball(6, 32)
    box = subject_box(capture, None)
    plan = plan_levels(capture, box, 0.05, 3)
    bytes_by_degree = []
    for degree in (0, 1, 2):
        settings = FitSettings.of(sh_degree=degree)
        grid, store = first_field(capture, box, plan[0].voxel_size, settings)
        budget = estimate(capture, plan, grid, store, settings)
        assert budget.level_bytes == sorted(budget.level_bytes)
        assert budget.level_bytes[0] > 4 * 3 * store.numel()
        bytes_by_degree.append(budget.level_bytes[-1])
    assert bytes_by_degree == sorted(bytes_by_degree)


def test_budget_counts_the_coarse_grid() -> None:
    """More than without view-dependent colour, less than with it in every voxel."""
    capture = ball(6, 64)
    box = subject_box(capture, None)
    plan = plan_levels(capture, box, 0.01, 3)
    needed = []
    for given in ({"sh_degree": 0}, {"sh_degree": 2, "view_spacing": 4}, {"sh_degree": 2}):
        settings = FitSettings.of(**given)
        grid, store = first_field(capture, box, plan[0].voxel_size, settings)
        needed.append(estimate(capture, plan, grid, store, settings).level_bytes[-1])
    assert needed[0] < needed[1] < 0.6 * needed[2]


def test_shortage_is_one_line() -> None:
    assert shortage(1) is None
    sentence = shortage(1 << 60)
    assert sentence is not None
    assert "\n" not in sentence
    assert "needs 1073741824.0 GiB" in sentence


def test_a_level_without_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first level is refused in one line; a later one is left out with a warning."""
    asked: list[int] = []

    def short_from(number: int) -> None:
        asked.clear()

        def answer(needed: int, **_: Any) -> str | None:
            asked.append(needed)
            return "needs too much" if len(asked) > number else None

        monkeypatch.setattr(course, "shortage", answer)

    short_from(0)
    with pytest.raises(InputError, match=r"memory: level 1 of 2 .* needs too much"):
        fit(ball(6, 32), sh_degree=0, levels=2, voxel=0.05)
    short_from(1)
    result = fit(ball(6, 32), sh_degree=0, levels=2, voxel=0.05)
    assert any("level 2 of 2" in warning and "needs too much" in warning for warning in result.warnings)
    assert result.field.voxel_size == 0.1
    assert result.chosen["voxel"] == {"value": 0.1, "reason": "memory"}
    assert result.chosen["levels"] == {"value": 1, "reason": "memory"}
    assert np.abs(errors(result.mesh)).max() < 2 * 0.1


@pytest.mark.parametrize("at", ["begin_stage", "descend", "next_stage"])
def test_memory_that_runs_out(at: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a device, in the midst of a level: as if it had been known before."""
    capture, whole = ball(6, 32), fit(ball(6, 32), sh_degree=0, levels=1, voxel=0.1)
    monkeypatch.setattr(devices, "may_run_out", lambda _: True)
    there = getattr(course, at)

    def no_memory_at(number: int) -> None:
        calls: list[int] = []

        def runs_out(*arguments: Any) -> Any:
            calls.append(1)
            if at == "descend" and len(calls) > number:

                def rows() -> Iterator[dict[str, float]]:
                    yield from itertools.islice(there(*arguments), 3)
                    raise torch.OutOfMemoryError("CUDA out of memory")

                return rows()
            if at != "descend" and len(calls) > max(0, number - 1):
                raise torch.OutOfMemoryError("CUDA out of memory")
            return there(*arguments)

        monkeypatch.setattr(course, at, runs_out)

    if at != "next_stage":
        no_memory_at(0)
        with pytest.raises(
            InputError, match=r"memory: level 1 of 2 .* GiB that are free: .*sh_degree=0"
        ) as caught:
            fit(capture, sh_degree=0, levels=2, voxel=0.05)
        assert "\n" not in str(caught.value)
    if at != "begin_stage":
        no_memory_at(1)
        result = fit(capture, sh_degree=0, levels=2, voxel=0.05)
        (warning,) = result.warnings
        assert warning.startswith("level 2 of 2 (voxels of 0.05) needs more than the")
        assert warning.endswith("the fit ends with the level before")
        assert result.chosen["levels"] == {"value": 1, "reason": "memory"}
        assert result.field.voxel_size == whole.field.voxel_size


def test_where_photographs_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the device where they leave room for the largest level, or where they are wanted; the fit is the same."""
    _, studio, _ = begun(ball(6, 32), 0.1, 1)
    kept: list[str] = []

    def on(capture: Capture, device: torch.device) -> Capture:
        kept.append(str(device))
        return capture

    monkeypatch.setattr(Capture, "on", on)
    size = sum(picture.nbytes for picture in studio.pictures)
    for images, free, expected in (
        ("auto", 1000 + 2 * size, ["cpu"]),
        ("auto", 1000 + size, []),
        ("auto", 0, []),
        ("device", 0, ["cpu"]),
        ("host", 1 << 40, []),
    ):
        kept.clear()
        monkeypatch.setattr(devices, "free_bytes", lambda _, free=free: free)
        studio.keep_pictures(images, [500, 1000])
        assert kept == expected
    monkeypatch.undo()
    fits = [fit(ball(6, 32), levels=1, voxel=0.1, images=images) for images in ("device", "host")]
    assert same(*fits)


def test_settings_that_are_none() -> None:
    capture = ball(3, 8)
    with pytest.raises(TypeError, match="fit: unknown setting 'sh_degre'"):
        fit(capture, sh_degre=1)
    with pytest.raises(ValueError, match="opacity: expected distance or transparency"):
        fit(capture, opacity="alpha")
    with pytest.raises(InputError, match="device: found gpu"):
        fit(capture, device="gpu")
    with pytest.raises(InputError, match="box: found"):
        fit(capture, box=(0.0, 1.0))
