"""The stability suite: every condition does what its sentence says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torch_surfcap.data.capture import Capture
from torch_surfcap.data.checks import meeting_point
from torch_surfcap.data.sample_scene import Coat
from torch_surfcap.errors import InputError
from torch_surfcap.studies.stress import (
    calibration,
    capture,
    numbers,
    page,
    photometry,
    silhouettes,
    suite,
    trial,
)
from torch_surfcap.studies.stress.condition import Condition
from torch_surfcap.studies.stress.scene import WRONG, Scene, photographed, true_surface

TINY = Scene(views=10, test_views=2, size=64)
CONDITIONS = suite.all_conditions()


@pytest.fixture(scope="module")
def tiny() -> Capture:
    return photographed(TINY)


def condition(group: str, title: str) -> Condition:
    return next(c for c in CONDITIONS if (c.group, c.title) == (group, title))


def middle(seen: Capture) -> Tensor:
    """[N,2] where the cameras see the point that they look at."""
    point = torch.tensor([[0.0, 0.0, 0.92]], dtype=torch.float64)
    return torch.cat([seen.cameras.project(i, point)[0] for i in range(len(seen))])


def test_names_are_unique_and_groups_are_those_of_the_suite() -> None:
    assert len({(c.group, c.title) for c in CONDITIONS}) == len(CONDITIONS) > 80
    assert CONDITIONS[0] is suite.CLEAN
    assert {c.group for c in CONDITIONS[1:]} == {group.GROUP for group in suite.GROUPS}
    titles = {(c.group, c.title) for c in CONDITIONS}
    assert {(group, title) for group, title, _ in page.BOUNDS} <= titles


@pytest.mark.parametrize("spoilt", CONDITIONS[1:], ids=lambda c: f"{c.group}: {c.title}")
def test_a_condition_leaves_its_input_alone_and_gives_another(spoilt: Condition, tiny: Capture) -> None:
    before = [[p.clone() for p in part or ()] for part in (tiny.images, tiny.masks, tiny.plates)]
    other = spoilt.capture(tiny)
    for part, kept in zip((tiny.images, tiny.masks, tiny.plates), before, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(part or (), kept, strict=True))
    assert other.test is not None
    if spoilt.world is None:
        assert other.test is tiny.test
    changed = other.names != tiny.names or spoilt.scene(TINY) != TINY or bool(spoilt.settings)
    for a, b in ((other.images, tiny.images), (other.masks, tiny.masks), (other.plates, tiny.plates)):
        changed |= a is None or any(not torch.equal(x, y) for x, y in zip(a, b or (), strict=False))
    changed |= not torch.equal(other.cameras.K, tiny.cameras.K)
    changed |= not torch.equal(other.cameras.world_to_camera, tiny.cameras.world_to_camera)
    assert changed or spoilt.name in ("repeated", "threads") or spoilt.title == "views 30"


def test_a_scene_on_disk(tiny: Capture, tmp_path: Path) -> None:
    """Comes back as it was, pictures of unlike sizes too, and without a pickle."""
    K, pose = tiny.cameras.K[:2], tiny.cameras.world_to_camera[:2]
    assert tiny.masks is not None
    odd = Capture([tiny.images[0][:, :48], tiny.images[1]], K, pose, [tiny.masks[0][:, :48], tiny.masks[1]])
    for number, saved in enumerate((tiny, odd)):
        trial._save(saved, tmp_path / f"{number}.npz")
        back = trial._load(tmp_path / f"{number}.npz")
        assert (back.plates is None, back.test is None) == (saved.plates is None, saved.test is None)
        for a, b in ((back, saved), (back.test or back, saved.test or saved)):
            assert torch.equal(a.cameras.K, b.cameras.K)
            assert torch.equal(a.cameras.world_to_camera, b.cameras.world_to_camera)
            for kind in ("images", "masks", "plates"):
                pairs = zip(getattr(a, kind) or (), getattr(b, kind) or (), strict=True)
                assert all(torch.equal(x, y) for x, y in pairs)


def test_gains_multiply_photograph_and_plate_alike(tiny: Capture) -> None:
    other = photometry.gains(tiny, 0.2)
    ratios = []
    for i in range(len(tiny)):
        for before, after in ((tiny.photograph(i), other.photograph(i)), (tiny.plate(i), other.plate(i))):
            sure = (before > 0.2) & (before < 0.75)
            ratios.append(after[sure] / before[sure])
            assert ratios[-1].std() < 0.01
        assert abs(float(ratios[-1].mean() - ratios[-2].mean())) < 0.005
    means = torch.stack([ratio.mean() for ratio in ratios])
    assert 0.8 <= means.min() < 0.95
    assert 1.05 < means.max() <= 1.21
    cast = photometry.gains(tiny, 0.3, 3).photograph(0).mean((0, 1)) / tiny.photograph(0).mean((0, 1))
    assert cast.std() > 0.03


def test_photometry_by_its_figures(tiny: Capture) -> None:
    plain = tiny.plate(0)
    dark = photometry.vignetted(tiny, 0.3).plate(0)
    assert float((dark / plain)[0, 0].mean()) == pytest.approx(0.7, abs=0.03)
    assert float((dark / plain)[32, 32].mean()) == pytest.approx(1.0, abs=0.01)
    noise = photometry.noisy(tiny, 0.05)
    inner = (plain > 0.25) & (plain < 0.75)
    assert float((noise.plate(0) - plain)[inner].std()) == pytest.approx(0.05, rel=0.05)
    assert not torch.equal(noise.plate(0) - plain, noise.photograph(0) - tiny.photograph(0))
    for spoilt in (photometry.blurred(tiny, 2.0), photometry.jpeg(tiny, 15)):
        step = [p.diff(dim=0).abs().mean() for p in (spoilt.plate(0), plain)]
        assert step[0] < 0.95 * step[1]
    bright = photometry.over_exposed(tiny, 3.0)
    assert torch.equal(bright.images[0], tiny.images[0])
    assert float((bright.photograph(1) > 0.999).float().mean()) > 0.3
    black = photometry.black_frame(tiny)
    assert [int(image.max()) == 0 for image in black.images] == [i == WRONG for i in range(len(tiny))]


@pytest.mark.parametrize("pixels", calibration.PIXELS)
def test_calibration_is_off_by_so_many_pixels(tiny: Capture, pixels: float) -> None:
    before = middle(tiny)
    for change in (calibration.rotated, calibration.translated, calibration.off_centre):
        moved = (middle(change(tiny, pixels)) - before).norm(dim=1)
        assert torch.allclose(moved, torch.full_like(moved, pixels), rtol=0.1), change.__name__
    turned = calibration.rotated(tiny, pixels)
    assert torch.allclose(turned.cameras.centers, tiny.cameras.centers)
    zoomed = calibration.zoomed(tiny, pixels).cameras.K
    border = (zoomed[:, 0, 0] / tiny.cameras.K[:, 0, 0] - 1).abs() * 32
    assert torch.allclose(border, torch.full_like(border, pixels))


def test_distortion_moves_the_sides_inwards(tiny: Capture) -> None:
    ramp = torch.arange(64.0).expand(64, 64)[..., None].repeat(1, 1, 3) / 64
    flat = Capture([ramp], tiny.cameras.K[:1], tiny.cameras.world_to_camera[:1], [torch.ones(64, 64)])
    at = 64 * calibration.distorted(flat, 4.0).images[0][32, :, 0]
    assert float(at[32]) == pytest.approx(32.0, abs=0.1)
    assert float(at[48]) == pytest.approx(48 + 4 * 0.5**3, abs=0.1)  # it shows what stood farther out


def test_one_camera_is_wholly_wrong(tiny: Capture) -> None:
    moved = (calibration.one_wrong(tiny).cameras.centers - tiny.cameras.centers).norm(dim=1)
    assert [float(d) > 3.0 for d in moved] == [i == WRONG for i in range(len(tiny))]


def test_masks_grow_shrink_break_and_vanish(tiny: Capture) -> None:
    assert tiny.masks is not None
    square = torch.zeros(64, 64)
    square[24:40, 24:40] = 1
    one = tiny.subset([0])
    one.masks = [square]
    for pixels in (1, 3, 8):
        for sign in (-1, 1):
            if (pixels, sign) != (8, -1):
                masks = silhouettes.grown(one, sign * pixels).masks or []
                assert float(masks[0][32].sum()) == 16 + 2 * sign * pixels
    holed = silhouettes.holed(tiny, 3).masks or []
    lost = [float((a - b).sum() / a.sum()) for a, b in zip(tiny.masks, holed, strict=True)]
    assert 0.02 < min(lost) < max(lost) < 0.6
    empty = [float(mask.max()) == 0 for mask in silhouettes.missing(tiny, 3).masks or ()]
    assert empty == [i % 3 == 0 for i in range(len(tiny))]
    bare = silhouettes.without(tiny, plates=True)
    assert bare.masks is None
    assert bare.mask_source is None
    assert bare.plates is not None
    assert silhouettes.without(tiny, plates=False).plates is None


def test_cut_out_with_a_fringe(tiny: Capture) -> None:
    assert tiny.masks is not None
    white = silhouettes.composited(tiny, 1.0)
    kept = torch.from_numpy(np.array(silhouettes.grown(tiny, 2).masks or [])[0])
    assert white.plates is None
    assert (white.photograph(0)[tiny.masks[0] == 1] == tiny.photograph(0)[tiny.masks[0] == 1]).all()
    fringe = (kept == 1) & (tiny.masks[0] == 0)
    assert (white.photograph(0)[fringe] == tiny.photograph(0)[fringe]).float().mean() > 0.7
    far = silhouettes.grown(tiny, 5).masks or []
    assert (white.photograph(0)[far[0] == 0] == 1).all()


def test_views_are_chosen_and_cropped(tiny: Capture) -> None:
    half = capture.one_side(tiny)
    assert len(half) == 5
    assert half.cameras.centers[:, 1].max() < tiny.cameras.centers[:, 1].max()
    cut = capture.cropped(tiny, 3, 0.5)
    assert [image.shape[1] for image in cut.images] == [32 if i % 3 == 0 else 64 for i in range(10)]
    assert torch.allclose(middle(cut)[0] + torch.tensor([32.0, 0.0]), middle(tiny)[0])
    assert torch.equal(cut.images[0], tiny.images[0][:, 32:])


@pytest.mark.parametrize("spoilt", [c for c in CONDITIONS if c.world is not None], ids=lambda c: c.title)
def test_worlds_move_with_their_pictures(spoilt: Condition, tiny: Capture) -> None:
    assert spoilt.world is not None
    point = meeting_point(tiny)
    there = spoilt.world[:3, :3] @ point + spoilt.world[:3, 3]
    for before, after in ((tiny, spoilt.capture(tiny)), (tiny.test, spoilt.capture(tiny).test)):
        assert before is not None
        assert after is not None
        for i in range(len(before)):
            uv, _ = before.cameras.project(i, point[None])
            assert torch.allclose(after.cameras.project(i, there[None])[0], uv, atol=1e-5)


def test_order_and_rounding(tiny: Capture) -> None:
    other = numbers.permuted(tiny)
    assert sorted(other.names) == tiny.names != other.names
    at = tiny.names.index(other.names[0])
    assert torch.equal(other.images[0], tiny.images[at])
    assert torch.equal(other.cameras.K[0], tiny.cameras.K[at])
    rounded = numbers.rounded(tiny).cameras.world_to_camera
    assert 0 < (rounded - tiny.cameras.world_to_camera).abs().max() < 1e-6


def test_scenes_hold_what_they_describe() -> None:
    plain = true_surface(TINY)
    assert true_surface(replace(TINY, wires=1.0)).bounds[1, 2] > plain.bounds[1, 2] + 0.2
    hand = true_surface(replace(TINY, fingers=2.0))
    tips = hand.vertices[hand.vertices[:, 2] > plain.bounds[1, 2] + 0.1]
    assert len(np.unique(np.round(tips[:, 0] / (4 * TINY.voxel)))) == 5
    fringed = true_surface(replace(TINY, fringe=True))
    assert len(fringed.faces) > len(plain.faces) + 300 * 8
    assert true_surface(replace(TINY, second=True)).bounds[1, 0] == pytest.approx(0.85, abs=0.01)
    sunk = true_surface(replace(TINY, sunk=True))
    assert sunk.bounds[0, 2] == 0
    assert sunk.bounds[1, 2] == pytest.approx(plain.bounds[1, 2] - 0.03)
    depths = []
    for depth in (0.1, 0.4):
        bowl = true_surface(Scene("bowl", depth=depth))
        assert bowl.is_watertight
        assert bowl.body_count == 1
        depths.append(bowl.volume)
    assert depths[1] > depths[0]  # of a deeper bowl more of the wall is left
    with pytest.raises(InputError, match="cup"):
        Scene("cup")
    with pytest.raises(InputError, match="fur"):
        Coat(paint="fur")


def test_scenes_look_as_they_are_described(tiny: Capture) -> None:
    few = replace(TINY, views=4, test_views=0, size=32)
    clean = photographed(few)
    assert clean.masks is not None

    def differs(scene: Scene) -> list[float]:
        other = photographed(scene)
        return [float((other.photograph(i) - clean.photograph(i)).abs().mean()) for i in range(4)]

    moment = differs(replace(few, moment=True))
    assert [d > 0.001 for d in moment] == [i == WRONG for i in range(4)]
    for coat in (Coat(mirror=(1.05, 1.25)), Coat(paint="plain"), Coat(paint="repeated")):
        assert min(differs(replace(few, coat=coat))) > 0.001
    shadow = photographed(replace(few, shadow=True))
    assert shadow.masks is not None
    grown = [shadow.masks[i] - clean.masks[i] > 0.9 for i in range(4)]
    assert max(int(new.sum()) for new in grown) > 5
    for i, new in enumerate(grown):
        assert (shadow.photograph(i)[new] < clean.photograph(i)[new]).all()
    mixed = photographed(replace(few, rig="mixed"))
    assert len({image.shape for image in mixed.images}) > 1
    inside = photographed(replace(few, rig="inside")).cameras.centers
    assert float((inside[WRONG] - torch.tensor([0.0, 0.0, 0.92])).norm()) == pytest.approx(0.3)
