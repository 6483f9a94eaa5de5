"""Loads the numbered scripts as modules (their names are no identifiers) and runs them as a user would."""
import importlib.util
import itertools
import json
import os
import signal
import subprocess
import sys
import time
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


SERVER = """
import json, os, runpy, signal, sys
import common, torch._dynamo  # all that a script imports, and what its first optimizer imports
for line in sys.stdin:
    argv, *streams = json.loads(line)
    if argv:
        child, code = os.fork(), None
        if not child:
            signal.alarm(600)  # nothing may hang
            signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores Ctrl-C
            for number, path in enumerate(streams, 1):
                os.dup2(os.open(path, os.O_WRONLY), number)
            sys.stdout.reconfigure(line_buffering=True)
            sys.argv = argv
            runpy.run_path(argv[0], run_name="__main__")
            sys.exit()
    elif code is None:
        done, status = os.waitpid(child, *streams)
        code = os.waitstatus_to_exitcode(status) if done else None
    print(json.dumps([child, code]), flush=True)
"""


class Fork:
    """Runs a script like cli, but forked from a fresh Python that has imported torch, mujoco and matplotlib and done nothing else: a
    process of its own, to be interrupted and killed, without the seconds that the imports take. One at a time."""

    def __init__(self, folder):
        self.streams, self.code = [folder / "stdout", folder / "stderr"], 0
        self.server = subprocess.Popen([sys.executable, "-c", SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                                       env=os.environ | dict(PYTHONPATH=str(ROOT)))

    def ask(self, *request):
        print(json.dumps(request), file=self.server.stdin, flush=True)
        return json.loads(self.server.stdout.readline())

    def start(self, name, *flags):
        if self.code is None:  # a test failed and left it running
            self.end(signal.SIGKILL)
        for path in self.streams:
            path.write_text("")
        self.pid, self.code = self.ask([str(ROOT / f"{name}.py"), *map(str, flags)], *map(str, self.streams))

    def wait_for(self, condition):
        """Until something is so that the running script does; fails if it ends without."""
        for poll in itertools.count():
            if condition():
                return
            if poll % 100 == 99:
                _, self.code = self.ask(None, os.WNOHANG)
                assert self.code is None, self.end()
            time.sleep(0.001)

    def end(self, number=0):
        """Send a signal, or none, and wait for the end; returns what cli returns."""
        if self.code is None:
            os.kill(self.pid, number)
        _, self.code = self.ask(None, 0)
        return subprocess.CompletedProcess((), self.code, *(path.read_text() for path in self.streams))

    def __call__(self, name, *flags):
        self.start(name, *flags)
        return self.end()

    def close(self):
        self.server.communicate()  # its stdin ends, and so does it


@pytest.fixture(scope="session")
def fork(tmp_path_factory):
    fork = Fork(tmp_path_factory.mktemp("fork"))
    yield fork
    fork.close()
