"""What two or more stages share: decoder, relation functions, weak labels, robots, actor, execution.

Units: metres, radians, environment steps of 0.05 s. Decoder displacements are in trajectory units: 1 is the
highest speed of the data. `scale` makes them metres a step (Ant 1/10, Half-Cheetah 1/5, A.1.3; DADS: learnt).
The lines of Alg. 2 are counted from "for i"; each "end" is one.
"""
import argparse
import contextlib
import csv
import ctypes.util
import decimal
import hashlib
import io
import json
import math
import os
import re
import shlex
import signal
import sys
import tokenize
from pathlib import Path
from typing import Annotated, get_args, get_origin

os.environ["MPLBACKEND"] = "Agg"  # a notebook's backend would fail here
if sys.platform == "linux":  # before mujoco loads: without a screen its default, GLFW, aborts
    os.environ["MUJOCO_GL"] = "egl" if ctypes.util.find_library("EGL") else "disable"

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import nn
from torch.utils._pytree import tree_leaves

# Types of constants: least, most, in words
Whole = Annotated[int, 0, 2 ** 63 - 1, "a whole number of at least 0, below 2 ** 63"]  # what int means here
Count = Annotated[int, 1, 2 ** 63 - 1, "a whole number of at least 1"]
Threads = Annotated[int, 1, 1024, "a whole number of at least 1, at most 1024"]
Number = Annotated[float, 0, 1e30, "a number of at least 0, at most 1e30"]  # what float means here
Positive = Annotated[float, 1e-30, 1e30, "a number above 0, at most 1e30"]
Signed = Annotated[float, -1e30, 1e30, "a number"]
AsWritten = Annotated[lambda n: int(n) if n == int(n) else float(n), -1e30, 1e30, "a number"]
Share = Annotated[float, 0, 1, "a number from 0 to 1"]
Degrees = Annotated[float, 0, 180, "a number from 0 to 180"]

SINGLE = ("speed", "direction")  # factors of z_single, Sec. 4.2.2
MULTI = dict(curvature="direction", acceleration="speed")  # factors of z_multi, and what they change in time
CLASSES = dict(speed=4, direction=4, curvature=3, acceleration=3, x=4, y=4)  # of labels, App. A.1.1, A.3.1
FRAME_SKIP: Count = 5     # physics steps of 0.01 s per environment step
FEEDBACK: Share = 0.2     # closed loop: share of (reference - place) added to a command (the paper: 0)
CORRECTION: float = 0.2   # closed loop: the most that is added, trajectory units
FORMAT = 5                # of the artifacts; raise it when their meaning changes
HERE = Path(__file__).resolve().parent
SCRIPT = {"dataset": "01_make_dataset.py", "wetvae": "02_train_wetvae.py", "policy": "03_train_policy.py"}


# -------- weak labels, App. A.1.1

def weak_labels(factors, names, ranges):
    """Weak labels, App. A.1.1, A.3.1, Fig 9: factors {name: (N,)}, ranges {name: (low, high)} -> (N, M) int64
    classes from 0. Curvature, acceleration: zero, positive, negative; others: equal parts of their range."""
    labels = []
    for name in names:
        if name in MULTI:
            # 0 zero, 1 positive, 2 negative: in A.1.1's example -10 degrees is class three (its list,
            # "straight, right, left", then counts angles clockwise)
            labels.append(np.sign(factors[name]).astype(int) % 3)
        else:
            labels.append(np.digitize(factors[name], np.linspace(*ranges[name], CLASSES[name] + 1)[1:-1]))
        if name == "direction":  # the first class has the largest angles: in the example 40 degrees is two
            labels[-1] = CLASSES[name] - 1 - labels[-1]
    return np.stack(labels, 1)


# -------- the decoder p_theta(tau | z), Fig 1

