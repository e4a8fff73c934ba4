"""train/chart.py: the front, powers, tables and pictures on made-up rows, the rivals' step, and a tiny chart end to end."""

from __future__ import annotations

import csv
import itertools
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.text import Text

from tests.fitting.stages import begun
from torch_surfcap import ops
from torch_surfcap.data.capture import load_capture
from torch_surfcap.data.checks import prepare
from torch_surfcap.data.sample_scene import make_sample_scene
from torch_surfcap.errors import InputError
from torch_surfcap.field.field import MISSING
from torch_surfcap.fitting.descent import RAY_ARGUMENTS
from torch_surfcap.fitting.plateau import Plateau
from torch_surfcap.fitting.settings import Descent
from torch_surfcap.studies import chart, chart_figures, chart_page
from torch_surfcap.studies import rows as processes
from torch_surfcap.studies.ablation import Row, read_table
from torch_surfcap.studies.chart import BEGIN, END, PRESETS, RIVALS, Mark, Published
from torch_surfcap.studies.chart_names import Spot, write_names
from torch_surfcap.studies.marked_page import renewed
from train import chart as command
from train import rivals

SECONDS = {
    "start": 2.0,
    "load": 1.0,
    "hull": 0.5,
    "fit": 10.0,
    "mesh": 1.0,
    "levels": [{"march": 3.0, "adam": 1.0}, {"prepare": 1.0, "march": 2.0, "gains": 2.5}],
}


def made_up(
    name: str, seconds: float, chamfer: float, group: str = PRESETS, title: str = PRESETS, **more: float
) -> Mark:
    scores = {"seconds": seconds, "chamfer": chamfer, "psnr_volume": 35 - 1000 * chamfer, "memory": 2.0**30}
    scores["psnr_masked"] = scores["psnr_volume"] - 5
    return Mark("ball", group, title, name, "x=1", scores | more, chart.breakdown(SECONDS))


def some_marks() -> list[Mark]:
    """Presets of which one is beaten, a sweep of image sizes with time as its square, a rival, a row to come."""
    marks = [made_up("draft", 4, 0.003), made_up("standard", 16, 0.001), made_up("fine", 64, 0.002)]
    for edge in (64.0, 128.0, 256.0):
        sizes = {"edge": edge, "fit_seconds": edge**2 / 1000, "views": 8.0, "per_voxel": edge}
        marks.append(made_up(f"{edge:g}", 1 + edge**2 / 1000, 1 / edge**1.5, "scale", "Image size", **sizes))
    marks.append(made_up("hull", 1, 0.0001, RIVALS, RIVALS))
    return [*marks, Mark("ball", "scale", "Image size", "later", "x=2", {}, {}, chart.LEFT)]


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([], []),
        ([(1, 1), (1, 1)], [0]),
        ([(1, 2), (1, 1), (2, 1)], [1]),
        ([(math.nan, 0), (5, 5), (1, math.nan)], [1]),
        ([(4, 1), (3, 2), (2, 3), (1, 4), (3.5, 2.5)], [3, 2, 1, 0]),
    ],
)
def test_front(points: list[tuple[float, float]], expected: list[int]) -> None:
    assert chart.front(points) == expected


def test_fronts_leave_rivals_and_what_is_to_come_out() -> None:
    marks = some_marks()
    names = {marks[i].name for i in chart.on_fronts(marks)}
    assert {"draft", "standard"} <= names
    assert names.isdisjoint({"hull", "later", "fine"})


def test_exponents() -> None:
    power, factor = chart.exponent([1, 3, 9], [2.0, 2 * 3**1.5, 2 * 9**1.5]) or (0.0, 0.0)
    assert power == pytest.approx(1.5)
    assert factor == pytest.approx(2)
    assert chart.exponent([2, 2], [1, 3]) is None
    assert chart.exponent([], []) is None
    x, y = chart.growth(some_marks(), "scale", "fit_seconds")
    assert (x, y) == ([64, 128, 256], [edge**2 / 1000 for edge in x])
    assert "+2.00" in chart.growth_table(some_marks())


def test_where_the_time_goes() -> None:
    work = chart.breakdown(SECONDS)
    assert list(work) == ["before", "level 1", "level 2", "after"]
    assert work["level 2"]["rest"] == pytest.approx(0.5)  # 10 s of the fit, 9.5 of them in the levels' kinds
    assert sum(chart.shares(work).values()) == pytest.approx(1)
    line = chart.work_table([made_up("draft", 4, 0.003)]).splitlines()[2]
    assert "| **17 %** |" in line  # gains
    assert "| 34 % |" in line  # the march is not bold


