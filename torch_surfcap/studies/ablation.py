"""The rows of an ablation: named in a YAML file as what they change of a baseline, resolved to settings of a fit, and known
by a key that changes with whatever could change their result."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from torch_surfcap import config as settings
from torch_surfcap.errors import InputError
from torch_surfcap.studies.score_table import COLUMNS

PACKAGE = Path(__file__).resolve().parents[1]
STUDIES = Path(__file__).resolve().parent.name  # no part of a fit


@dataclass
class Scene:
    settings: str = "data.holdout=8"  # key=value ..., of every row on this scene
    millimetres: float | None = None  # of the capture's unit of length; None: not known
    opacity: list[str] = field(default_factory=lambda: ["distance", "transparency"])


@dataclass
class Group:
    title: str = ""
    rows: dict[str, str] = field(default_factory=dict)  # name: key=value ... that it changes
    opacity: list[str] = field(default_factory=lambda: ["distance", "transparency"])
    scenes: list[str] = field(default_factory=list)  # none: all
    columns: list[str] = field(default_factory=list)  # of a table of its own; none: in the scene's table


@dataclass
class Table:
    baseline: str = ""  # key=value ...
    scenes: dict[str, Scene] = field(default_factory=dict)
    groups: dict[str, Group] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Row:
    """One fit: group None is the baseline, changes what it changes of that. script: of train/, that fits; arguments: of it,
    but for `out`; scored: more of train/evaluate.py's. key: the same for the same settings of the same program; None, with
    the error, where this program does not know them."""

    scene: str
    opacity: str
    group: Group | None
    name: str
    changes: str
    arguments: tuple[str, ...]
    key: str | None = None
    error: str = ""
    script: str = "fit.py"
    scored: tuple[str, ...] = ()

    @property
    def device(self) -> str:
        """Where its fit runs, as its arguments say."""
        given = [word.partition("=")[2] for word in self.arguments if word.startswith("device=")]
        return given[-1] if given else "auto"


def read_table(path: Path) -> Table:
    """The file's rows. Raises InputError naming the file and what is wrong in it."""
    try:
        table = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(Table), OmegaConf.load(path)))
    except OSError as error:
        raise InputError(f"{path}: cannot read this file: {error.strerror}") from error
    except (OmegaConfBaseException, YAMLError, UnicodeDecodeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: {reason}, expected baseline, scenes and groups of rows") from error
    assert isinstance(table, Table)
    for name, group in table.groups.items():
        for column in group.columns:
            if column not in COLUMNS:
                known = ", ".join(COLUMNS)
                raise InputError(f"{path}: groups.{name}.columns: found {column}, expected some of {known}")
    return table


def plan(
    table: Table, scenes: Mapping[str, Path], names: Sequence[str], given: Sequence[str] = ()
) -> list[Row]:
    """The rows in the order in which they run: by scene and opacity, the baseline first.

    Args:
        scenes: the capture of each scene. names: of the groups. given: key=value of every row, after the scene's.
    """
    program = program_digest()
    rows = []
    for scene, capture in scenes.items():
        common = table.scenes.get(scene, Scene()).settings.split() + table.baseline.split()
        for opacity, group, name, changes in _chosen(table, scene, names):
            every = [
                f"data.path={capture.resolve()}",
                *common,
                f"opacity={opacity}",
                *given,
                *changes.split(),
            ]
            row = Row(scene, opacity, group, name, changes, tuple(every))
            try:
                config = settings.resolved(settings.load(None, every))
                rows.append(replace(row, key=_digest([program, asdict(config)])))
            except InputError as error:
                rows.append(replace(row, error=str(error)))
    return rows


def _chosen(table: Table, scene: str, names: Sequence[str]) -> Iterator[tuple[str, Group | None, str, str]]:
    """Opacity, group, name and changes of a scene's rows."""
    groups = [table.groups[name] for name in names]
    groups = [group for group in groups if scene in group.scenes or not group.scenes]
    tried = table.scenes.get(scene, Scene()).opacity
    for opacity in dict.fromkeys(name for group in groups for name in group.opacity if name in tried):
        here = [group for group in groups if opacity in group.opacity]
        if not all(group.columns for group in here):
            yield opacity, None, "baseline", ""
        for group in here:
            for name, changes in group.rows.items():
                yield opacity, group, name, changes


def program_digest() -> str:
    """Stands for the program that fits: the package's Python and its compiled library."""
    files = sorted([*PACKAGE.rglob("*.py"), *PACKAGE.glob("_C*.so")])
    parts = [file for file in files if STUDIES not in file.relative_to(PACKAGE).parts]
    return _digest([[file.name, hashlib.sha256(file.read_bytes()).hexdigest()] for file in parts])


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:10]
