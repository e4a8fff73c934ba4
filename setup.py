"""Builds torch_surfcap._C, the compiled operators; everything else about the package stands in pyproject.toml."""

import hashlib
import os
import shutil
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from glob import glob
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

# Switches, all from the environment.
CUDA = os.environ.get(
    "TORCH_SURFCAP_CUDA", "auto"
)  # 0 | 1; auto: kernels, nvcc and a torch with CUDA are there
DEBUG = os.environ.get("DEBUG", "0") == "1"  # unoptimised, with symbols and assertions
ARCHS = os.environ.get("TORCH_CUDA_ARCH_LIST", "8.0;9.0+PTX").replace(" ", ";").split(";")
JOBS = int(os.environ.get("MAX_JOBS", os.cpu_count() or 1))  # files compiled at the same time

CPU_SOURCES = ["csrc/module.c", *sorted(glob("csrc/*.cpp") + glob("csrc/cpu/*.cpp"))]
CUDA_SOURCES = sorted(glob("csrc/cuda/*.cu"))
SPEED = ["-O0", "-g"] if DEBUG else ["-O3", "-DNDEBUG"]
HOST = ["-fPIC", "-fvisibility=hidden", "-fno-math-errno", "-fno-trapping-math", "-Wall", "-Wno-psabi"]
COMMON = [*SPEED, "-DTORCH_TARGET_VERSION=0x020a000000000000", "-DPy_LIMITED_API=0x030A0000"]  # 2.10, 3.10


class BuildOps(build_ext):
    def build_extension(self, ext: Extension) -> None:
        """Compile, several at a time, the sources whose object is older than a file they read; then link."""
        import torch  # not at the top: reading the metadata needs no torch

        nvcc = shutil.which("nvcc") or os.path.join(
            os.environ.get("CUDA_HOME", "/usr/local/cuda"), "bin/nvcc"
        )
        usable = CUDA_SOURCES and torch.version.cuda and os.path.exists(nvcc)
        cuda = CUDA == "1" or bool(CUDA == "auto" and usable)
        root, cxx = Path(torch.__file__).parent, os.environ.get("CXX", "c++")
        include = ["-Icsrc", "-isystem", f"{root}/include", f"-I{sysconfig.get_path('include')}"]
        archs = [arch.replace(".", "").partition("+") for arch in ARCHS]
        codes = [
            f"-gencode=arch=compute_{n},code=[sm_{n}{f',compute_{n}' * bool(ptx)}]" for n, ptx, _ in archs
        ]
        host = ["-std=c++20", *["-DTORCH_SURFCAP_CUDA"] * cuda]
        tools = {".c": [os.environ.get("CC", "cc"), *HOST], ".cpp": [cxx, *host, *HOST]}
        tools[".cu"] = [
            nvcc,
            *host,
            "-DUSE_CUDA",
            "--expt-relaxed-constexpr",
            *codes,
            "-Xcompiler",
            ",".join(HOST),
        ]
        key = hashlib.sha256(repr((tools, COMMON, include, torch.__version__)).encode()).hexdigest()[:12]

        def compiled(source: str) -> str:
            target, listing = (Path("build/objects", key, source + suffix) for suffix in (".o", ".d"))
            os.makedirs(target.parent, exist_ok=True)
            needs = (
                listing.read_text().replace("\\\n", "").partition(":")[2].split() if target.exists() else [""]
            )
            if any(not os.path.exists(n) or os.path.getmtime(n) > target.stat().st_mtime for n in needs):
                command = [*tools[Path(source).suffix], *COMMON, *include, "-MMD", "-MF", str(listing), "-c"]
                self.spawn([*command, source, "-o", str(target)])
            return str(target)

        with ThreadPoolExecutor(JOBS) as pool:
            objects = list(pool.map(compiled, ext.sources + CUDA_SOURCES * cuda))
        libraries = ["-ltorch", "-ltorch_cpu", "-lc10", *["-ltorch_cuda"] * bool(cuda and torch.version.cuda)]
        target = self.get_ext_fullpath(ext.name)
        os.makedirs(os.path.dirname(target), exist_ok=True)
        self.spawn([nvcc if cuda else cxx, "-shared", *objects, f"-L{root}/lib", *libraries, "-o", target])


OPS = Extension("torch_surfcap._C", CPU_SOURCES, py_limited_api=True)
setup(
    ext_modules=[OPS], cmdclass={"build_ext": BuildOps}, options={"bdist_wheel": {"py_limited_api": "cp310"}}
)
