"""What nvcc says of CUDA's kernels: registers, stack and spills of each; exit status 1 where one that walks rays spills.

TORCH_SURFCAP_CUDA=alone NVCC_APPEND_FLAGS=-Xptxas=-v python setup.py build_ext --force | python tests/kernel_resources.py
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from dataclasses import dataclass

ENTRY = re.compile(
    r"Compiling entry function '(?P<name>\S+)' for '(?P<arch>\w+)'.*?(?P<stack>\d+) bytes stack frame, "
    r"(?P<stores>\d+) bytes spill stores, (?P<loads>\d+) bytes spill loads.*?Used (?P<registers>\d+) registers",
    re.DOTALL,
)
MARCH = "Walking"  # what the parameters of kernels that walk rays are called


@dataclass(frozen=True)
class Kernel:
    """One kernel for one architecture; stack and spills (stores and loads together) in bytes."""

    name: str
    arch: str
    registers: int
    stack: int
    spills: int

    @property
    def walks_rays(self) -> bool:
        return MARCH in self.name


def parse(log: str) -> list[Kernel]:
    """The kernels of a log of ``nvcc -Xptxas=-v``, with their names as they are in the source."""
    found = [m.groupdict() for m in ENTRY.finditer(log)]
    names = readable([entry["name"] for entry in found])
    return [
        Kernel(name, m["arch"], int(m["registers"]), int(m["stack"]), int(m["stores"]) + int(m["loads"]))
        for name, m in zip(names, found, strict=True)
    ]


def readable(names: list[str]) -> list[str]:
    """Mangled names as C++ writes them, without namespaces and parameters, where c++filt is there."""
    if not names or not shutil.which("c++filt"):
        return names
    done = subprocess.run(["c++filt"], input="\n".join(names), capture_output=True, text=True, check=True)
    plain = re.sub(r"surfcap::|\(anonymous namespace\)::|cuda::|void ", "", done.stdout)
    return [re.sub(r"\(.*", "", line) for line in plain.splitlines()]


def report(kernels: list[Kernel]) -> tuple[str, bool]:
    """A table, kernels of the same template together as a range, and whether no kernel that walks rays spills."""
    lines = [f"{'kernel':<24}{'variants':>9}{'registers':>12}{'stack':>8}{'spills':>8}"]
    families: dict[tuple[str, str], list[Kernel]] = {}
    for kernel in kernels:
        families.setdefault((kernel.name.split("<")[0], kernel.arch), []).append(kernel)
    for (name, arch), same in sorted(families.items()):
        registers = sorted(k.registers for k in same)
        span = f"{registers[0]} to {registers[-1]}"
        stack, spills = (max(getattr(k, x) for k in same) for x in ("stack", "spills"))
        lines.append(f"{name:<24}{len(same):>9}{span:>12}{stack:>8}{spills:>8}  {arch}")
    spilling = [k for k in kernels if k.walks_rays and k.spills]
    lines += [f"spills: {k.name} for {k.arch}, {k.spills} bytes" for k in spilling]
    return "\n".join(lines), not spilling


def main() -> int:
    log = sys.stdin.read()
    kernels = parse(log)
    if not kernels:
        print(f"{log[-3000:]}\nno kernels in this log, expected that of nvcc -Xptxas=-v", file=sys.stderr)
        return 1
    text, sound = report(kernels)
    print(text)
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
