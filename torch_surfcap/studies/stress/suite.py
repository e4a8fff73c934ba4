"""All conditions of the stability suite, by group."""

from __future__ import annotations

from torch_surfcap.studies.stress import calibration, capture, numbers, photometry, silhouettes, subject
from torch_surfcap.studies.stress.condition import Condition

GROUPS = (subject, capture, photometry, calibration, silhouettes, numbers)
CLEAN = Condition("", "clean", "", "The scene as it is.")


def all_conditions() -> list[Condition]:
    """The clean run first."""
    return [CLEAN, *(condition for group in GROUPS for condition in group.conditions())]
