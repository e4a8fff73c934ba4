"""Builds torch_surfcap._C, the compiled operators; the rest of the package stands in pyproject.toml."""

import hashlib
import os
import subprocess
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from glob import glob
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import CompileError

# Switches, all from the environment.
# TORCH_SURFCAP_CUDA: 0, or 1; unset: if there are nvcc and a torch with CUDA. For tests: "alone", without the CPU's
# kernels, and "emulated", CUDA's kernels compiled for the CPU.
CUDA = os.environ.get("TORCH_SURFCAP_CUDA")
DEBUG = os.environ.get("DEBUG") == "1"  # unoptimised, with symbols and assertions
ARCHS = os.environ.get("TORCH_CUDA_ARCH_LIST", "7.5;8.0;8.6;8.9;9.0+PTX")
JOBS = int(os.environ.get("MAX_JOBS", os.cpu_count() or 1))  # files compiled at the same time

CC, CXX = os.environ.get("CC", "cc"), os.environ.get("CXX", "c++")
NVCC = os.path.join(os.environ.get("CUDA_HOME", "/usr/local/cuda"), "bin/nvcc")
CPU_SOURCES = ["csrc/module.c", *sorted(glob("csrc/*.cpp") + glob("csrc/cpu/*.cpp"))]
GPU_SOURCES = sorted(glob("csrc/cuda/*.cu"))
HOST = ["-fPIC", "-fvisibility=hidden", "-fno-math-errno", "-fno-trapping-math", "-Wall", "-Wno-psabi"]
ABI = ["-DTORCH_TARGET_VERSION=0x020a000000000000", "-DPy_LIMITED_API=0x030A0000"]  # torch 2.10, Python 3.10
COMMON = [*(["-O0", "-g"] if DEBUG else ["-O3", "-DNDEBUG"]), *ABI, "-Icsrc"]
EMULATION = ["-O1", "-DSURFCAP_CUDA_EMULATION", "-Wno-unknown-pragmas", "-Itests/emulation"]


def gencode(arch: str) -> str:
    """nvcc's option for 9.0 or, with PTX for what comes later, 9.0+PTX."""
    n = arch.removesuffix("+PTX").replace(".", "")
    return f"-gencode=arch=compute_{n},code=[sm_{n}{f',compute_{n}' if '+PTX' in arch else ''}]"


GPU = [
    "-DUSE_CUDA",
    "--expt-relaxed-constexpr",
    "-diag-suppress=128",
    *map(gencode, ARCHS.replace(" ", ";").split(";")),
]


class BuildOps(build_ext):
    def build_extension(self, ext: Extension) -> None:
        """Compile, several at a time, the sources whose object is older than a file they read; then link."""
        import torch  # not at the top: reading the metadata needs no torch

        nvcc = CUDA in ("1", "alone") or (not CUDA and torch.version.cuda and os.path.exists(NVCC))
        sources = ext.sources + GPU_SOURCES * bool(nvcc or CUDA == "emulated")
        if CUDA in ("alone", "emulated"):
            sources = [name for name in sources if not name.startswith("csrc/cpu")]
        tools = {".c": [CC, *HOST], ".cpp": [CXX, "-std=c++20", *HOST]}
        tools[".cu"] = [NVCC, "-std=c++20", "-Xcompiler", ",".join(HOST), *GPU]
        if CUDA == "emulated":
            sources.append("tests/emulation/emulation.cpp")
            tools[".cu"] = [*tools[".cpp"], *EMULATION, "-x", "c++"]
        root = Path(torch.__file__).parent
        common = [*COMMON, "-isystem", f"{root}/include", "-isystem", sysconfig.get_path("include")]

        def compiled(source: str) -> str:
            tool = tools[Path(source).suffix]
            key = hashlib.sha256(repr((tool, common, torch.__version__)).encode()).hexdigest()[:12]
            target, listing = (Path("build/objects", key, source + suffix) for suffix in (".o", ".d"))
            os.makedirs(target.parent, exist_ok=True)
            needs = listing.read_text().replace("\\\n", "").split()[1:] if target.exists() else [""]
            made = target.stat().st_mtime if target.exists() else 0.0
            if self.force or any(not os.path.exists(n) or os.path.getmtime(n) > made for n in needs):
                command = [
                    tool[0],
                    *common,
                    *tool[1:],
                    "-MMD",
                    "-MF",
                    str(listing),
                    "-c",
                    source,
                    "-o",
                    str(target),
                ]
                done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
                print(*command, f"\n{done.stdout}", end="", flush=True)  # at once: other files are under way
                if done.returncode:
                    raise CompileError(f"{source} does not compile")
            return str(target)

        with ThreadPoolExecutor(JOBS) as pool:
            objects = list(pool.map(compiled, sources))
        libraries = ["-ltorch", "-ltorch_cpu", "-lc10", *["-ltorch_cuda"] * bool(nvcc and torch.version.cuda)]
        link = [NVCC if nvcc else CXX, "-shared", *objects, f"-L{root}/lib", *libraries]
        self.mkpath(os.path.dirname(self.get_ext_fullpath(ext.name)))
        self.spawn([*link, "-o", self.get_ext_fullpath(ext.name)])


OPS, WHEEL = Extension("torch_surfcap._C", CPU_SOURCES, py_limited_api=True), {"py_limited_api": "cp310"}
setup(ext_modules=[OPS], cmdclass={"build_ext": BuildOps}, options={"bdist_wheel": WHEEL})
