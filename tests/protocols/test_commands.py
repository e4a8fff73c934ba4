"""train/evaluate.py by the protocols of NeRF-synthetic and DTU, on copies of their layouts made from one ball."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from tests.data.rigs import write_picture
from tests.protocols import layouts
from torch_surfcap.run import FILES
from torch_surfcap.surface.render import volume
from train import evaluate

COST = {"seconds": {"total": 30.0}, "peak_memory_bytes": 2**30}


def results(run: Path) -> Any:
    return json.loads((run / "evaluation.json").read_text())


def command(*arguments: str | Path) -> int:
    return evaluate.main([str(a) for a in arguments])


def read_rgba(path: Path) -> layouts.Array:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA)


@pytest.fixture(scope="module")
def nerf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes with their runs, which held out other views and were fitted at half size; drums is lit too dimly."""
    base = tmp_path_factory.mktemp("nerf")
    field, mesh = layouts.ball()
    for scene, seconds in (("chair", 30.0), ("drums", 50.0)):
        data = layouts.write_nerf_scene(base / "data" / scene, field)
        changes = (f"data.path={data}", "data.scale=0.5", "data.holdout=2")
        cost: dict[str, Any] = {"seconds": {"total": seconds}, "peak_memory_bytes": 2**30}
        layouts.write_run(base / "out" / scene, field, mesh, *changes, **cost)
    for picture in (base / "data" / "drums" / "test").glob("r_?.png"):
        rgba = read_rgba(picture)
        rgba[..., :3] //= 2
        write_picture(picture, rgba)
    return base


def white_psnr(data: Path) -> float:
    """Mean over the test split at full size of the PSNR of the ball's rendering over white, worked out anew."""
    field, _ = layouts.ball()
    seen_by, each = layouts.cameras(3, 0.3), []
    for i in range(len(seen_by)):
        rgba = read_rgba(data / "test" / f"r_{i}.png") / 255.0
        alpha = rgba[..., 3:]
        error = alpha * rgba[..., :3] + 1 - alpha - volume(field, seen_by, i, 1.0).clamp(0, 1).numpy()
        each.append(-10 * math.log10((error**2).mean()))
    return float(np.mean(each))


