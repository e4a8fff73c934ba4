"""Pictures of a ball whose silhouette, depth and colours are known."""

import numpy as np
import pytest
import torch
import trimesh

from tests.surface.shapes import CENTER, RADIUS, VOXEL, ball_distance, colors_of, field_of, signed
from torch_surfcap.data.cameras import Cameras
from torch_surfcap.field.field import SurfaceField
from torch_surfcap.surface.extract import extract_mesh
from torch_surfcap.surface.render import (
    GREY,
    cast,
    constant_part,
    first_faces,
    mesh_depth,
    mesh_mask,
    mesh_normals,
    raster,
    shaded,
    view_dependent_part,
    volume,
    window,
    z_buffer,
)

WIDTH, HEIGHT, AWAY = 60, 48, 2.0
WHITE = 1.0


@pytest.fixture(scope="module")
def cameras() -> Cameras:
    """Camera 0 looks along +z at the ball's centre, camera 1 along +x, from AWAY."""
    K = torch.tensor([[80.0, 0, WIDTH / 2], [0, 80, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    along_z = torch.eye(3, dtype=torch.float64)
    along_x = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    for pose, turn in zip(poses, (along_z, along_x), strict=True):
        pose[:3, :3] = turn
        pose[:3, 3] = torch.tensor([0, 0, AWAY], dtype=torch.float64) - turn @ torch.from_numpy(CENTER)
    return Cameras(K.repeat(2, 1, 1), poses, torch.tensor([[WIDTH, HEIGHT]] * 2))


@pytest.fixture(scope="module")
def field() -> SurfaceField:
    """A ball, red below the height of its centre (z), blue above, with four voxels of margin."""
    origin, centers, distance = ball_distance()
    color = np.where(centers[..., 2:] < CENTER[2], [0.8, 0.1, 0.1], [0.1, 0.1, 0.8])
    return field_of(signed(distance), origin, color, opacity="distance")


@pytest.fixture(scope="module")
def mesh(field: SurfaceField) -> trimesh.Trimesh:
    return extract_mesh(field)


def expected_depth(cameras: Cameras, i: int) -> np.ndarray:
    """[H, W] depth along the optical axis of the true ball, NaN beside it."""
    origins, directions = (x.numpy() for x in cameras.rays(i))
    forward = cameras.world_to_camera[i, 2, :3].numpy()
    middle = ((CENTER - origins) * directions).sum(axis=1)
    off = RADIUS**2 - (((CENTER - origins) ** 2).sum(axis=1) - middle**2)
    with np.errstate(invalid="ignore"):
        return np.asarray((middle - np.sqrt(off)) * (directions @ forward)).reshape(HEIGHT, WIDTH)


@pytest.mark.parametrize("i", [0, 1])
def test_mask_and_depth(mesh: trimesh.Trimesh, cameras: Cameras, i: int) -> None:
    truth = expected_depth(cameras, i)
    mask, depth = mesh_mask(mesh, cameras, i), mesh_depth(mesh, cameras, i)
    assert mask.shape == depth.shape == (HEIGHT, WIDTH)
    assert (mask.numpy() != np.isfinite(truth)).mean() < 0.005
    assert (torch.isfinite(depth) == (mask > 0)).all()
    both = np.isfinite(truth) & np.isfinite(depth.numpy())
    assert np.median(np.abs(depth.numpy() - truth)[both]) < 5e-4


def test_shading_and_normals(mesh: trimesh.Trimesh, cameras: Cameras) -> None:
    # In the middle the ball faces the camera: full light, and the normal points at it. To the left of and above the
    # middle it points there as well: less red, more green.
    light, normals = shaded(mesh, cameras, 1), mesh_normals(mesh, cameras, 1)
    row, column = HEIGHT // 2, WIDTH // 2
    assert light[row, column].tolist() == pytest.approx([GREY] * 3, abs=0.03)
    assert normals[row, column].tolist() == pytest.approx([0.5, 0.5, 1.0], abs=0.1)
    assert normals[row, column - 6, 0] < 0.3 < 0.7 < normals[row - 6, column, 1]
    assert light[0, 0].tolist() == normals[0, 0].tolist() == [1, 1, 1]
    assert light[row, column - 9, 0] < light[row, column, 0] - 0.1


def test_raster_shows_the_colours_of_the_seen_side(
    field: SurfaceField, mesh: trimesh.Trimesh, cameras: Cameras
) -> None:
    picture = raster(field, mesh, cameras, 0, WHITE)
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert picture[HEIGHT // 2, WIDTH // 2].tolist() == pytest.approx([0.8, 0.1, 0.1], abs=1e-3)
    assert picture[0, 0].tolist() == [1, 1, 1]
    # Camera 1 has z downwards in its picture: red above, blue below.
    picture = raster(field, mesh, cameras, 1, WHITE)
    assert picture[HEIGHT // 2 - 6, WIDTH // 2].tolist() == pytest.approx([0.8, 0.1, 0.1], abs=1e-3)
    assert picture[HEIGHT // 2 + 6, WIDTH // 2].tolist() == pytest.approx([0.1, 0.1, 0.8], abs=1e-3)


def test_raster_takes_the_direction_of_the_ray(cameras: Cameras) -> None:
    # Degree 1, of which the last function is x: 0.5 + 0.4 x, and camera 1 looks along +x.
    origin, _, distance = ball_distance()
    values = torch.from_numpy(signed(distance)).float()
    sh = torch.zeros(*distance.shape, 4, 3)
    sh[..., 0, :], sh[..., 3, 0] = 0.5, 0.4
    field = SurfaceField.from_dense(values, sh, torch.from_numpy(origin), VOXEL, opacity="distance")
    picture = raster(field, extract_mesh(field), cameras, 1, WHITE)
    assert picture[HEIGHT // 2, WIDTH // 2].tolist() == pytest.approx([0.9, 0.5, 0.5], abs=1e-3)


def test_parts_of_the_colour(cameras: Cameras) -> None:
    # 0.5 + 0.4 x in red seen along +x: constant 0.5, view-dependent 0.4 above mid grey.
    origin, _, distance = ball_distance()
    sh = torch.zeros(*distance.shape, 4, 3)
    sh[..., 0, :], sh[..., 3, 0] = torch.tensor([0.5, 0.3, 0.1]), 0.4
    values = torch.from_numpy(signed(distance)).float()
    field = SurfaceField.from_dense(values, sh, torch.from_numpy(origin), VOXEL, opacity="distance")
    before, mesh, middle = field.voxels.detach().clone(), extract_mesh(field), (HEIGHT // 2, WIDTH // 2)
    for part, color in (
        (constant_part(field), [0.5, 0.3, 0.1]),
        (view_dependent_part(field), [0.5 + 0.4, 0.5, 0.5]),
    ):
        onto, through = raster(part, mesh, cameras, 1, WHITE), volume(part, cameras, 1, WHITE)
        assert onto[middle].tolist() == pytest.approx(color, abs=1e-3)
        assert through[middle].tolist() == pytest.approx(color, abs=0.02)
    assert torch.equal(field.voxels, before)


def test_volume_equals_raster_where_the_field_is_solid(
    field: SurfaceField, mesh: trimesh.Trimesh, cameras: Cameras
) -> None:
    backdrop = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    through, onto = volume(field, cameras, 0, backdrop), raster(field, mesh, cameras, 0, backdrop)
    middle = expected_depth(cameras, 0) < AWAY - 0.15
    assert middle.sum() > 50
    assert float((through - onto).abs()[torch.from_numpy(middle)].max()) < 0.05
    outside = ~np.isfinite(expected_depth(cameras, 0))
    outside[4:-4, 10:-10] = False
    torch.testing.assert_close(through[torch.from_numpy(outside)], backdrop[torch.from_numpy(outside)])


def test_volume_equals_the_field_on_all_rays(field: SurfaceField, cameras: Cameras) -> None:
    origins, directions = (x.float() for x in cameras.rays(1))
    with torch.no_grad():
        direct = field(origins, directions, background=torch.full_like(origins, 0.3)).color
    torch.testing.assert_close(volume(field, cameras, 1, 0.3), direct.reshape(HEIGHT, WIDTH, 3))


def test_far_from_the_origin(
    field: SurfaceField, mesh: trimesh.Trimesh, cameras: Cameras, device: str
) -> None:
    """All pictures of the ball 100 km away are those of the ball at the origin, but for centres on an edge of the mesh."""
    shift = torch.tensor([6e4, -6.4e4, 4.8e4], dtype=torch.float64)
    far = SurfaceField(field.voxels, field.grid.moved(shift), field.opacity, field.step)
    there, places = extract_mesh(far), cameras.moved(shift)
    np.testing.assert_allclose(there.vertices - shift.numpy(), mesh.vertices, rtol=0, atol=1e-9)
    assert (colors_of(there) == colors_of(mesh)).mean() > 0.999
    for one, two in (
        (volume(field, cameras, 0, WHITE), volume(far, places, 0, WHITE)),
        (raster(field, mesh, cameras, 0, WHITE), raster(far, there, places, 0, WHITE)),
        (shaded(mesh, cameras, 0), shaded(there, places, 0)),
        (mesh_depth(mesh, cameras, 0).nan_to_num(0.0), mesh_depth(there, places, 0).nan_to_num(0.0)),
        *((z_buffer(m, c, 0, torch.device(device)) for m, c in ((mesh, cameras), (there, places))),),
    ):
        assert ((one - two).abs() > 1e-4).float().mean() < 0.002


def test_no_mesh_shows_the_background(field: SurfaceField, cameras: Cameras) -> None:
    nothing = trimesh.Trimesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), process=False)
    assert (raster(field, nothing, cameras, 0, [0.1, 0.2, 0.3]) == torch.tensor([0.1, 0.2, 0.3])).all()
    assert mesh_mask(nothing, cameras, 0).sum() == 0


def test_background_of_another_size_is_refused(
    field: SurfaceField, mesh: trimesh.Trimesh, cameras: Cameras
) -> None:
    with pytest.raises(ValueError, match=r"background: expected \[48, 60, 3\], got \[2, 2, 3\]"):
        raster(field, mesh, cameras, 0, torch.zeros(2, 2, 3))


def test_window_by_hand(cameras: Cameras) -> None:
    # A unit cube a focal length of 80 away: half of it, 0.5 * 80 / (2 - 0.5) = 26.67 pixels to each side of (30, 24).
    center = torch.from_numpy(CENTER)
    pixels = window(cameras, 0, center - 0.5, center + 0.5)
    columns, rows = pixels % WIDTH, pixels // WIDTH
    assert (int(columns.min()), int(columns.max())) == (3, 56)
    assert (int(rows.min()), int(rows.max())) == (0, HEIGHT - 1)
    assert len(pixels) == 54 * HEIGHT
    beside = torch.tensor([5.0, 0, 0])
    assert len(window(cameras, 0, center + beside - 0.5, center + beside + 0.5)) == 0
    around_the_camera = torch.tensor([0.0, 0, 5])
    assert len(window(cameras, 0, center - around_the_camera, center)) == WIDTH * HEIGHT


@pytest.mark.parametrize("i", [0, 1])
def test_window_leaves_out_no_hit(mesh: trimesh.Trimesh, cameras: Cameras, i: int) -> None:
    origins, directions = cameras.rays(i)
    face = mesh.ray.intersects_first(origins.numpy(), directions.numpy())
    assert (cast(mesh, cameras, i).pixel == np.flatnonzero(face >= 0)).all()


@pytest.mark.parametrize("i", [0, 1])
def test_the_z_buffer_sees_what_rays_meet(
    mesh: trimesh.Trimesh, cameras: Cameras, i: int, device: str
) -> None:
    pixels = torch.arange(WIDTH * HEIGHT)
    met = first_faces(mesh, cameras, i, pixels, torch.device("cpu"))
    seen = z_buffer(mesh, cameras, i, torch.device(device)).flatten().numpy()
    # A centre on the side of two faces is either's, and within rounding of the outline anybody's.
    assert ((met >= 0) != (seen >= 0)).mean() < 0.001
    assert (met != seen).mean() < 0.01