class Decoder(nn.Module):
    """p_theta(tau | z), Fig 1: an LSTM over z and its own last mean -> a Gaussian over the next displacement.
    No teacher forcing: the true past, as in Eq. 3, could show the factors after two steps, without z."""

    def __init__(self, z_dim, x_dim, hidden):
        super().__init__()
        self.arguments = (z_dim, x_dim, hidden)
        self.x_dim = x_dim
        self.cell = nn.LSTMCell(x_dim + z_dim, hidden)
        self.head = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 2 * x_dim))
        self.register_buffer("axes", torch.eye(z_dim))  # z -> latents: a signed permutation, set in stage 02

    def forward(self, z, steps):
        """Skills z (B, M): axis m is factor m, and + is more of it. Means and log-variances as below."""
        return self.decode_latents(z @ self.axes, steps)

    def decode_latents(self, latents, steps):
        """Latents (B, M), in the order and with the signs that training found -> mean and log-variance of the
        displacements, (B, steps, x_dim) each, trajectory units."""
        mean, state, out = latents.new_zeros(len(latents), self.x_dim), None, []
        for _ in range(steps):
            state = self.cell(torch.cat([mean, latents], 1), state)
            out.append(self.head(state[0]))
            mean = out[-1][:, :self.x_dim]
        return torch.stack(out, 1).chunk(2, 2)


# -------- relation functions and commands, Sec. 4.2.2

def next_skill(z, names, relation):
    """The relation functions f, Sec. 4.2.2, 6.1.2, A.3.2: z (B, M) of one transition -> of the next. names
    of the axes; relation {factor of z_multi: weight} (the paper: -0.2, -0.1, by hand; its axes have other
    signs)."""
    z = z.clone()
    for factor, weight in relation.items():
        i = names.index(MULTI[factor])
        change = weight * z[:, names.index(factor)]
        if factor == "acceleration" and "direction" not in names:
            change = change * z[:, i].sign()  # f_speed of App. A.3.2: in one dimension a speed has a sign
        z[:, i] += change  # f_dir or f_speed
    return z


@torch.no_grad()
def commands_of(policy, z, steps):
    """The commands of skills z (B, M) in `steps` transitions: (B, steps, c_dim), trajectory units. WEDIS: the
    decoder's first displacement for (z_single, 0), then f^m, and so on. SeCTAR: its decoder's displacements.
    DADS: z itself."""
    if policy.method == "dads":
        return z[:, None].expand(-1, steps, -1)
    if policy.method == "sectar":
        return policy.decoder(z, steps)[0]
    is_single = torch.tensor([name in SINGLE for name in policy.names])
    singles = []
    for _ in range(steps):
        singles.append(z * is_single)  # (z_single, 0): Alg. 2, line 12, in later transitions line 18
        z = next_skill(z, policy.names, policy.relation)  # Alg. 2, line 17
    mean, _ = policy.decoder(torch.cat(singles), 1)  # (steps * B, 1, c_dim)
    return mean.view(steps, len(z), -1).transpose(0, 1)


# -------- robots

def robot_spec(robot):
    """The model of a robot, "ant" or "half_cheetah", to be compiled."""
    return mujoco.MjSpec.from_file(str(HERE / "robots" / f"{robot}.xml"))


