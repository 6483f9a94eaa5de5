"""Loads the numbered scripts as modules (their names are no identifiers) and runs them: cli as a user would, fork
without the seconds that the imports take, inside in this process. Tiny decoders, flags of a tiny policy training."""
import importlib.util
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
import common

torch.set_num_threads(1)
S1, S2, S3, S4 = "01_make_dataset", "02_train_wetvae", "03_train_policy", "04_mpc_maze"


def script(name):
    spec = importlib.util.spec_from_file_location("stage_" + Path(name).name[:2], ROOT / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def robot_spec(name):
    return common.robot_spec(name)


def load_policy(out, experiment, seed):
    """A policy artifact as 03 and 04 use it."""
    return SimpleNamespace(**common.load(out, "policy", experiment, seed))


for number, name in (("s1", S1), ("s2", S2), ("s3", S3), ("s4", S4)):
    globals()[number] = pytest.fixture(lambda name=name: script(name), name=number)


@pytest.fixture(autouse=True)
def handlers():
    """Signals do what they did before: each stage's parse_flags sets them for its own process."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGPIPE)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


# ---------------------------------------------------------------- a tiny policy training

TINY = dict(updates=24, robots=8, skill_steps=5, episode=20, warm_up=80, replay=800, batch=16, hidden=16, reports=2,
            starts=4, noisy=2, traversal=3, single_run="1 4", multi_run="2 2", threads=1)


def tiny(out, **changed):
    """The flags of a tiny training in the folder out."""
    if changed.get("experiment") == "ant_dads":  # it predicts one step
        changed = dict(multi_run="1 4") | changed
    return [text for name, value in (TINY | changed | dict(out=out)).items() for text in (f"--{name}", str(value))]


@pytest.fixture
def out(tmp_path):
    """A folder with decoders, untrained: the three that 03 uses, and one of x and y."""
    three = ["speed", "direction", "curvature"]
    for name, x_dim, names in (("main", 2, three), ("full", 2, three), ("speed_acc", 1, ["speed", "acceleration"]),
                               ("polar", 2, ["x", "y"])):
        torch.manual_seed(0)
        common.save(tmp_path, "wetvae", name, 0, {}, decoder=common.Decoder(len(names), x_dim, 16),
                    names=names, relation=dict(curvature=0.2) if len(names) == 3 else {}, abs_corr=[0.9] * len(names),
                    ranges={name: (-1.0, 1.0) for name in names}, length=5)
    return tmp_path


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """A copy of robots/, used in place of ours."""
    shutil.copytree(ROOT / "robots", tmp_path / "tree/robots")
    monkeypatch.setattr(common, "HERE", tmp_path / "tree")
    return tmp_path / "tree"


@pytest.fixture
def inside(monkeypatch, capsys):
    """inside(stage, *flags) runs a stage's main in this process, without pictures: exit code, stdout, stderr."""
    def run(stage, *flags):
        monkeypatch.setattr(sys, "argv", [stage.__file__, *map(str, flags)])
        monkeypatch.setattr(common, "save_figure", lambda figure, *_: common.plt.close(figure))
        code, constants = 0, {name: value for name, value in vars(stage).items() if name.isupper()}
        try:
            stage.main()
        except SystemExit as end:
            code = end.code
        finally:
            vars(stage).update(constants)  # the next run begins as from a fresh file
        printed = capsys.readouterr()
        return SimpleNamespace(returncode=code, stdout=printed.out, stderr=printed.err)
    return run


def one_pass(stage, monkeypatch, train, fill=lambda replay: None, prepare=lambda log: None, passes=1):
    """`passes` steps of a training loop of stage 3 without SAC: what the last one hands to Sac.learn (batch, c, r),
    what was stored before it, the state of torch's random numbers where the first one began to learn, and its Log.
    fill(replay) stores steps, prepare(log) changes what was just made."""
    done = SimpleNamespace(batch=None, left=passes)

    class Replay(stage.Replay):
        def __init__(self, **widths):
            super().__init__(**widths)
            fill(self)

    class Log:
        def __init__(self, policy, robots, rng, replay, sac, *parts):
            self.policy, self.robots, self.replay, self.sac, self.parts = policy, robots, replay, sac, parts
            self.numbers, done.log = {}, self
            prepare(self)

        def step(self):
            done.left -= 1
            if not done.left:
                self.sac.updates = stage.UPDATES

    def learn(sac, batch, c, r):
        done.batch, done.c, done.r = batch, c, r
        return {}

    def normalise(sac, s):
        done.random = torch.get_rng_state()
        kept = min(done.log.replay.added, len(done.log.replay.table))
        done.stored = SimpleNamespace(**{name: part.clone() for name, part in
                                         vars(done.log.replay.read(slice(0, kept))).items()})
    for name, value in dict(Replay=Replay, Log=Log).items():
        monkeypatch.setattr(stage, name, value)
    for name, value in dict(learn=learn, normalise=normalise).items():
        monkeypatch.setattr(stage.Sac, name, value)
    train()
    return done


def one_line(done, *codes):
    """Whether a run ended with one line on stderr, and with one of the codes (any but 0)."""
    return done.returncode in (codes or (1, 2)) and len(done.stderr.strip().splitlines()) == 1


# ---------------------------------------------------------------- processes of their own

def cli(name, *flags, cwd=None, **env):
    """Run a script from the command line in a fresh process; returns the completed process with its text."""
    return subprocess.run([sys.executable, str(ROOT / f"{name}.py"), *map(str, flags)], capture_output=True, text=True,
                          env=os.environ | env, timeout=240, cwd=cwd)


SERVER = """
import json, os, runpy, signal, sys
import common, torch._dynamo  # all that a script imports, and what its first optimizer imports
for line in sys.stdin:
    argv, *streams = json.loads(line)
    if argv:
        child, code = os.fork(), None
        if not child:
            signal.alarm(600)  # nothing may hang
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
    """Runs a script like cli, but forked from a fresh Python that has imported torch, mujoco and matplotlib and done
    nothing else: a process of its own, to be interrupted and killed, without the time of imports. One at a time."""

    def __init__(self, folder):
        self.streams, self.code = [folder / "stdout", folder / "stderr"], 0
        self.server = subprocess.Popen([sys.executable, "-c", SERVER], stdin=subprocess.PIPE,
                                       stdout=subprocess.PIPE, text=True, env=os.environ | dict(PYTHONPATH=str(ROOT)))

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
