"""The page of a check on a GPU: its numbers as tables, beside the paper's figures and the targets. Needs no torch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

# Table 1 of the paper, lego with B = 2, on a Quadro RTX 5000; its seconds are of the optimisation.
PAPER = {"psnr_volume": 26.40, "psnr_raster": 26.68, "seconds": 64.2, "peak": 7.3e9}
FIT_SECONDS, SHARE = 6.0, 0.4  # targets: of lego's levels, and of what bounds the march
NONE = "–"
SCORES = {
    "psnr_volume": "PSNR volume",
    "psnr_raster": "PSNR raster",
    "psnr_masked": "PSNR masked",
    "psnr_raster_masked": "PSNR raster masked",
    "ssim": "SSIM",
}
SURFACE = {"chamfer": "Chamfer", "accuracy": "accuracy", "completeness": "completeness"}
TIMES = ("prepare", "ranges", "march", "voxels", "adam", "gains", "iterations")
BYTES = {
    "records": "records of the voxels met, read",
    "gradient": "their gradient, read and written",
    "zeros": "zeros of the other voxels' gradient",
    "rays": "rays, observations, ranges, results",
    "least": "together, the least",
    "cached": "read by the samples through the caches",
    "added": "added by the samples to the gradient",
}

Row = Sequence[object]


def shown(value: object) -> str:
    """A cell: numbers with four digits, – for None.

    >>> [shown(x) for x in (None, 0.123456, 123456.7, 12, "a|b")]
    ['–', '0.1235', '123457', '12', 'a\\\\|b']
    """
    if value is None:
        return NONE
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1e4 else f"{value:.4g}"
    return str(value).replace("|", "\\|").replace("\n", " ")


def table(head: Sequence[str], rows: Iterable[Row]) -> str:
    """In markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(map(shown, row)) + " |" for row in rows)])


def page(numbers: Mapping[str, Any]) -> str:
    """All of it. What there are no numbers of is left out; the table of steps says why."""
    machine, fits = numbers["machine"], numbers.get("fits", {})
    versions = ", ".join(f"{name} {machine.get(name) or 'unknown'}" for name in ("driver", "cuda", "torch"))
    parts = [
        "# Benchmarks on a GPU",
        f"Written by `make gpu-check` in {numbers['seconds']:.0f} s on {machine['gpu']} "
        f"(sm_{machine['arch'].replace('.', '')}), {machine['cores']} CPU cores, {versions}, "
        f"commit {machine.get('commit') or 'unknown'}. {NONE}: no number.",
        "## Targets",
        table(("lego, 800 x 800, SH degree 2", "paper", "target", "here", "met"), targets(numbers)),
        "## Steps",
        table(("step", "seconds", "limit", "result"), [[s[k] for k in STEP_KEYS] for s in numbers["steps"]]),
    ]
    if numbers.get("tests"):
        parts += ["## Tests on the device", *_tests(numbers["tests"])]
    if fits:
        parts += ["## Fits", *_fits(fits)]
    for name, profile in numbers.get("profiles", {}).items():
        parts += [f"## The photometric step, finest level of {name}", *_profile(profile)]
    if numbers.get("registers") or numbers.get("ncu"):
        parts += ["## Kernels of the march", *_kernels(numbers)]
    return "\n\n".join(parts) + "\n"


STEP_KEYS = ("name", "seconds", "limit", "result")


def targets(numbers: Mapping[str, Any]) -> list[list[object]]:
    """Rows of what is asked for and what there is, with the field of the paper and with the default one."""
    rows = []
    for opacity in ("transparency", "distance"):
        name = f"lego_{opacity}"
        fit = numbers.get("fits", {}).get(name)
        if fit is not None:
            test, peak = fit["test"] or {}, fit["device"]["peak_memory_bytes"]
            for key in ("psnr_volume", "psnr_raster"):
                least, found = PAPER[key], test.get(key)
                rows.append(
                    [f"{SCORES[key]}, {opacity}, dB", least, f">= {least}", found, _met(found, least)]
                )
            spent = fit["seconds"].get("fit")
            paper, most = PAPER["seconds"], FIT_SECONDS
            rows.append([f"all levels, {opacity}, s", paper, f"<= {most:g}", spent, _met(most, spent)])
            peak, most = peak and peak / 1e9, PAPER["peak"] / 1e9
            rows.append([f"peak of tensors, {opacity}, GB", most, f"<= {most:g}", peak, _met(most, peak)])
        profile = numbers.get("profiles", {}).get(name)
        if profile is not None:
            what = f"march, {opacity}, % of its {profile['bound_by']}"
            share = profile["share"]
            rows.append([what, None, f">= {100 * SHARE:.0f}", 100 * share, _met(share, SHARE)])
    return rows


def _met(large: float | None, small: float | None) -> str | None:
    if large is None or small is None:
        return None
    return "yes" if large >= small else "no"


