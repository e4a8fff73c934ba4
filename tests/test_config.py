"""The settings of the commands."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from torch_surfcap import config
from torch_surfcap.config import Config
from torch_surfcap.errors import InputError
from torch_surfcap.fitting.settings import Descent, FitSettings, Losses

CONFIGS = sorted((Path(__file__).parents[1] / "configs").glob("*.yaml"))


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_no_file_means_defaults() -> None:
    assert config.load() == Config()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_shipped_configs_load(path: Path) -> None:
    config.load(path)


def test_default_config_changes_nothing() -> None:
    assert config.load(CONFIGS[0].with_name("default.yaml")) == Config()


def test_arguments_come_after_the_file(tmp_path: Path) -> None:
    path = written(tmp_path / "a.yaml", "seed: 3\nlosses: {mask: 0.5, sample: 2}\n")
    loaded = config.load(
        path, ["losses.mask=0.25", "data.path=a b/c", "cameras.skip=[7, cam_2]", "data.box=[0,0,0,1,2,3]"]
    )
    assert (loaded.seed, loaded.losses.sample, loaded.losses.mask) == (3, 2.0, 0.25)
    assert loaded.data.path == "a b/c"
    assert loaded.cameras.skip == ["7", "cam_2"]
    assert loaded.data.box == [0, 0, 0, 1, 2, 3]


def test_exponents_without_a_point_are_numbers(tmp_path: Path) -> None:
    path = written(tmp_path / "a.yaml", "losses: {huber: 1e-3}\nvoxel: 2e-3\n")
    loaded = config.load(path, ["losses.tv_color=5e-4"])
    assert (loaded.losses.huber, loaded.voxel, loaded.losses.tv_color) == (1e-3, 2e-3, 5e-4)


def test_auto_is_none() -> None:
    assert config.load(None, ["voxel=2", "voxel=auto"]).voxel is None
    assert config.load(None, ["sh_degree=2"]).sh_degree == 2
    assert config.load(None, ["device=auto"]).device == "auto"
    assert config.load(None, ["images=auto"]).images == "auto"


@pytest.mark.parametrize("word", ["auto", "cpu", "cuda", "cuda:0", "cuda:12"])
def test_devices(word: str) -> None:
    """As words, whether they can be used here or not."""
    assert config.load(None, [f"device={word}"]).device == word


def test_saved_config_loads_again(tmp_path: Path) -> None:
    chosen = config.load(None, ["voxel=0.004", "cameras.skip=[a]", "data.path=x", "mesh.smooth=3"])
    config.save(chosen, tmp_path / "deep" / "config.yaml")
    assert config.load(tmp_path / "deep" / "config.yaml") == chosen
    assert "levels: auto" in (tmp_path / "deep" / "config.yaml").read_text()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("losses.hubr=1", "unknown key losses.hubr, nearest known key: losses.huber"),
        ("huber=1", "unknown key huber, nearest known key: losses.huber"),
        ("voxl=1", "nearest known key: voxel"),
        ("data.path.x=1", "nearest known key: data.path"),
        ("losses=3", "losses is 3, expected keys such as losses."),
        ("voxel=abc", "voxel is 'abc'"),
        ("voxel=0", "voxel is 0.0, expected a number from"),
        ("voxel=nan", "voxel is nan, expected a number from"),
        ("seed=1.5", "seed is 1.5"),
        ("data.masks=maybe", "data.masks is 'maybe'"),
        ("device=gpu", "device is 'gpu', expected one of auto, cpu, cuda"),
        ("sh_degree=3", "sh_degree is 3, expected one of 0, 1, 2"),
        ("data.scale=2", "data.scale is 2.0, expected a number from 0.001 to 1.0"),
        ("data.box=[1, 2]", "data.box is [1.0, 2.0], expected [x0, y0, z0, x1, y1, z1]"),
        ("data.box=[1, 0, 0, 0, 1, 1]", "expected [x0, y0, z0, x1, y1, z1] with x0 < x1"),
        ("voxel", "voxel: expected key=value"),
        ("voxel=[", "voxel=[: not YAML"),
        ("out=${nothing}", "nothing"),
    ],
)
def test_wrong_argument_is_one_clear_line(override: str, message: str) -> None:
    with pytest.raises(InputError) as raised:
        config.load(None, [override])
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("losses: {hubr: 1}\n", "unknown key losses.hubr"),
        ("- a\n", "found a list"),
        ("a: [\n", "not a YAML file"),
        ("seed: 1\nseed: 2\n", "not a YAML file"),
        ("plain text", "unknown key plain text"),
    ],
)
def test_wrong_file_is_named(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path / "wrong.yaml", text)
    with pytest.raises(InputError, match=r"wrong\.yaml: ") as raised:
        config.load(path)
    assert message in str(raised.value)


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.yaml: cannot read this config file"):
        config.load(tmp_path / "nowhere.yaml")


def test_defaults_are_the_librarys() -> None:
    assert FitSettings.of(**config.fit_arguments(Config())) == FitSettings.of()
    changed = config.load(
        None, ["opacity=transparency", "losses.mask=0.5", "descent.stop=1e-4", "data.box=[0,0,0,1,1,1]"]
    )
    expected = {"losses": {"mask": 0.5}, "descent": {"stop": 1e-4}, "box": (0, 0, 0, 1, 1, 1)}
    assert FitSettings.of(**config.fit_arguments(changed)) == FitSettings.of(
        opacity="transparency", **expected
    )


def test_resolved_config_holds_the_defaults_that_are_used() -> None:
    given = config.load(None, ["opacity=transparency", "losses.mask=0.5"])
    full = config.resolved(given)
    assert full.losses.mask == 0.5
    assert None not in [*vars(full.losses).values(), *vars(full.descent).values(), full.mesh.smooth]
    assert (full.voxel, full.levels, full.sh_degree) == (None, None, None)  # by the capture
    assert FitSettings.of(**config.fit_arguments(full)) == FitSettings.of(**config.fit_arguments(given))
    assert config.resolved(full) == full


def test_differences() -> None:
    one, other = config.load(None, ["seed=1", "losses.mask=2"]), config.load(None, ["losses.mask=3"])
    assert config.differences(one, other) == {"seed": (1, 0), "losses.mask": (2.0, 3.0)}
    assert config.differences(one, one) == {}


@pytest.mark.parametrize("threshold", ["-5", "4", "9"])
def test_threshold_beyond_the_values(threshold: str) -> None:
    with pytest.raises(InputError, match=r"mesh\.threshold is .*, expected more than -4 and less than 4"):
        config.resolved(config.load(None, [f"mesh.threshold={threshold}"]))
    with pytest.raises(InputError, match="for opacity=transparency"):
        config.resolved(config.load(None, ["mesh.threshold=1.5", "opacity=transparency"]))


def test_on_and_off_are_words() -> None:
    """Though YAML takes them for true and false."""
    assert [config.load(None, [f"gains={word}"]).gains for word in ("on", "off", "auto")] == [
        "on",
        "off",
        "auto",
    ]


def test_losses_and_descent_mirror_the_library() -> None:
    for mine, theirs in ((config.LossesConfig, Losses), (config.DescentConfig, Descent)):
        assert [f.name for f in fields(mine)] == [f.name for f in fields(theirs)]


def test_every_key_has_a_meaning() -> None:
    """Each field of the dataclasses is explained on its own line, but for those whose name says it."""
    source = Path(config.__file__).read_text(encoding="utf-8")
    plain = {"device", "seed"}
    for key in config.key_names():
        name = key.rpartition(".")[2]
        if name not in plain:
            assert any(line.startswith(f"    {name}: ") and "  # " in line for line in source.splitlines()), (
                key
            )
