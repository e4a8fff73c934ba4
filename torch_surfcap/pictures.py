"""The kinds of pictures that a finished run can be seen in, from any camera, over white."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
import trimesh
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.field.field import SurfaceField
from torch_surfcap.surface.render import (
    cast,
    colored,
    constant_part,
    mesh_depth,
    mesh_normals,
    raster,
    shaded,
    view_dependent_part,
    volume,
)

WHITE = 1.0
KINDS = {
    "volume": "the integral of the field along each ray",
    "raster": "the field's colour at the mesh",
    "shaded": "grey geometry under a lamp at the camera",
    "normals": "red right, green up, blue towards the camera",
    "depth": "near red to far blue",
    "constant": "the constant colour β_00 alone, at the mesh",
    "view_dependent": "the view-dependent colour alone, around mid grey, at the mesh",
    "constant_volume": "the constant colour alone, along rays",
    "view_dependent_volume": "the view-dependent colour alone, along rays",
    "error": "the mesh coloured by its distance to the true surface, green beyond the cut",
}


@dataclass
class Subject:
    """What is shown: a field, its mesh and, for the kind "error", the mesh in the colours of `report.error_mesh`."""

    field: SurfaceField
    mesh: trimesh.Trimesh
    errors: trimesh.Trimesh | None = None

    @cached_property
    def constant(self) -> SurfaceField:
        return constant_part(self.field)

    @cached_property
    def view_dependent(self) -> SurfaceField:
        return view_dependent_part(self.field)

    def depth_range(self, cameras: Cameras) -> tuple[float, float]:
        """Least and greatest depth of the mesh's vertices in any of the cameras, world units."""
        vertices = torch.from_numpy(np.asarray(self.mesh.vertices, dtype=np.float64))
        depths = [vertices @ pose[2, :3] + pose[2, 3] for pose in cameras.world_to_camera]
        return min(float(d.min()) for d in depths), max(float(d.max()) for d in depths)

    def pictures(
        self, kinds: list[str], cameras: Cameras, i: int, depths: tuple[float, float], samples: int = 1
    ) -> dict[str, Tensor]:
        """Pictures [H, W, 3] of some `KINDS` in camera i.

        depths: the depths at the two ends of the colours (`depth_range`). samples: so many rays by so many per pixel
        against jagged outlines, where a ray is asked for the mesh.
        """
        fine = cameras.subset([i])
        fine = fine.resized(torch.full((1, 2), float(samples)), fine.size * samples)
        device = self.field.voxels.device
        hits = None if all(kind.endswith("volume") for kind in kinds) else cast(self.mesh, fine, 0, device)
        shown: dict[str, Tensor] = {}
        for kind in kinds:
            match kind:
                case "volume":
                    picture = volume(self.field, cameras, i, WHITE)
                case "constant_volume":
                    picture = volume(self.constant, cameras, i, WHITE)
                case "view_dependent_volume":
                    picture = volume(self.view_dependent, cameras, i, WHITE)
                case "raster":
                    picture = raster(self.field, self.mesh, fine, 0, WHITE, hits)
                case "constant":
                    picture = raster(self.constant, self.mesh, fine, 0, WHITE, hits)
                case "view_dependent":
                    picture = raster(self.view_dependent, self.mesh, fine, 0, WHITE, hits)
                case "shaded":
                    picture = shaded(self.mesh, fine, 0, WHITE, hits)
                case "normals":
                    picture = mesh_normals(self.mesh, fine, 0, WHITE, hits)
                case "depth":
                    picture = depth_colors(mesh_depth(self.mesh, fine, 0, hits), *depths)
                case "error" if self.errors is not None:
                    picture = colored(self.errors, fine, 0, WHITE, hits)
                case _:
                    raise ValueError(f"picture of kind {kind!r}: expected one of {', '.join(KINDS)}")
            shown[kind] = pooled(picture.clamp(0, 1), picture.shape[0] // int(cameras.size[i, 1]))
        return shown


def depth_colors(depth: Tensor, near: float, far: float) -> Tensor:
    """[H, W, 3]: a depth [H, W] from red (near) over green to blue (far), white where it is NaN."""
    nearness = ((far - depth) / max(far - near, 1e-12)).clamp(0, 1).nan_to_num(0.0)
    levels = (255 * nearness).round().byte().numpy()
    colors = torch.from_numpy(cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB))
    return torch.where(depth.isnan()[:, :, None], torch.tensor(WHITE), colors / 255)


def pooled(picture: Tensor, samples: int) -> Tensor:
    """[H, W, 3]: means over squares of samples x samples pixels."""
    return avg_pool2d(picture.permute(2, 0, 1), samples).permute(1, 2, 0).contiguous()
