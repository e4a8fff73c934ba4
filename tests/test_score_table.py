"""Scores as markdown: the best is bold, differences are to the baseline, lengths have their unit."""

from __future__ import annotations

from torch_surfcap.studies.score_table import Line, markdown

BASE = Line(
    "baseline", "", {"chamfer": 0.0012, "psnr_volume": 30.0, "pieces": 1, "seconds": 9.6}, baseline=True
)
WORSE = Line(
    "worse", "x=1", {"chamfer": 0.0015, "psnr_volume": 28.5, "pieces": 7, "seconds": 9.9}, group="terms"
)
FAILED = Line("failed", "y=2", {}, "found a | b", group="terms")
COLUMNS = ("chamfer", "psnr_volume", "pieces", "seconds", "tiles")


def test_table() -> None:
    """Seconds are the same as printed, pieces have no best, no line has tiles."""
    assert markdown([BASE, WORSE, FAILED], COLUMNS, 1000).splitlines() == [
        "|  | settings | Chamfer, mm | PSNR volume, dB | pieces | seconds |",
        "|---|---|---|---|---|---|",
        "| baseline |  | **1.200** | **30.00** | 1 | 10 |",
        "| *terms* |  |  |  |  |  |",
        "| worse | `x=1` | 1.500 (+0.300) | 28.50 (-1.50) | 7 | 10 |",
        "| failed | `y=2`: found a \\| b |  |  |  |  |",
    ]


def test_unknown_unit_of_length() -> None:
    text = markdown([BASE, WORSE], ["chamfer"]).splitlines()
    assert text[0] == "|  | settings | Chamfer |"
    assert text[2] == "| baseline |  | **0.0012** |"
    assert text[4] == "| worse | `x=1` | 0.0015 (+0.0003) |"


def test_no_baseline_no_differences() -> None:
    assert "(" not in markdown([WORSE._replace(group="")], COLUMNS)


def test_nothing_is_finished() -> None:
    assert (
        markdown([FAILED._replace(group="")], COLUMNS).splitlines()[-1] == "| failed | `y=2`: found a \\| b |"
    )
