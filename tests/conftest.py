"""Loads the numbered scripts as modules (their names are no identifiers) and runs them as a user would."""
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
torch.set_num_threads(2)


def script(name):
    spec = importlib.util.spec_from_file_location("stage_" + name[:2], ROOT / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


for number, name in (("s1", "01_make_dataset"), ("s2", "02_train_wetvae"), ("s3", "03_train_policy"), ("s4", "04_mpc_maze")):
    globals()[number] = pytest.fixture(lambda name=name: script(name), name=number)


def cli(name, *flags, **env):
    """Run a script from the command line in a fresh process; returns the completed process with its text."""
    return subprocess.run([sys.executable, str(ROOT / f"{name}.py"), *map(str, flags)], capture_output=True, text=True,
                          env=os.environ | env, timeout=240)
