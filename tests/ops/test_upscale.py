"""upscale: a coarse field read at the centres of finer voxels."""

from __future__ import annotations

import pytest
import torch

from tests.ops.calls import arguments, normal, ops
from tests.ops.fields import assert_close, make_scene, one_tile


def test_by_hand(device: str) -> None:
    # The coarse tile spans [0, 4]^3 with a = x at voxel x. Fine voxels are half as large: fine tile (1, 1, 1) of a
    # table that begins at -2 spans [0, 2]^3. Its centres lie at 0.25, 0.75, 1.25, 1.75: in coarse voxels -0.25,
    # 0.25, 0.75, 1.25. Inside in y and z: a = 0.25 * 1 (outside) + 0.75 * 0, 0.25, 0.75, 1.25.
    voxels, table, frame = one_tile(device=device)
    voxels[0, ..., 0] = torch.arange(4.0, device=device)[:, None, None]
    place = torch.ones(1, 3, dtype=torch.int32, device=device)
    fine = ops.upscale(voxels, table, frame, place, [-2.0, -2.0, -2.0, 0.5, 1.0, 0.0])
    assert_close(fine[0, :, 2, 2, 0], torch.tensor([0.25, 0.25, 0.75, 1.25], dtype=torch.float64))
    # At the low edge in y too, a quarter of it all is outside: 0.75 * 1.25 + 0.25 * 1.
    assert fine[0, 3, 0, 2, 0].item() == pytest.approx(0.75 * 1.25 + 0.25)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_adjoint_of_sampling(degree: int, device: str) -> None:
    """<U x, y> = <x, U^T y>, where U^T is sample_backward at the fine voxels' centres."""
    scene = make_scene(degree, device=device)
    scene.frame[4:] = [0.0, 0.0]
    given = arguments("upscale", scene)
    places, frame = given[3:]
    local = torch.cartesian_prod(*[torch.arange(4, device=device)] * 3)
    centers = (4 * places[:, None] + local).double() + 0.5
    points = (scene.voxels.new_tensor(frame[:3]) + centers * frame[3]).view(-1, 3)
    x, fine = scene.voxels, ops.upscale(*given)
    y = normal(x, *fine.shape)
    back = ops.sample_backward(y.view(-1, x.shape[-1]), *scene.field, points)
    torch.testing.assert_close((fine * y).sum(), (x * back).sum())


def test_wrong_places_are_named(device: str) -> None:
    good = arguments("upscale", make_scene(device=device))
    with pytest.raises(RuntimeError, match="fine_coordinates: expected shape"):
        ops.upscale(*good[:3], good[3][:, :2], good[4])
    with pytest.raises(RuntimeError, match="fine_coordinates: expected int32"):
        ops.upscale(*good[:3], good[3].long(), good[4])
    with pytest.raises(RuntimeError, match="frame: expected"):
        ops.upscale(*good[:4], good[4][:3])
