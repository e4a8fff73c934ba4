"""What a run leaves behind: scores of its views, pictures to look at, tables. Every file is complete or absent."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.data.files import atomic_write
from torch_surfcap.data.geometry import export_mesh
from torch_surfcap.distance import SurfaceDistance
from torch_surfcap.fitting.color_gain import Equations, Exposure
from torch_surfcap.fitting.rays import WITHIN
from torch_surfcap.metrics import psnr, ssim
from torch_surfcap.surface.render import Hits, cast, colored, light, mesh_mask, raster, shaded

if TYPE_CHECKING:
    from torch_surfcap.field.field import SurfaceField

Path = str | os.PathLike[str]

CELL = 420  # largest height of a picture in a preview, pixels
DPI = 110  # of figures with letters
PICTURES = "pictures"  # folder, within a run's, of the files of render.py
SCORED = 8  # views scored during a fit; evaluate.py scores all
PREVIEWED = 4
COLUMNS = ("photograph", "volume", "raster", "geometry")
BEYOND = np.array([40, 170, 60, 255], dtype=np.uint8)  # green: farther from the truth than counts
ERROR_SCALE = 0.1  # of the cut: distance at the dark end of the error mesh's colours
ERRORS = "Reds"  # colour map of the errors, without any green


def some_views(count: int, most: int) -> list[int]:
    """At most `most` of `count` views, evenly spread."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, most)).round()}) if count else []


def scene_background(capture: Capture, i: int, background: float | Sequence[float] = 1.0) -> Tensor:
    """[H, W, 3]: what is behind the subject in view i where it is scored: the plate, else the constant colour."""
    if capture.plates is not None:
        return capture.plate(i)
    width, height = (int(s) for s in capture.cameras.size[i])
    return torch.as_tensor(background, dtype=torch.float32).expand(height, width, 3)


def scene_photograph(capture: Capture, i: int, background: float | Sequence[float] = 1.0) -> Tensor:
    """[H, W, 3]: the photograph that a rendering of view i is held against: as it is where a plate shows the room,
    else composited with its soft mask over the constant colour."""
    photograph = capture.photograph(i)
    if capture.plates is not None or capture.masks is None:
        return photograph
    mask = capture.masks[i][:, :, None]
    return mask * photograph + (1 - mask) * scene_background(capture, i, background)


def rendered(
    field: SurfaceField,
    mesh: trimesh.Trimesh,
    capture: Capture,
    i: int,
    background: float | Sequence[float] = 1.0,
    gains: bool = False,
) -> tuple[Tensor, Tensor, Hits]:
    """Volume and raster picture [H, W, 3] of view i, as its camera would have taken them, and what it sees of the mesh.

    gains: the field is in the exposure that all cameras were brought to; this camera's own one is fitted to its
    photograph (which is all that a held-out camera's exposure can be known by) and given to the pictures.
    """
    behind = scene_background(capture, i, background)
    hits = cast(mesh, capture.cameras, i, field.voxels.device)
    color, through = light(field, capture.cameras, i)
    onto = raster(field, mesh, capture.cameras, i, behind, hits)
    if gains:
        exposure = own_exposure(capture, i, color, through)
        color = exposure.own(0, color.view(-1, 3), 1 - through.flatten()).view(color.shape)
        at = torch.from_numpy(hits.pixel)
        onto.view(-1, 3)[at] = exposure.own(0, onto.view(-1, 3)[at], torch.ones(len(at)))
    return color + through[:, :, None] * behind, onto, hits


def own_exposure(capture: Capture, i: int, color: Tensor, through: Tensor) -> Exposure:
    """Gain and bias of view i by the field's part [H, W, 3] and transmittance [H, W] of its rays."""
    photograph, color, through = capture.photograph(i).view(-1, 3), color.view(-1, 3), through.flatten()
    if capture.plates is not None:
        return Equations.of(photograph, color, through, capture.plate(i).view(-1, 3)).solve(gauge=False)
    within = torch.ones_like(through, dtype=torch.bool)
    if capture.masks is not None:
        within = capture.masks[i].flatten() > WITHIN
    return Equations.of(photograph[within], color[within], through[within]).solve(gauge=False)