class Robots:
    """n robots of one model (ant.xml: nq 15, nv 14, nu 8; half_cheetah.xml: 9, 9, 6) that step together on
    threads; equal to a loop over mj_step. In the plane a robot has the places x and y, on a rail x alone."""

    def __init__(self, spec, n, threads=1):
        model = spec.compile()
        self.batch = Batch(model, n, threads)
        self.places = 2 if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE else 1
        self.step_seconds = FRAME_SKIP * model.opt.timestep
        self.qpos, self.qvel, self.ctrl, self.time = map(self.batch.bind, ("qpos", "qvel", "ctrl", "time"))
        self.reset(np.arange(n))

    def reset(self, ids, rng=None):
        """Robots ids at the origin at rest; with rng, plus U(-0.1, 0.1) on qpos and N(0, 0.1^2) on qvel."""
        self.batch.reset(ids, keyframe=0, stage=mujoco.mjtStage.mjSTAGE_NONE)  # warm start and warnings too
        if rng is not None:
            self.qpos[ids] += rng.uniform(-0.1, 0.1, (len(ids), self.qpos.shape[1]))
            self.qvel[ids] = rng.normal(0, 0.1, (len(ids), self.qvel.shape[1]))

    def place(self):
        """Places (n, 2 or 1) in metres. Float32."""
        return torch.from_numpy(self.qpos[:, :self.places]).float()

    def observe(self):
        """The policy's state, App. A.1.3: qpos without the place, then qvel. Ant (n, 27): height, quaternion
        (4), joints (8), velocity (3), turning rates (3), joint speeds (8). Half-Cheetah (n, 17)."""
        return torch.from_numpy(np.concatenate([self.qpos[:, self.places:], self.qvel], 1)).float()

    def age(self):
        """Environment steps of each robot's episode so far, (n, 1)."""
        return torch.from_numpy(np.rint(self.time / self.step_seconds)).float()[:, None]

    def step(self, action):
        """One environment step. action (n, nu) in [-1, 1]. Returns displacement (n, 2 or 1) in metres, and
        which robots were unstable since their reset (n,): their displacement means nothing."""
        before = self.qpos[:, :self.places].copy()
        self.ctrl[:] = action
        self.batch.step(nstep=FRAME_SKIP)
        unstable = self.batch.warning.any((1, 2))
        return torch.from_numpy(self.qpos[:, :self.places] - before).float(), unstable


# -------- the skill policy pi_psi(a | s, c), Sec. 4.2.1

def rotate(v, angle):
    """Vectors (B, 2) turned counter-clockwise by angle (B,)."""
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([cos * v[:, 0] - sin * v[:, 1], sin * v[:, 0] + cos * v[:, 1]], 1)


def to_base_frame(s, c):
    """State (B, 27) of Robots.observe and command (B, 2), turned back by the heading -> (B, 26), (B, 2).
    The dynamics do not depend on the heading: what is learnt for one holds for all."""
    half = torch.atan2(s[:, 4], s[:, 1])  # half the heading, from w and z of the quaternion s[:, 1:5]
    upright = torch.hypot(s[:, 1], s[:, 4])[:, None]
    tilt = rotate(s[:, 2:4], -half)  # a quaternion is heading times tilt: its x and y turn by half
    velocity = rotate(s[:, 13:15], -2 * half)
    rest = s[:, 15:]  # vertical velocity, and speeds that MuJoCo gives in the torso's or the joints' frames
    return torch.cat([s[:, :1], upright, tilt, s[:, 5:13], velocity, rest], 1), rotate(c, -2 * half)


