"""The rows of an ablation: which there are, what they are fitted with, and when two are the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from torch_surfcap.errors import InputError
from torch_surfcap.studies import ablation
from torch_surfcap.studies.ablation import Group, Scene, Table, plan, read_table
from train.ablate import TABLE

TERMS = Group("Terms", {"no mask loss": "losses.mask=0", "B = 1": "sh_degree=1"})
APART = Group("Sizes", {"half": "data.scale=0.5"}, ["distance"], ["ball"], ["seconds"])
SCENES = {"ball": Scene("data.scale=0.25")}


def table(**groups: Group) -> Table:
    return Table("sh_degree=1", SCENES, groups)


def test_rows_and_their_order(tmp_path: Path) -> None:
    rows = plan(table(terms=TERMS, apart=APART), {"ball": tmp_path, "other": tmp_path}, ["terms", "apart"])
    both = [(o, n) for o in ("distance", "transparency") for n in ("baseline", "no mask loss", "B = 1")]
    expected = [*(("ball", *row) for row in both), *(("other", *row) for row in both)]
    expected.insert(3, ("ball", "distance", "half"))
    assert [(row.scene, row.opacity, row.name) for row in rows] == expected


def test_later_settings_win(tmp_path: Path) -> None:
    """Scene, baseline, opacity, what is given for all, what the row changes."""
    _, mask, _, half, *_ = plan(
        table(terms=TERMS, apart=APART), {"ball": tmp_path}, ["terms", "apart"], ["data.scale=0.1"]
    )
    common = (f"data.path={tmp_path}", "data.scale=0.25", "sh_degree=1", "opacity=distance", "data.scale=0.1")
    assert mask.arguments == (*common, "losses.mask=0")
    assert half.arguments == (*common, "data.scale=0.5")


def test_the_same_settings_have_the_same_key(tmp_path: Path) -> None:
    rows = plan(table(terms=TERMS), {"ball": tmp_path}, ["terms"])
    baseline, mask, same = rows[:3]
    assert baseline.key == same.key
    assert len({row.key for row in rows}) == 4
    again = plan(table(terms=TERMS), {"ball": tmp_path}, ["terms"], ["losses.mask=0"])
    assert again[0].key == mask.key


def test_another_program_is_another_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "package"
    for name in ("deep", "studies"):
        (folder / name).mkdir(parents=True)
    (folder / "deep" / "a.py").write_text("x = 1\n")
    monkeypatch.setattr(ablation, "PACKAGE", folder)
    keys = []
    for name in ("deep/a.py", "_C.abi3.so", "studies/score_table.py"):
        (folder / name).write_text("x = 2\n")
        keys.append(plan(table(terms=TERMS), {"ball": tmp_path}, ["terms"])[0].key)
    assert keys[0] != keys[1] == keys[2]


def test_unknown_settings_are_the_rows_error(tmp_path: Path) -> None:
    group = Group("Typo", {"typo": "losses.maks=0", "mask": "losses.mask=0"}, ["distance"])
    baseline, typo, mask = plan(table(group=group), {"ball": tmp_path}, ["group"])
    assert (typo.key, typo.error) == (
        None,
        "losses.maks=0: unknown key losses.maks, nearest known key: losses.mask",
    )
    assert baseline.key != mask.key
    assert not mask.error


def test_the_shipped_table(tmp_path: Path) -> None:
    """Each group has a title and rows that differ; the baselines are sound settings."""
    shipped = read_table(TABLE)
    rows = plan(shipped, {"human_a": tmp_path}, list(shipped.groups))
    for group in shipped.groups.values():
        assert group.title
        assert len(set(group.rows.values())) == len(group.rows) > 0
        assert set(group.scenes) <= set(shipped.scenes)
    assert [row.error for row in rows if row.group is None] == ["", ""]
    alone = {row.opacity for row in plan(shipped, {"lego": tmp_path}, list(shipped.groups))}
    assert alone == set(shipped.scenes["lego"].opacity) == {"distance"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("groups: {a: {row: {}}}\n", "'row' not in 'Group'"),
        ("groups: {a: {rows: [x=1]}}\n", "expected baseline, scenes and groups of rows"),
        ("groups: {a: {columns: [speed]}}\n", "groups.a.columns: found speed, expected some of chamfer"),
        ("scenes: {a: {millimetres: far}}\n", "'far'"),
        ("- a\n", "expected baseline, scenes and groups of rows"),
        ("a: [\n", "expected baseline, scenes and groups of rows"),
    ],
)
def test_a_wrong_table_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"wrong\.yaml: ") as raised:
        read_table(path)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)
    with pytest.raises(InputError, match=r"nowhere\.yaml: cannot read this file"):
        read_table(tmp_path / "nowhere.yaml")