def score_view(
    field: SurfaceField,
    mesh: trimesh.Trimesh,
    capture: Capture,
    i: int,
    background: float | Sequence[float] = 1.0,
    gains: bool = False,
) -> dict[str, float]:
    """Scores of one view, in the photograph's own exposure (see `rendered`): psnr_volume, psnr_raster, ssim (volume) over
    the full frame; psnr_masked, psnr_raster_masked where the mask is over 0.5; silhouette_iou of the mesh against it."""
    truth = scene_photograph(capture, i, background)
    through, onto, hits = rendered(field, mesh, capture, i, background, gains)
    scores = {
        "psnr_volume": psnr(through, truth),
        "psnr_raster": psnr(onto, truth),
        "ssim": ssim(through, truth),
    }
    if capture.masks is not None:
        mask = capture.masks[i] > 0.5
        scores["psnr_masked"] = psnr(through, truth, mask)
        scores["psnr_raster_masked"] = psnr(onto, truth, mask)
        covered = mesh_mask(mesh, capture.cameras, i, hits) > 0.5
        scores["silhouette_iou"] = float((mask & covered).sum() / (mask | covered).sum().clamp(min=1))
    return scores


def score_views(
    field: SurfaceField,
    mesh: trimesh.Trimesh,
    capture: Capture,
    views: Iterable[int] | None = None,
    background: float | Sequence[float] = 1.0,
    gains: bool = False,
) -> dict[str, float]:
    """Means over views (all if None) of `score_view`, and their number as "views"."""
    each = [
        score_view(field, mesh, capture, i, background, gains)
        for i in (range(len(capture)) if views is None else views)
    ]
    return mean_scores(each)


