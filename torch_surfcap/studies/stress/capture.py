"""Views that are few, one-sided, unlike each other or cut off."""

from __future__ import annotations

from dataclasses import replace

import torch

from torch_surfcap.data.cameras import Cameras
from torch_surfcap.data.capture import Capture
from torch_surfcap.studies.stress.condition import Condition, copied

GROUP = "capture"


def one_side(capture: Capture) -> Capture:
    """The half of the cameras that stand farthest towards -y, from where the bowl's inside and the figure's face show."""
    order = torch.argsort(capture.cameras.centers[:, 1])[: (len(capture) + 1) // 2]
    return capture.subset(order.sort().values)


def cropped(capture: Capture, every: int, share: float) -> Capture:
    """Every so many-th view without this share of its picture's left side, which cuts the subject off."""
    other = copied(capture)
    K, size = other.cameras.K.clone(), other.cameras.size.clone()
    for i in range(0, len(other), every):
        start = round(share * int(size[i, 0]))
        for part in (other.images, other.masks, other.plates):
            if part is not None:
                part[i] = part[i][:, start:].contiguous()
        K[i, 0, 2] -= start
        size[i, 0] -= start
    other.cameras = Cameras(K, capture.cameras.world_to_camera, size)
    return other


def conditions() -> list[Condition]:
    """Numbers of views, one side, mixed rigs, a camera inside the box, borders that cut."""
    found = [
        Condition(
            GROUP,
            "views",
            f"{n}",
            f"{n} cameras on the ring.",
            "surface or words" if n < 8 else "surface",
            scene=lambda scene, n=n: replace(scene, views=n),  # type: ignore[misc]
        )
        for n in (60, 30, 15, 8, 5)
    ]
    found += [
        Condition(
            GROUP,
            "one side",
            "",
            "Only the half of the cameras on one side.",
            "surface or words",
            capture=one_side,
        ),
        Condition(
            GROUP,
            "mixed rig",
            "",
            "Distances differ by 1.8, focal lengths by 2.8, picture sizes by 3 times.",
            scene=lambda scene: replace(scene, rig="mixed"),
        ),
        Condition(
            GROUP,
            "camera in the box",
            "",
            "One camera stands 30 cm from the subject's middle.",
            scene=lambda scene: replace(scene, rig="inside"),
        ),
    ]
    for share, every in ((0.4, 6), (0.5, 3), (0.5, 1)):
        found.append(
            Condition(
                GROUP,
                "cut by the border",
                f"{share:g}, 1 of {every}",
                f"Of one view in {every} the left {share:g} of the picture is missing.",
                "surface" if every > 1 else "surface or words",
                capture=lambda c, every=every, share=share: cropped(c, every, share),  # type: ignore[misc]
            )
        )
    return found