def test_tables_and_csv() -> None:
    text = chart_page.score_tables(some_marks(), {"ball": 1000})
    assert "| standard † | `x=1` | 1.000 |" in text
    assert "| later | `x=2`: still to be run |" in text
    line = chart.csv_lines(some_marks())[1]
    assert (line["seconds"], line["level 2: gains"], line["group"]) == (16, 2.5, PRESETS)


def test_page_is_renewed_between_its_markers() -> None:
    page = renewed("# Title\n\nWords.\n", "one", (BEGIN, END))
    assert page.startswith("# Title\n\nWords.\n\n" + BEGIN)
    again = renewed(page + "After.\n", "two", (BEGIN, END))
    assert again == page.replace("one", "two") + "After.\n"
    assert again.count(BEGIN) == again.count(END) == 1


def test_published(tmp_path: Path) -> None:
    """The shipped file has a source for every figure; a wrong one is named."""
    figures = chart.read_published(command.PUBLISHED)
    assert all(figure.source and figure.data and figure.hardware for figure in figures)
    assert any(math.isfinite(figure.chamfer_mm * figure.seconds) for figure in figures)
    wrong = tmp_path / "wrong.csv"
    wrong.write_text(",".join(Published._fields) + "\na,b,far,,,,,,c\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"wrong\.csv, line 2: .*far"):
        chart.read_published(wrong)


def test_pictures(tmp_path: Path) -> None:
    units = {"ball": 1000.0}
    figures = chart.read_published(command.PUBLISHED)
    files = [
        *chart_figures.write_accuracy(tmp_path / "accuracy", some_marks(), figures, units),
        *chart_figures.write_growth(tmp_path / "growth", some_marks(), units),
        *chart_figures.write_work(tmp_path / "work", some_marks()),
    ]
    assert sorted(file.name for file in files) == sorted(
        f"{name}.{suffix}" for name in ("accuracy", "growth", "work") for suffix in ("png", "svg")
    )
    assert all(file.stat().st_size > 2000 for file in files)
    drawn = (tmp_path / "accuracy.svg").read_text(encoding="utf-8")
    for words in ("standard", "published, other hardware", "Pareto front", "rivals", "ProbeSDF", "1 GiB"):
        assert words in drawn
    assert "power +2.00" in (tmp_path / "growth.svg").read_text(encoding="utf-8")
    assert "voxel" not in (tmp_path / "work.svg").read_text(encoding="utf-8")  # takes no time here


def test_names_find_room() -> None:
    """In a crowd all that are needed are written, the others only where they cover nothing; those far away have a line."""
    random = np.random.default_rng(0)
    figure, panels = chart_figures._figure(1, 1)
    axes = panels[0, 0]
    axes.plot([0, 1], [0.5, 0.5])
    crowd = [(*random.uniform(0.2, 0.8, 2), i < 6) for i in range(40)]
    spots = [Spot(x, y, 30.0, f"number {i}", "k", 8.0, needed) for i, (x, y, needed) in enumerate(crowd)]
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    write_names(axes, spots)
    names = [text.get_text() for text in axes.texts]
    assert names[:6] == [spot.text for spot in spots[:6]]
    assert 6 < len(names) < 40
    boxes = [Text.get_window_extent(text, figure.canvas.get_renderer()) for text in axes.texts]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    marks = axes.transData.transform([(spot.x, spot.y) for spot in spots])
    assert not any(box.contains(*at) for box in boxes for at in marks)
    assert {text.arrow_patch.get_visible() for text in axes.texts} == {True, False}


def test_presets_and_sweep_are_sound(tmp_path: Path) -> None:
    options = command._options(["--out", str(tmp_path)])
    table = read_table(command.SWEEP)
    rows = command.planned(table, {"matte": tmp_path}, options)
    assert [row.name for row, group in rows if group == PRESETS] == ["draft", "standard", "fine"]
    assert {group for _, group in rows} == {PRESETS, *table.groups}
    assert not [row.error for row, _ in rows if row.error]
    standard = next(row for row, _ in rows if row.name == "standard")
    same = [row.name for row, group in rows if row.key == standard.key and group != PRESETS]
    assert {"B = 0", "1 pixel", "32 bits", "exact", "all cameras", "whole"} <= {*same}
    assert {row.scored for row, _ in rows} == {("--scale=1",)}


def test_patience() -> None:
    assert Plateau.of(60, Descent()) == Plateau(limit=60)
    loose = Plateau.of(60, Descent(fall=0.04, drops=1))
    assert (loose.gain, loose.share, loose.drops) == pytest.approx((0.04, 0.06, 1))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sample_scene(tmp_path_factory.mktemp("chart") / "figure", views=8, test_views=2, size=64)


@pytest.mark.parametrize("opacity", ["distance", "transparency"])
def test_step_of_the_rival(scene: Path, opacity: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch operators and autograd give what the compiled step gives, in one part and in many."""
    stage, _, settings = begun(prepare(load_capture(scene)), 0.06, 5, opacity=opacity, sh_degree=1)
    g = torch.Generator().manual_seed(0)
    # Where a distance has no noise it is constant deep inside: a kink of the transparency, of which either side is right.
    stage.store[..., 0] += 0.02 * torch.randn(stage.store.shape[:-1], generator=g)
    stage.store[..., 0].clamp_(*sorted(MISSING[opacity]))
    rays = stage.rays
    rays.find_ranges(stage.store, stage.grid, opacity, stage.march)
    arguments: dict[str, Any] = {
        "voxels": stage.store,
        "table": stage.grid.table,
        "frame": stage.grid.frame(*MISSING[opacity]),
        **{name: getattr(rays, name) for name in RAY_ARGUMENTS},
        **stage.march._asdict(),
        "shift": torch.rand(len(rays), generator=g) - 0.5,
        "huber": settings.losses.huber,
        "weights": [1.0, 0.3, 0.1],
        "ranges": rays.ranges,
    }
    losses, gradient, *seen = ops.photometric_step(**arguments)
    for samples in (rivals.SAMPLES, 1000):
        monkeypatch.setattr(rivals, "SAMPLES", samples)
        own_losses, own_gradient, *own_seen = rivals.photometric_step(**arguments)
        torch.testing.assert_close(own_losses, losses, rtol=1e-5, atol=1e-6)
        assert float((own_gradient - gradient).norm() / gradient.norm()) < 1e-2
        for actual, expected in zip(own_seen, seen, strict=True):
            torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-3, equal_nan=True)


def test_no_second_step_begins_when_the_seconds_are_spent() -> None:
    compiled = ops.photometric_step
    with rivals.plain_torch(time.time() - 1):
        rule = Plateau(limit=9)
        assert not rule.ended
        assert not rule.goes_on(1.0)
        swapped: Any = ops.photometric_step
        assert swapped is rivals.photometric_step
    assert not Plateau(limit=9).ended
    assert ops.photometric_step is compiled


def test_a_tiny_chart(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Presets, a row of a sweep and both rivals, on one level; then again, without running any of them."""
    sweep, page = tmp_path / "sweep.yaml", tmp_path / "docs" / "speed.md"
    sweep.write_text(
        "scenes: {figure: {millimetres: 1000}}\n"
        "groups: {scale: {title: Image size, rows: {half: data.scale=0.5, whole: data.scale=1}}}\n"
    )
    arguments = [f"--out={tmp_path / 'out'}", f"--scene={scene}", f"--sweep={sweep}", f"--page={page}"]
    arguments += ["--presets=standard", "levels=1", "floor=off", "device=cpu"]
    assert command.main([*arguments, "--minutes=0"]) == 0
    assert "0 rows are\ndone, 0 failed, 3 are still to be run" in page.read_text(encoding="utf-8")
    assert command.main(arguments) == 0
    with (tmp_path / "out" / "chart.csv").open(encoding="utf-8") as file:
        lines = {line["name"]: line for line in csv.DictReader(file)}
    assert list(lines) == ["standard", "half", "whole", "soft hull alone", "torch autograd"]
    assert {float(line["seconds"]) > 0 for line in lines.values()} == {True}
    stopped = float(lines.pop("torch autograd")["chamfer"])  # by the clock, how far it came is the machine's
    assert 0 < stopped <= 0.05
    assert {float(line["chamfer"]) < 0.05 for line in lines.values()} == {True}
    assert lines["soft hull alone"]["psnr_masked"] == ""
    assert float(lines["half"]["edge"]) == 32
    assert float(lines["standard"]["level 1: march"]) > 0
    assert {name.partition(": ")[2] for name in lines["standard"] if ": " in name} <= {*chart.WORK}
    text = page.read_text(encoding="utf-8")
    assert "python train/chart.py --scene figure=DATA/figure" in text
    assert str(tmp_path) not in text
    for name in ("accuracy.png", "growth.svg", "work.png", "chart.csv"):
        assert (page.with_suffix("") / name).is_file()

    def never(row: Row, *_: object) -> dict[str, Any]:
        raise AssertionError(f"{row.name} was run again")

    monkeypatch.setattr(processes, "run_row", never)
    assert command.main(arguments) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--groups=colours"], "--groups: found colours, expected some of degree, voxel"),
        (["--scene=nowhere"], "--scene: found nowhere, expected [NAME=]FOLDER of a capture"),
        (["--presets=finest"], "finest.yaml: cannot read this config file"),
        (["--published=nowhere.csv"], "nowhere.csv: cannot read this file"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [f"--out={tmp_path}", *([] if "--scene" in arguments[0] else [f"--scene={tmp_path}"]), *arguments]
    assert command.main(given) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