def test_nerf_table_of_two_scenes(nerf: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [nerf / "out" / scene for scene in ("chair", "drums")]
    assert command("--run", *runs, "--protocol", "nerf", "--table", tmp_path / "nerf.md") == 0
    table = json.loads((tmp_path / "nerf.json").read_text())
    chair, drums = table["scenes"]
    assert [row["scene"] for row in table["scenes"]] == ["chair", "drums"]
    for row, run in zip(table["scenes"], runs, strict=True):
        test = results(run)["test"]
        assert test["views"] == 3
        assert list(test["each"]) == ["test/r_0", "test/r_1", "test/r_2"]
        assert row["psnr_volume"] == test["psnr_volume"]
        assert row["psnr_volume"] == pytest.approx(white_psnr(nerf / "data" / row["scene"]), abs=1e-3)
    assert chair["psnr_volume"] > 50 > 25 > drums["psnr_volume"]
    mean = table["mean"]
    for key in ("psnr_volume", "psnr_raster", "ssim"):
        assert mean[key] == pytest.approx(0.5 * (chair[key] + drums[key]))
    assert (mean["seconds"], mean["peak_memory_bytes"]) == (40.0, 2**30)
    markdown = (tmp_path / "nerf.md").read_text()
    lines = markdown.splitlines()
    assert [line.split("|")[1].strip(" -") for line in lines] == ["scene", ":", "chair", "drums", "mean"]
    cells = [cell.strip() for cell in lines[-1].split("|")]
    assert cells[2:-1] == [
        f"{mean['psnr_volume']:.2f}",
        f"{mean['psnr_raster']:.2f}",
        f"{mean['ssim']:.3f}",
        "40.0",
        "1.00",
        str(chair["triangles"]),
    ]
    assert capsys.readouterr().out.endswith(markdown)


def test_nerf_without_metrics_shows_none(
    nerf: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    for name in FILES:
        (run / name).write_bytes((nerf / "out" / "chair" / name).read_bytes())
    assert command("--run", run, "--protocol", "nerf", "--table", tmp_path / "nerf.md") == 0
    assert json.loads((tmp_path / "nerf.json").read_text())["mean"]["seconds"] is None
    last = [cell.strip() for cell in capsys.readouterr().out.splitlines()[-1].split("|")]
    assert last[5:7] == ["–", "–"]


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scan 65: the scanner found the ball of 10 mm to be one of 9 mm, saw its upper part only, and the ground, a plane
    through its middle, hides the lower part. One view of six is held out."""
    base = tmp_path_factory.mktemp("dtu")
    field, mesh = layouts.ball()
    layouts.write_dtu_scene(base / "data" / "scan65", field)
    box = np.stack([layouts.CENTER - 40, layouts.CENTER + 40])
    observed = np.zeros((81, 81, 81), dtype=bool)
    observed[:, :, 43:] = True  # from 2.5 mm above the centre on
    plane = np.array([0.0, 0.0, 1.0, -layouts.CENTER[2]])
    truth = layouts.sphere_points(layouts.RADIUS - 1)
    layouts.write_dtu_truth(base / "truth", 65, truth, observed, box, 1.0, plane)
    mesh.vertices[mesh.vertices[:, 2] < layouts.CENTER[2] - 2, 2] -= (
        3.0  # what is not observed does not count
    )
    stud = trimesh.creation.icosphere(3, 2.0)  # 4 mm outside the ball's silhouettes and seen by the scanner
    stud.apply_translation(layouts.CENTER + np.array([0, 0, layouts.RADIUS + 6]))
    changes = (f"data.path={base / 'data' / 'scan65'}", "data.holdout=6", "data.scale=0.5")
    layouts.write_run(base / "out", field, mesh, *changes, **COST)
    layouts.write_run(base / "studded", field, mesh + stud, *changes, **COST)
    return base


def dtu(base: Path, run: str, *more: str) -> Any:
    truth = ("--dtu-truth", base / "truth", "--scan", "65")
    assert command("--run", base / run, "--protocol", "dtu", *truth, *more) == 0
    return results(base / run)


def test_dtu_scores_surface_and_masked_pictures(scan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = dtu(scan, "out")
    surface = found["surface"]
    assert surface["accuracy"] == pytest.approx(1.0, abs=0.03)
    assert surface["completeness"] == pytest.approx(1.0, abs=0.03)
    assert surface["overall"] == 0.5 * (surface["accuracy"] + surface["completeness"])
    assert surface["cuts"] == {"scan": 65, "spacing": 0.2, "margin": 60.0, "farthest": 20.0, "cull": "none"}
    assert (found["train"]["views"], found["test"]["views"]) == (5, 1)
    assert found["train"]["psnr_masked"] > 50  # all but the rounding to 8 bit
    last = [cell.strip() for cell in capsys.readouterr().out.splitlines()[-1].split("|")]
    assert last[1:5] == ["mean", *(f"{surface[k]:.3f}" for k in ("accuracy", "completeness", "overall"))]
    assert last[5] == f"{found['train']['psnr_masked']:.2f}"


def test_dtu_culls_by_masks_when_asked(scan: Path) -> None:
    """Of the ball 2π·10·7.5 mm² are observed, 1 mm from the truth; the stud has 4π·2² mm², 7 mm from it in the mean."""
    accuracy = (471 * 1 + 50 * 7) / (471 + 50)
    assert dtu(scan, "studded")["surface"]["accuracy"] == pytest.approx(accuracy, rel=0.1)
    culled = dtu(scan, "studded", "--cull", "masks", "--dilation", "1")["surface"]
    assert culled["accuracy"] == pytest.approx(1.0, abs=0.03)
    assert (culled["cuts"]["cull"], culled["cuts"]["dilation"]) == ("masks", 1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--protocol", "dtu"], "None and 0 scans for 1 runs"),
        (["--protocol", "dtu", "--dtu-truth", "{base}/truth", "--scan", "65", "66"], "2 scans for 1 runs"),
        (["--protocol", "dtu", "--dtu-truth", "{base}/truth", "--scan", "66"], "ObsMask66_10.mat"),
        (
            ["--protocol", "dtu", "--dtu-truth", "x", "--scan", "1", "--mesh-truth", "gt.ply"],
            "a second truth",
        ),
        (["--scan", "65"], "expected --protocol dtu"),
        (["--cull", "masks"], "expected --protocol dtu"),
        (["--protocol", "nerf"], "no transforms_test.json"),
        (["--table", "scores.json"], "a name in .md"),
    ],
)
def test_options_that_do_not_go_together(
    scan: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("--run", scan / "out", *[a.format(base=scan) for a in arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_unfinished_second_run_is_named_before_the_first_is_scored(
    nerf: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("--run", nerf / "out" / "chair", tmp_path, "--protocol", "nerf") == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(str(tmp_path / "config.yaml"))
    assert not printed.out
