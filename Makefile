# make setup | fit | test | check | cuda-check | format | bench
# make gpu-check DATA=folder RESULTS=folder: on a machine with a GPU and without a network, see train/gpu_check.py
# PYTHON chooses the interpreter; its own torch >= 2.10 is used if it has one, else TORCH is installed.
PYTHON ?= python3
TORCH ?= torch==2.13.0
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready
LIBRARY := torch_surfcap/_C.abi3.so
CSRC := $(wildcard csrc/*.* csrc/*/*.*)
CXX_FILES := $(filter %.c %.cpp %.h %.cu %.cuh,$(CSRC) $(wildcard tests/emulation/*))

define HAS_TORCH
import importlib.metadata, sys
try:
    version = importlib.metadata.version("torch").split(".")
except importlib.metadata.PackageNotFoundError:
    version = ["0", "0"]
sys.exit(0 if (int(version[0]), int(version[1])) >= (2, 10) else 1)
endef
export HAS_TORCH

# A virtual environment made from another one does not see its packages: a .pth file shows them.
define SHOW_PARENT
import pathlib, sys, sysconfig
if sys.prefix != sys.base_prefix:
    site = sysconfig.get_path("purelib", vars={"base": sys.argv[1], "platbase": sys.argv[1]})
    (pathlib.Path(site) / "_parent.pth").write_text(sysconfig.get_path("purelib") + "\n")
endef
export SHOW_PARENT

.PHONY: setup fit test check cuda-check format bench gpu-check
.DELETE_ON_ERROR:

setup: $(STAMP) $(LIBRARY)

$(STAMP): pyproject.toml
	@if test -x $(BIN)/python; then :; \
	elif $(PYTHON) -c "$$HAS_TORCH"; then \
	  $(PYTHON) -m venv --system-site-packages $(VENV) && $(PYTHON) -c "$$SHOW_PARENT" $(VENV); \
	else $(PYTHON) -m venv $(VENV); fi
	@$(BIN)/python -c "$$HAS_TORCH" || $(BIN)/python -m pip install "$(TORCH)"
	$(BIN)/python -m pip install -q "setuptools>=77" wheel
	$(BIN)/python -m pip install -q --no-build-isolation -e ".[dev]"
	$(BIN)/python -m pip install -q --ignore-installed --no-deps ruff clang-format  # their programs, in BIN
	@touch $@

$(LIBRARY): setup.py $(CSRC) | $(STAMP)
	@$(BIN)/python setup.py -q build_ext --inplace
	@touch $@

fit: setup
	$(BIN)/python -m torch_surfcap.data.sample_scene data/sample
	$(BIN)/python train/fit.py --config configs/sample.yaml
	$(BIN)/python train/evaluate.py --run out/sample --mesh-truth data/sample/gt.ply

test: setup
	$(BIN)/python -m pytest

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m mypy
	$(if $(CXX_FILES),$(BIN)/clang-format --dry-run -Werror $(CXX_FILES))

# Compiles CUDA's kernels, for one architecture and without a GPU, and says what they take.
cuda-check: setup
	TORCH_SURFCAP_CUDA=alone TORCH_CUDA_ARCH_LIST=9.0 NVCC_APPEND_FLAGS=-Xptxas=-v \
	  $(BIN)/python setup.py -q build_ext --force --build-lib build/cuda > build/cuda.log
	@$(BIN)/python tests/kernel_resources.py < build/cuda.log

format: setup
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .
	$(if $(CXX_FILES),$(BIN)/clang-format -i $(CXX_FILES))

bench: setup
	$(BIN)/python train/bench.py --out docs/benchmarks.md

gpu-check:  # by PYTHON itself: where nothing can be installed there is no VENV
	$(if $(and $(DATA),$(RESULTS)),,$(error gpu-check: expected DATA=folder RESULTS=folder))
	@$(PYTHON) -m train.gpu_check --data "$(DATA)" --results "$(RESULTS)"
