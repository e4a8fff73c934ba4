"""A pytest plugin that loads the library of the emulated kernels, SURFCAP_EMULATED, as torch_surfcap._C:

SURFCAP_EMULATED=LIBRARY python -m pytest -p tests.emulation.plugin tests/ops
"""

from __future__ import annotations

import importlib.util
import os
import sys
from importlib.machinery import ExtensionFileLoader

import torch  # noqa: F401  (the library needs its symbols)

NAME = "torch_surfcap._C"


def pytest_configure() -> None:
    if NAME in sys.modules:
        raise ImportError(f"{NAME} is loaded already, expected this plugin to come first")
    spec = importlib.util.spec_from_loader(NAME, ExtensionFileLoader(NAME, os.environ["SURFCAP_EMULATED"]))
    assert spec is not None
    assert spec.loader is not None
    sys.modules[NAME] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules[NAME])