def _tests(tests: Mapping[str, Any]) -> list[str]:
    rows = [[name, *(found[k] for k in ("passed", "failed", "skipped"))] for name, found in tests.items()]
    failed = [f"- `{test}`" for found in tests.values() for test in found["names"]]
    found = [table(("step", "passed", "failed", "skipped"), rows)]
    return found + (["Failed:\n\n" + "\n".join(failed)] if failed else [])


def _fits(fits: Mapping[str, Any]) -> list[str]:
    head = ["fit", "device", *SCORES.values(), "views", "levels, s", "mesh, s", "total, s"]
    head += ["peak of tensors, GB", "voxels", "triangles"]
    rows: list[Row] = []
    parts = []
    for name, fit in fits.items():
        test, seconds, peak = fit["test"] or {}, fit["seconds"], fit["device"]["peak_memory_bytes"]
        cost = [*(seconds.get(k) for k in ("fit", "mesh", "total")), peak and peak / 1e9]
        scores = [test.get(k) for k in (*SCORES, "views")]
        rows.append([name, fit["device"]["word"], *scores, *cost, fit["voxels"], fit["triangles"]])
        levels = [
            [
                level["level"],
                level["iterations"],
                *(level["seconds"].get(k) for k in TIMES),
                level["iterations_per_second"],
                level["samples_per_iteration"] and level["samples_per_iteration"] / 1e6,
                level["samples_per_second"] and level["samples_per_second"] / 1e9,
            ]
            for level in fit["levels"]
        ]
        columns = [
            "level",
            "iterations",
            *(f"{k}, s" for k in TIMES[:-1]),
            "all iterations, s",
            "iterations/s",
        ]
        columns += ["million samples/iteration", "billion samples/s of march"]
        parts += [f"### Levels of {name}", table(columns, levels)]
    surfaces = [
        [name, *((fit["surface"] or {}).get(k) for k in SURFACE)]
        for name, fit in fits.items()
        if fit["surface"]
    ]
    between = [
        [f"{name}: cuda against cpu", *(fit["to_cpu"].get(k) for k in SURFACE)]
        for name, fit in fits.items()
        if fit.get("to_cpu")
    ]
    if surfaces or between:
        title = "### Distances of surfaces, world units, to the true one or of one device's to the other's"
        parts = [title, table(("mesh", *SURFACE.values()), [*surfaces, *between]), *parts]
    return [table(head, rows), SAMPLES_NOTE, *parts]


SAMPLES_NOTE = (
    "Scores are of held-out views (every eighth one where a capture names none; the paper's are of the scene's test split). "
    "Levels are the optimisation, with what prepares it; total is from the command's start to the written files. Samples "
    "are those within the integration ranges: some, behind an opaque surface, are not visited."
)


def _profile(found: Mapping[str, Any]) -> list[str]:
    names = ("rays", "ranges", "samples", "samples_in_ranges", "stored", "met")
    counted = ", ".join(f"{shown(float(found[k]))} {k.replace('_', ' ')}" for k in names)
    seconds, moved = found["seconds"], found["bytes"]
    gbs = [[title, moved[k] / 1e9, moved[k] / 1e9 / seconds] for k, title in BYTES.items()]
    bandwidth, rate = found["copy_bytes_per_second"], found["flops_per_second"]
    shares = found["shares"]
    limits = [
        [
            "copy bandwidth, GB/s",
            bandwidth / 1e9,
            moved["least"] / 1e9 / seconds,
            100 * shares["copy bandwidth"],
        ],
        ["fp32 rate, TFLOP/s", rate / 1e12, found["flops"] / 1e12 / seconds, 100 * shares["fp32 rate"]],
    ]
    reached = "" if found["share"] >= SHARE else " Far from both: caches, atomics or latency hold it up."
    return [
        f"{found['opacity']}, SH degree {found['degree']}; {counted} (stored and met: voxels). One step alone: "
        f"{1e3 * seconds:.3f} ms, {shown(found['samples'] / seconds / 1e9)} billion samples/s, the median by events. "
        f"march_forward without ranges: {1e3 * found['forward_seconds']:.3f} ms.",
        table(("of the card", "measured", "the step", "share, %"), limits),
        f"The bandwidth is that of a large copy, bytes read and written; the rate that of a large product of matrices "
        f"without TF32. Nearest to its {found['bound_by']}.{reached}",
        table(("bytes of a step", "GB", "GB/s"), gbs),
    ]


def _kernels(numbers: Mapping[str, Any]) -> list[str]:
    parts = []
    registers = numbers.get("registers") or {}
    if registers:
        head = ("kernel", "variants", "most registers", "most stack, bytes")
        rows = [[k, *(v[n] for n in ("variants", "registers", "stack"))] for k, v in registers.items()]
        parts += ["As compiled:", table(head, rows)]
    launches = numbers.get("ncu") or []
    if launches:
        head = tuple(dict.fromkeys(key for launch in launches for key in launch))
        parts += ["As they ran, by ncu:", table(head, [[x.get(k) for k in head] for x in launches])]
    return parts
