"""Subjects that are hard to see as they are."""

from __future__ import annotations

from dataclasses import replace

from torch_surfcap.data.sample_scene import Coat
from torch_surfcap.studies.stress.condition import Condition

GROUP = "subject"


def conditions() -> list[Condition]:
    """Gloss, mirrors, missing and repeated texture, thin parts, several bodies, the floor."""

    def coat(name: str, severity: str, sentence: str, worn: Coat, expected: str = "surface") -> Condition:
        return Condition(GROUP, name, severity, sentence, expected, lambda scene: replace(scene, coat=worn))

    found = [
        coat("gloss", f"{r:g}", f"Highlights of strength 1 and roughness {r:g} lie over it.", Coat(1.0, r))
        for r in (0.5, 0.35, 0.2)
    ]
    found += [
        Condition(
            GROUP,
            "gloss, B = 2",
            "0.2",
            "The same at roughness 0.2, fitted with spherical harmonics of degree 2.",
            scene=lambda scene: replace(scene, coat=Coat(1.0, 0.2)),
            settings={"sh_degree": 2},
        ),
        coat(
            "mirror",
            "",
            "Between 1.05 and 1.25 m above the floor it reflects the room.",
            Coat(mirror=(1.05, 1.25)),
            "surface or words",
        ),
        coat("uniform colour", "", "All of it is one grey.", Coat(paint="plain")),
        coat("repeated texture", "", "A chequer of 6 cm covers all of it.", Coat(paint="repeated")),
    ]
    for depth in (0.1, 0.3, 0.45):
        found.append(
            Condition(
                GROUP,
                "bowl",
                f"{100 * depth:.0f} cm deep",
                f"The bowl is {100 * depth:.0f} cm deep, 76 cm wide inside, instead of 20 cm.",
                scene=lambda scene, depth=depth: replace(scene, subject="bowl", depth=depth),  # type: ignore[misc]
                scenes=("bowl",),
            )
        )
    for width in (2.0, 1.0, 0.5):
        found.append(
            Condition(
                GROUP,
                "wires",
                f"{width:g} voxel",
                f"Three rods of 35 cm, {width:g} voxels wide, stick out of its top.",
                scene=lambda scene, width=width: replace(scene, wires=width),  # type: ignore[misc]
            )
        )
    for width in (3.0, 2.0, 1.0):
        found.append(
            Condition(
                GROUP,
                "fingers",
                f"{width:g} voxels",
                f"Five parallel fingers of 12 cm stand on it, {width:g} voxels wide and as far apart.",
                scene=lambda scene, width=width: replace(scene, fingers=width),  # type: ignore[misc]
            )
        )
    found += [
        Condition(
            GROUP,
            "fringe",
            "",
            "300 hairs of 8 cm and 3 mm stand on it.",
            scene=lambda s: replace(s, fringe=True),
        ),
        Condition(
            GROUP,
            "two bodies",
            "",
            "A ball of 13 cm floats beside it.",
            scene=lambda s: replace(s, second=True),
        ),
        Condition(
            GROUP,
            "on the floor",
            "",
            "It stands 3 cm deep in the floor, flat below.",
            scene=lambda s: replace(s, sunk=True),
        ),
    ]
    return found