def mean_scores(each: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean of every score over views (those where it is a number), and "views"."""
    means: dict[str, float] = {}
    for name in each[0] if each else ():
        values = [scores[name] for scores in each if not math.isnan(scores[name])]
        means[name] = float(np.mean(values)) if values else math.nan
    return {**means, "views": len(each)}


def write_preview(
    path: Path,
    field: SurfaceField,
    mesh: trimesh.Trimesh,
    capture: Capture,
    views: Sequence[int] | None = None,
    background: float | Sequence[float] = 1.0,
    gains: bool = False,
) -> None:
    """PNG with a row per view (a few spread ones if None): photograph, volume, raster, shaded geometry."""
    rows = []
    for i in some_views(len(capture), PREVIEWED) if views is None else views:
        through, onto, hits = rendered(field, mesh, capture, i, background, gains)
        pictures = [
            scene_photograph(capture, i, background),
            through,
            onto,
            shaded(mesh, capture.cameras, i, hits=hits),
        ]
        rows.append(np.concatenate([_cell(p) for p in pictures], axis=1))
    width = max(row.shape[1] for row in rows)
    head = np.full((24, rows[0].shape[1], 3), 255, dtype=np.uint8)
    for j, name in enumerate(COLUMNS):
        at = (6 + j * head.shape[1] // len(COLUMNS), 17)
        cv2.putText(head, name, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    padded = [
        np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=1)
        for r in [head / np.float32(255), *rows]
    ]
    write_picture(path, torch.from_numpy(np.concatenate(padded)))


def _cell(picture: Tensor) -> NDArray[np.float32]:
    """A picture [H, W, 3] made small enough for a preview."""
    height, width = picture.shape[:2]
    scale = min(1.0, CELL / height)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(picture.numpy(), size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def write_picture(path: Path, picture: Tensor) -> None:
    """8-bit PNG of [H, W, 3] in [0, 1] (clipped)."""
    encoded = cv2.imencode(".png", cv2.cvtColor(as_bytes(picture), cv2.COLOR_RGB2BGR))[1]
    with atomic_write(path) as partial:
        partial.write_bytes(encoded.tobytes())


def as_bytes(picture: Tensor) -> NDArray[np.uint8]:
    """8-bit [H, W, 3] of [0, 1] (clipped)."""
    return np.rint(picture.clamp(0, 1).numpy() * 255).astype(np.uint8)


def write_depth(path: Path, depth: Tensor, cameras: Cameras, i: int) -> None:
    """16-bit PNG of a depth [H, W] (world units, NaN: nothing there) seen by camera i, in units of the power of ten that
    the largest one needs; 0 is nothing. Beside it, as JSON, that unit and the camera: K, world_to_camera, size."""
    far = float(depth.nan_to_num(0.0).max())
    unit = 10.0 ** math.ceil(math.log10(far / 65535)) if far > 0 else 1.0
    pixels = np.rint(depth.nan_to_num(0.0).numpy().astype(np.float64) / unit).astype(np.uint16)
    camera = {"K": cameras.K[i], "world_to_camera": cameras.world_to_camera[i], "size": cameras.size[i]}
    with atomic_write(path) as partial:
        partial.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
    write_json(os.path.splitext(path)[0] + ".json", {"depth_unit": unit, **camera})


def write_mesh(path: Path, mesh: trimesh.Trimesh) -> None:
    """PLY, GLB, OBJ or what else the suffix says and trimesh writes, see `export_mesh`."""
    with atomic_write(path) as partial:
        export_mesh(partial, mesh)


def write_history(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """CSV with a line per iteration; columns in the order in which they first appear."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """JSON; what is no finite number becomes null, since JSON has no NaN."""
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(_plain(values), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """The value in types that JSON knows."""
    if isinstance(value, Mapping):
        return {str(name): _plain(entry) for name, entry in value.items()}
    if isinstance(value, Tensor | np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def errors_of(mesh: trimesh.Trimesh, truth: trimesh.Trimesh, cut: float) -> tuple[trimesh.Trimesh, float]:
    """The mesh coloured by its vertices' distances to the true surface (`error_mesh`), and the distance (world units) at
    the dark end of the colours; green beyond `cut`."""
    distance = SurfaceDistance(truth)(np.asarray(mesh.vertices), cut).distance
    top = ERROR_SCALE * cut
    return error_mesh(mesh, distance, top), top


def error_mesh(mesh: trimesh.Trimesh, distance: NDArray[np.float64], top: float) -> trimesh.Trimesh:
    """The mesh with its vertices' distances [V] to the truth as colours: white 0, dark red `top` and more (world
    units), green where infinite, which stands for beyond the cut."""
    import matplotlib  # half a second that a fit need not wait for

    shades = matplotlib.colormaps[ERRORS](
        np.clip(np.nan_to_num(distance, posinf=top) / top, 0, 1), bytes=True
    )
    colors = np.where(np.isfinite(distance)[:, None], shades, BEYOND)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)


def write_errors(
    path: Path, mesh: trimesh.Trimesh, cameras: Cameras, views: Sequence[int], top: float
) -> None:
    """PNG of a mesh of `error_mesh` from some cameras, with its scale."""
    write_error_pictures(path, [colored(mesh, cameras, i) for i in views], top, CELL)


def write_error_pictures(path: Path, pictures: Sequence[Tensor], top: float, height: int) -> None:
    """PNG of pictures [H, W, 3] of a mesh of `error_mesh` side by side, `height` pixels high, with their scale."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    shapes = [picture.shape[1] / picture.shape[0] for picture in pictures]
    inches = height / DPI
    figure = Figure(figsize=(sum(shapes) * inches + 1.2, inches), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(pictures), squeeze=False, width_ratios=shapes)[0]
    for axis, picture in zip(axes, pictures, strict=True):
        axis.imshow(picture.clamp(0, 1).numpy())
        axis.set_axis_off()
    scale = ScalarMappable(Normalize(0, top), ERRORS)
    figure.colorbar(
        scale, ax=list(axes), label="distance to the true surface (green: beyond the cut)", extend="max"
    )
    with atomic_write(path) as partial:
        figure.savefig(partial)
