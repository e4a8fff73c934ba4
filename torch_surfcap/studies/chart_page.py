"""The page of a chart and its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch_surfcap.studies.chart import (
    LARGE,
    LEFT,
    Mark,
    Published,
    growth_table,
    on_fronts,
    published_table,
    work_table,
)
from torch_surfcap.studies.provenance import machine, program
from torch_surfcap.studies.score_table import Line, markdown

COLUMNS = ["chamfer", "normal_error_deg", "concave", "pieces", "psnr_masked", "psnr_volume", "psnr_raster"]
COLUMNS += ["seconds", "cpu_seconds", "memory"]


def score_tables(marks: Sequence[Mark], units: Mapping[str, float | None]) -> str:
    """A table per scene; what lies on the front of either accuracy says so. units: millimetres of each scene's unit of
    length, None where not known."""
    text = []
    for scene, unit in units.items():
        here = [mark for mark in marks if mark.scene == scene]
        on_front = on_fronts(here)
        lines = []
        for i, mark in enumerate(here):
            name = f"{mark.name} †" if i in on_front else mark.name
            lines.append(Line(name, mark.settings, mark.scores, mark.note, mark.title))
        text.append(f"### {scene}\n\n{markdown(lines, COLUMNS, unit)}\n")
    return "\n".join(text)


PAGE = """Written by

    {command}

with {program} on {machine}. {done} rows are
done, {failed} failed, {left} are still to be run. Seconds go from start to written files, peak memory is the process's,
one run a row; Chamfer is of the mesh against the true surface, PSNR of views of full size that no fit saw. Every number
stands in [chart.csv]({csv}).

![Accuracy against seconds]({folder}/accuracy.png)

*Chamfer, and PSNR of whole held-out pictures as it is published, against seconds; the area of a mark is the peak memory.
Published figures are of other hardware and other data: they place the method, they are no race.*

## Tables

† on the front: no other fit here is faster and better in Chamfer, or in PSNR within the mask.

{tables}
## How costs grow

![Growth]({folder}/growth.png)

Fitted powers: what is spent, or lost, is proportional to the swept number to this power. Peak memory and seconds include
what a process takes before it fits anything, which flattens them on small scenes.

{growth}

## Where the time goes

![Work]({folder}/work.png)

Shares of all seconds; bold: over {large:.0f} % and not the march. The march gives values and gradient in one pass.

{work}

## Published elsewhere

Other hardware, other data; from [published.csv]({published}).

{elsewhere}"""


def content(
    marks: Sequence[Mark],
    published: Sequence[Published],
    units: Mapping[str, float | None],
    command: str,
    pictures: str,
    source: str,
) -> str:
    """What stands between the page's markers. units: see ``score_tables``; pictures: the folder of pictures and CSV, and
    source: the file of what is published, as the page refers to them."""
    done, left = sum(bool(m.scores) for m in marks), sum(m.note == LEFT for m in marks)
    return PAGE.format(
        command=command,
        program=program(),
        machine=machine(),
        done=done,
        failed=len(marks) - done - left,
        left=left,
        csv=f"{pictures}/chart.csv",
        folder=pictures,
        tables=score_tables(marks, units),
        growth=growth_table(marks),
        work=work_table(marks),
        large=100 * LARGE,
        published=source,
        elsewhere=published_table(published),
    )