def layers(n_in, hidden, n_out):
    """Two hidden layers with ReLU, App. A.1.3."""
    return nn.Sequential(nn.Linear(n_in, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(),
                         nn.Linear(hidden, n_out))


class Actor(nn.Module):
    """pi_psi(a | s, c): a Gaussian squashed by tanh. Command c: the displacement that the decoder predicts
    for z_single, in trajectory units (the paper: z_single itself, Sec. 4.2.2)."""

    def __init__(self, s_dim, c_dim, a_dim, hidden, base_frame):
        super().__init__()
        self.arguments = (s_dim, c_dim, a_dim, hidden, base_frame)
        self.base_frame = base_frame
        s_dim -= base_frame  # without the heading a quaternion has three numbers
        self.net = layers(s_dim + c_dim, hidden, 2 * a_dim)
        self.register_buffer("s_mean", torch.zeros(s_dim))
        self.register_buffer("s_std", torch.ones(s_dim))

    def inputs(self, s, c):
        """What all networks read, (B, 26 + 2): state and command in the base frame, the state normalised."""
        if self.base_frame:
            s, c = to_base_frame(s, c)
        return torch.cat([((s - self.s_mean) / self.s_std).clamp(-10, 10), c], 1)

    def forward(self, x, deterministic=False):
        """x of inputs -> action (B, a_dim) in (-1, 1), log-probability (B,)."""
        mean, log_std = self.net(x).chunk(2, 1)
        log_std = log_std.clamp(-5, 2)
        noise = torch.zeros_like(mean) if deterministic else torch.randn_like(mean)
        u = mean + log_std.exp() * noise
        # log pi(a) = log N(u) - sum log(1 - tanh(u)^2), in a form that does not overflow for large |u|
        log_prob = -0.5 * noise ** 2 - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = log_prob - 2 * (math.log(2) - u - nn.functional.softplus(-2 * u))
        return torch.tanh(u), log_prob.sum(1)

    @torch.no_grad()
    def act(self, s, c, deterministic=False):
        """Action (B, a_dim) for state s (B, s_dim) and command c (B, c_dim)."""
        return self(self.inputs(s, c), deterministic)[0]


# -------- execution of skills, Alg. 2, lines 13 to 16 and 19

def closed_loop(c, reference, robots, scale):
    """Commands (n, 2 or 1), trajectory units: c plus FEEDBACK * (reference - place) / scale, shortened to
    CORRECTION; reference and place in metres."""
    correction = FEEDBACK * (reference - robots.place()) / scale
    size = correction.norm(dim=1, keepdim=True)
    return c + correction * (CORRECTION / size.clamp(min=max(CORRECTION, 1e-9)))  # 0 switches it off


def execute(policy, robots, commands, hold, closed, deterministic):
    """Alg. 2, lines 13 to 16: hold each command (n, T, c_dim) for `hold` (H_z) steps. closed: feedback to
    a reference, which moves by each command. deterministic: mean actions. Returns the poses after each step,
    (T * hold, n, nq)."""
    reference, poses, unstable = robots.place(), [], np.zeros(0, bool)
    for c in commands.unbind(1):  # line 13
        for _ in range(hold):  # line 14
            asked = closed_loop(c, reference, robots, policy.scale) if closed else c
            a = policy.actor.act(robots.observe(), asked, deterministic)  # line 15
            _, unstable = robots.step(a.numpy())
            reference = reference + policy.scale * c
            poses.append(robots.qpos.copy())
    if unstable.any():  # since their last reset
        print(f"{unstable.sum()} of {len(unstable)} simulations were unstable: these robots began anew")
    return np.reshape(poses, (-1, *robots.qpos.shape))


# ======== not needed to understand the method

# -------- factors of trajectories, and how purely an axis means one

def factors_of(displacement, names):
    """The factors in names of trajectories: displacement (N, T, 2 or 1) -> {name: (N,)}. Speed: the mean
    (with acceleration: the first), on a rail with a sign; direction: the first, radians; curvature: radians
    per transition; x, y: the mean; acceleration: per transition, as a share of the speed."""
    turns = max(displacement.shape[1] - 1, 1)
    size = np.linalg.norm(displacement, axis=2) if displacement.shape[2] == 2 else displacement[..., 0]
    found = dict(speed=size.mean(1))
    if "acceleration" in names:
        found["speed"] = size[:, 0]
        gain = (size[:, -1] - size[:, 0]) / turns * np.sign(size[:, 0])
        found["acceleration"] = gain / np.maximum(abs(size[:, 0]), 0.1)
    if displacement.shape[2] == 2:
        heading = np.unwrap(np.arctan2(displacement[..., 1], displacement[..., 0]))
        found["direction"], found["curvature"] = heading[:, 0], (heading[:, -1] - heading[:, 0]) / turns
        found["x"], found["y"] = displacement.mean(1).T
    return {name: found[name] for name in names}


def spread(values, name):
    """Range of a factor's values (n,); for directions, which are on a circle, 2 pi less the largest gap."""
    if name != "direction":
        return np.ptp(values)
    angles = np.sort(values % (2 * math.pi))
    return 2 * math.pi - np.diff(angles, append=angles[0] + 2 * math.pi).max()


def cross_talk(curves, ranges):
    """Cross-talk C (axes, factors): range of factor j along axis i / its range in the data, and the purity of
    each axis, C[i, i] / sum_j C[i, j], or nan if it is dead, its whole row below 0.1. curves: for each axis
    the factors {name: (n,)} along its traversal; ranges: {name: (low, high)}."""
    C = np.array([[spread(curve[name], name) / np.ptp(limits) for name, limits in ranges.items()]
                  for curve in curves])
    return C, np.where(C.max(1) < 0.1, math.nan, C.diagonal() / C.sum(1).clip(1e-9))


# -------- flags

def stop(message, code=2):
    """End with one line on stderr. Code 2: the input is wrong; 1: the run failed."""
    print(f"{Path(sys.argv[0]).name}: {message}", file=sys.stderr)
    raise SystemExit(code)


def convert(value, kind, name):
    """A flag's text, or what a file or a row says, as its declared type. Exits with 2 if it does not fit."""
    text = str(value).strip()
    if kind is str:
        return text
    if kind is bool and text.lower() in ("true", "false", "1", "0"):
        return text.lower() in ("true", "1")
    if get_origin(kind) is tuple:
        parts, kinds = text.replace(",", " ").strip("()[] ").split(), get_args(kind)
        count = len(kinds)
        if kinds[-1] is Ellipsis:  # one or more
            kinds, count = kinds[:1] * len(parts), max(len(parts), 1)
        if len(parts) != count:
            stop(f"{name} is {value!r}, but must be {count} numbers, as in \"{' '.join('1' * count)}\"")
        return tuple(convert(part, one, name) for part, one in zip(parts, kinds))
    words = "true or false"
    if kind is not bool:
        base, least, most, words = get_args({int: Whole, float: Number}.get(kind, kind))
        with contextlib.suppress(decimal.InvalidOperation):  # exact: a float would round a long seed
            number = decimal.Decimal(text)
            if number.is_finite() and least <= number <= most and not (base is int and number % 1):
                return base(number)
    stop(f"{name} is {value!r}, but must be {words}")


def types_of(module):
    """{NAME: type} of the constants of a file, in its order; guessed if a reader has left it out."""
    declared = module.get("__annotations__") or module["__annotate__"](1)  # Python 3.14 makes them by a call
    guess = {bool: bool, str: str, int: AsWritten, float: AsWritten, tuple: tuple[AsWritten, ...]}
    return {name: declared.get(name) or guess[type(value)] for name, value in module.items()
            if name in declared or name.isupper() and name not in globals() and type(value) in guess}


def parse_flags(stage, argv=None):
    """Make each constant with a declared type, `NAME: type = value  # comment`, at the top of a stage (its
    globals()) a flag --name, and set it. A row of EXPERIMENTS overrides the file, a flag both. Returns
    {NAME: value}, and the flags' alone. Exits with 2, in one line, if a name or a value does not fit."""
    again = "; --resume true goes on from the last checkpoint" if "RESUME" in stage else ""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop("stopped" + again, 1))
    if hasattr(signal, "SIGPIPE"):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # piped into head
    kinds = types_of(stage)
    parser = argparse.ArgumentParser(description=stage["__doc__"], allow_abbrev=False,
                                     argument_default=argparse.SUPPRESS,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: stop(f"{message}; see --help")
    with open(stage["__file__"], "rb") as file:  # comments, for --help alone
        comments = {token.line.replace("=", ":").partition(":")[0].rstrip(): token.string.lstrip("# ")
                    for token in tokenize.tokenize(file.readline) if token.type == tokenize.COMMENT}
    for name in kinds:
        text = f"{comments.get(name, '')} [{stage[name]}]".replace("%", "%%")
        parser.add_argument("--" + name.lower(), dest=name, metavar="VALUE", help=text)
    parser._negative_number_matcher = re.compile(r"-[\d.]")  # argparse takes -1e2 for a flag
    given = vars(parser.parse_args(argv))
    row = {}
    if "EXPERIMENTS" in stage:
        experiment, rows = given.get("EXPERIMENT", stage["EXPERIMENT"]), stage["EXPERIMENTS"]
        if experiment not in rows:
            stop(f"unknown experiment {experiment!r}; allowed: {' '.join(rows)}")
        row = rows[experiment]
        if unknown := set(row) - set(kinds):
            stop(f"{unknown.pop()} in the row {experiment!r} of EXPERIMENTS is no constant of this file")
    values = {name: stage[name] for name in kinds} | row | given
    config = {name: convert(values[name], kind, "--" + name.lower()) for name, kind in kinds.items()}
    stage.update(config)
    for name, kind in types_of(globals()).items():  # common.py's own
        globals()[name] = convert(globals()[name], kind, f"{name} in common.py")
    write_whole(Path(stage["OUT"]) / f".can_write_{os.getpid()}", b"").unlink()  # before any work is lost
    return config, {name: config[name] for name in given}


def need_memory(size, mend):
    """Exits with 2 if the machine has fewer than `size` bytes of memory. mend: what to make smaller."""
    if hasattr(os, "sysconf") and size > os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"):
        stop(f"this needs {size / 1e9:.3g} GB of memory, more than this machine has: lower {mend}")


# -------- artifacts and CSV

def made_by(config):
    """All that makes a result: a stage's constants, common.py's, and the robots' files."""
    own = dict(FRAME_SKIP=FRAME_SKIP, FEEDBACK=FEEDBACK, CORRECTION=CORRECTION, CLASSES=CLASSES)
    files = {name: hashlib.sha256((HERE / "robots" / name).read_bytes()).hexdigest()[:16]
             for name in ("ant.xml", "half_cheetah.xml")}
    return config | own | files


def digest(values):
    """Eight hexadecimal digits that stand for {name: value}."""
    return hashlib.sha256(repr(sorted(values.items())).encode()).hexdigest()[:8]


def write_whole(path, data):
    """Write bytes to path, whole or not at all, under a name that no other process uses. Returns path."""
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(partial, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())  # or a power cut may leave an empty file
        os.replace(partial, path)  # atomic
    except OSError as error:
        stop(f"cannot write {path}: {error.strerror}; free the space or choose another --out", code=1)
    finally:  # left by a full disk, or by whoever stops the program
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
    return path


def artifact_name(kind, experiment, seed):
    return f"{kind}_{experiment}_seed{seed}" + (".npz" if kind == "dataset" else ".pt")


def save(out, kind, experiment, seed, config, **content):
    """Write an artifact, then the 32 bytes of its SHA-256. content: arrays (dataset), or tensors, plain
    values and networks. Returns its path."""
    meta = dict(format=FORMAT, kind=kind, experiment=experiment, seed=seed, config=made_by(config),
                versions=dict(torch=str(torch.__version__), mujoco=mujoco.__version__, numpy=np.__version__))
    buffer = io.BytesIO()
    if kind == "dataset":
        np.savez(buffer, meta=json.dumps(meta), **content)
    else:
        networks = {name: part for name, part in content.items() if isinstance(part, nn.Module)}
        for name, net in networks.items():  # as plain values: reading a file must not run code
            content[name] = dict(network=type(net).__name__, arguments=net.arguments, state=net.state_dict())
        torch.save(meta | content, buffer)
    data, path = buffer.getvalue(), Path(out) / artifact_name(kind, experiment, seed)
    return write_whole(path, data + hashlib.sha256(data).digest())


def load(out, kind, experiment, seed, **same):
    """Read an artifact from <out>/, else pretrained/, and say which. Returns its content and "sha256". Exits
    with 2 if it is missing, damaged, foreign, not finite, or made with other constants than those of same."""
    name, stage = artifact_name(kind, experiment, seed), SCRIPT[kind.partition("-")[0]]
    make = "make it with: " + shlex.join(["python", stage, "--seed", str(seed), "--experiment", experiment,
                                          "--out", str(out)])
    paths = [path for path in (Path(out) / name, HERE / "pretrained" / name) if path.exists()]
    if not paths:
        stop(f"no {name} in {out}/ or pretrained/; {make}")
    path, data = paths[0], paths[0].read_bytes()
    if hashlib.sha256(data[:-32]).digest() != data[-32:]:
        stop(f"{path} is damaged or is no artifact of this project; {make}")
    if kind == "dataset":
        content = dict(np.load(io.BytesIO(data), allow_pickle=False))
        content |= json.loads(str(content.pop("meta")))
    else:
        content = torch.load(io.BytesIO(data[:-32]), weights_only=True)
    made = content["config"] | content
    for key, value in (dict(format=FORMAT, kind=kind, experiment=experiment, seed=seed) | same).items():
        if made.get(key) != value:
            mend = f"set {key} back, or {make}, and the flags of this run" if key.isupper() else make
            stop(f"{path} was made with {key} = {made.get(key)}, not {value}: {mend}")
    numbers = [np.asarray(leaf) for leaf in tree_leaves(content) if not isinstance(leaf, str)]
    if not all(np.isfinite(leaf).all() for leaf in numbers if leaf.dtype.kind == "f"):
        stop(f"{path} holds numbers that are not finite; {make}")
    for name, part in content.items():
        if isinstance(part, dict) and "network" in part:
            network = dict(Decoder=Decoder, Actor=Actor)[part["network"]](*part["arguments"])
            network.load_state_dict(part["state"])
            content[name] = network.requires_grad_(False)
    print(f"using {path.relative_to(HERE) if path.is_relative_to(HERE) else path}")
    return content | dict(sha256=data[-32:].hex())


def update_csv(path, rows, key):
    """Write rows (dicts), in place of those in the file that agree with one of them on the columns in key.
    Returns them as text, as read_csv does."""
    new = [{k: f"{v:.6g}" if isinstance(v, float) else str(v) for k, v in row.items()} for row in rows]
    replaced = {tuple(row[k] for k in key) for row in new}
    with contextlib.ExitStack() as at_the_end:  # seeds trained side by side share a file: lock its folder
        try:
            import fcntl
            path.parent.mkdir(parents=True, exist_ok=True)
            folder = os.open(path.parent, os.O_RDONLY)
            at_the_end.callback(os.close, folder)
            fcntl.flock(folder, fcntl.LOCK_EX)
        except (ImportError, OSError) as error:  # Windows; some network drives
            print(f"{path} is not locked ({error}): let no other run write it now")
        old = read_csv(path) if path.exists() else []
        rows = [row for row in old if tuple(row.get(k) for k in key) not in replaced] + new
        text = io.StringIO()
        columns = dict.fromkeys(name for row in rows for name in row)
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_whole(path, text.getvalue().encode())
    return new


def read_csv(path):
    """The rows of a table (dicts of text). Exits with 2 if a spreadsheet has saved it in another form."""
    text = path.read_text(encoding="utf-8-sig", errors="replace")  # with or without a byte order mark
    rows = list(csv.DictReader(text.splitlines()))
    if "\ufffd" in text or not all(len(row) > 1 and None not in (*row, *row.values()) for row in rows):
        stop(f"{path} is no table with commas in UTF-8 any more: save it so, or move it away")
    return rows


BLUE, RED, GREY = "#0072B2", "#D55E00", "#888888"
plt.rcdefaults()  # a reader's matplotlibrc may ask for TeX
plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
                     "grid.alpha": 0.25, "figure.dpi": 110, "savefig.bbox": "tight", "legend.frameon": False,
                     "axes.titlesize": 10, "figure.constrained_layout.use": True})


def save_figure(figure, out, name):
    """Write <out>/figures/<name>.png."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    plt.close(figure)
    print(f"wrote {write_whole(Path(out) / 'figures' / f'{name}.png', buffer.getvalue())}")
