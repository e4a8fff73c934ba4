"""Builds torch_surfcap._C, the compiled operators; the rest of the package stands in pyproject.toml."""

import hashlib
import os
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from glob import glob
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

# Switches, all from the environment.
CUDA = os.environ.get("TORCH_SURFCAP_CUDA")  # 0 | 1; unset: if there are nvcc and a torch with CUDA
DEBUG = os.environ.get("DEBUG") == "1"  # unoptimised, with symbols and assertions
ARCHS = os.environ.get("TORCH_CUDA_ARCH_LIST", "8.0;9.0+PTX").replace(".", "").replace("+PTX", "").split(";")
JOBS = int(os.environ.get("MAX_JOBS", os.cpu_count() or 1))  # files compiled at the same time

CC, CXX = os.environ.get("CC", "cc"), os.environ.get("CXX", "c++")
NVCC = os.path.join(os.environ.get("CUDA_HOME", "/usr/local/cuda"), "bin/nvcc")
CPU_SOURCES = ["csrc/module.c", *sorted(glob("csrc/*.cpp") + glob("csrc/cpu/*.cpp"))]
GPU_SOURCES = sorted(glob("csrc/cuda/*.cu"))
HOST = ["-fPIC", "-fvisibility=hidden", "-fno-math-errno", "-fno-trapping-math", "-Wall", "-Wno-psabi"]
ABI = ["-DTORCH_TARGET_VERSION=0x020a000000000000", "-DPy_LIMITED_API=0x030A0000"]  # torch 2.10, Python 3.10
COMMON = [*(["-O0", "-g"] if DEBUG else ["-O3", "-DNDEBUG"]), *ABI, "-Icsrc"]
GPU = ["-DUSE_CUDA", "-Xcompiler", ",".join(HOST), *(f"-gencode=arch=compute_{n},code=sm_{n}" for n in ARCHS)]


class BuildOps(build_ext):
    def build_extension(self, ext: Extension) -> None:
        """Compile, several at a time, the sources whose object is older than a file they read; then link."""
        import torch  # not at the top: reading the metadata needs no torch

        cuda = CUDA == "1" or bool(not CUDA and GPU_SOURCES and torch.version.cuda and os.path.exists(NVCC))
        cpp = ["-std=c++20", *["-DTORCH_SURFCAP_CUDA"] * cuda]
        tools = {".c": [CC, *HOST], ".cpp": [CXX, *cpp, *HOST], ".cu": [NVCC, *cpp, *GPU]}
        root = Path(torch.__file__).parent
        common = [*COMMON, "-isystem", f"{root}/include", "-isystem", sysconfig.get_path("include")]
        key = hashlib.sha256(repr((tools, common, torch.__version__)).encode()).hexdigest()[:12]

        def compiled(source: str) -> str:
            target, listing = (Path("build/objects", key, source + suffix) for suffix in (".o", ".d"))
            os.makedirs(target.parent, exist_ok=True)
            needs = listing.read_text().replace("\\\n", "").split()[1:] if target.exists() else [""]
            if any(not os.path.exists(n) or os.path.getmtime(n) > target.stat().st_mtime for n in needs):
                command = [*tools[Path(source).suffix], *common, "-MMD", "-MF", str(listing), "-c", source]
                self.spawn([*command, "-o", str(target)])
            return str(target)

        with ThreadPoolExecutor(JOBS) as pool:
            objects = list(pool.map(compiled, ext.sources + GPU_SOURCES * cuda))
        libraries = ["-ltorch", "-ltorch_cpu", "-lc10", *["-ltorch_cuda"] * bool(cuda and torch.version.cuda)]
        link = [NVCC if cuda else CXX, "-shared", *objects, f"-L{root}/lib", *libraries]
        self.mkpath(os.path.dirname(self.get_ext_fullpath(ext.name)))
        self.spawn([*link, "-o", self.get_ext_fullpath(ext.name)])


OPS, WHEEL = Extension("torch_surfcap._C", CPU_SOURCES, py_limited_api=True), {"py_limited_api": "cp310"}
setup(ext_modules=[OPS], cmdclass={"build_ext": BuildOps}, options={"bdist_wheel": WHEEL})
