"""What two or more stages share. Units: trajectory units for decoder displacements (a fast transition is 1),
metres and radians in the world, `scale` metres per trajectory unit and environment step of 0.05 s.
"""
import argparse
import contextlib
import csv
import ctypes.util
import hashlib
import io
import json
import math
import os
import re
import signal
import sys
from pathlib import Path

os.environ["MPLBACKEND"] = "Agg"  # a notebook's backend would fail here
if sys.platform == "linux":  # before mujoco loads: GLFW aborts without a screen
    os.environ.setdefault("MUJOCO_GL", "egl" if ctypes.util.find_library("EGL") else "disable")

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import nn
from torch.utils._pytree import tree_leaves

SINGLE = ("speed", "direction")  # factors of z_single, Sec. 4.2.2
MULTI = dict(curvature="direction", acceleration="speed")  # factors of z_multi, and what they change in time
CLASSES = dict(speed=4, direction=4, curvature=3, acceleration=3, x=4, y=4)  # of labels, App. A.1.1, A.3.1
FRAME_SKIP = 5     # physics steps of 0.01 s per environment step
FEEDBACK = 0.1     # closed loop: share of the distance to the reference added to a command (the paper: 0)
CORRECTION = 0.2   # at most so much, trajectory units
FASTEST = 1.0      # its longest command: much longer ones make falls
SOFT_START = 20    # environment steps over which the longest command grows from 0.2 to FASTEST
FORMAT = 3         # of the artifacts; raise it when their meaning changes
HERE = Path(__file__).resolve().parent
SCRIPT = {"dataset": "01_make_dataset.py", "wetvae": "02_train_wetvae.py", "policy": "03_train_policy.py"}


# -------- command line

def stop(message, code=2):
    """End with one line on stderr. Code 2: the input is wrong; 1: the run failed."""
    print(f"{Path(sys.argv[0]).name}: {message}", file=sys.stderr)
    raise SystemExit(code)


def convert(value, like, name, least=0):
    """value (a flag's text, or what a row says) -> the type of `like`. Exits with 2 if it does not fit: whole
    numbers are at least 1 (seeds and ports 0), others at least `least`."""
    kind, text = type(like), str(value).lower()
    if kind is str:
        return str(value)
    if kind is bool and text in ("true", "false"):
        return text == "true"
    if kind is tuple:
        parts = value if isinstance(value, (tuple, list)) else text.split()
        if len(parts) == len(like):
            likes = [0.0 if "." in str(part) else one for part, one in zip(parts, like)]
            return tuple(convert(part, one, name, -1e9) for part, one in zip(parts, likes))
    if kind is int and least == 0 and not name.lower().endswith(("seed", "seeds", "port")):
        least = 1
    with contextlib.suppress(ValueError):
        number = float(text)
        if kind in (int, float) and least <= number < math.inf and number == kind(number):
            return kind(number)
    bound = f" of at least {least}" * (least >= 0)
    kinds = {bool: "true or false", int: f"a whole number{bound}, like {like} in the file",
             float: f"a number{bound}", tuple: f"{np.size(like)} numbers"}
    stop(f"{name} is {value!r}, but must be {kinds[kind]}")


def parse_flags(stage, argv=None):
    """Make each `NAME = value # comment` at the top of a stage (its globals()) a flag --name, and set it. A
    row of EXPERIMENTS overrides it, a flag both. Returns {NAME: value}, and the flags' alone."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop("stopped; 02 and 03 go on with --resume true", 1))
    if hasattr(signal, "SIGPIPE"):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # piped into head
    parser = argparse.ArgumentParser(description=stage["__doc__"], allow_abbrev=False,
                                     argument_default=argparse.SUPPRESS,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: stop(f"{message}; see --help")
    likes, source = {}, Path(stage["__file__"]).read_text(encoding="utf-8")
    for name, text, comment in re.findall(r"^([A-Z_]+) = (.*?)(?:  +# (.*))?$", source, re.MULTILINE):
        like = stage[name]
        if isinstance(like, float) and like.is_integer() and "." not in text:
            like = int(like)  # 1e4, 512 / 2
        if isinstance(like, (bool, int, float, str, tuple)):
            likes[name] = like
            parser.add_argument("--" + name.lower(), dest=name, metavar=type(like).__name__,
                                help=f"{comment} [{like}]".replace("%", "%%"))
    given = vars(parser.parse_args(argv))
    experiment, rows = given.get("EXPERIMENT", stage["EXPERIMENT"]), stage["EXPERIMENTS"]
    if experiment not in rows:
        stop(f"unknown experiment {experiment!r}; allowed: {' '.join(rows)}")
    if unknown := set(rows[experiment]) - set(stage):
        stop(f"{' '.join(unknown)} in the row {experiment!r} of EXPERIMENTS is no constant of this file")
    stage.update(rows[experiment] | given)
    config = {name: convert(stage[name], like, "--" + name.lower()) for name, like in likes.items()}
    stage.update(config)
    write_whole(Path(stage["OUT"]) / f".can_write_{os.getpid()}", b"").unlink()  # before any work is lost
    return config, {name: config[name] for name in given}


# -------- artifacts and CSV

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
    meta = dict(format=FORMAT, kind=kind, experiment=experiment, seed=seed, config=config,
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
    name = artifact_name(kind, experiment, seed)
    row = f"{experiment} or its beginning" if kind == "wetvae" else experiment  # 02: <row>_<model>
    make = f"make it with: python {SCRIPT[kind.partition('-')[0]]} --seed {seed} --experiment {row}"
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
            stop(f"{path} has {key} = {made.get(key)}, not {value}: give the same, or {make}")
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
    """Write rows (dicts), in place of those in the file that agree with one of them on the columns in key."""
    new = [{k: f"{v:.6g}" if isinstance(v, float) else str(v) for k, v in row.items()} for row in rows]
    replaced = {tuple(row[k] for k in key) for row in new}
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(f"{path}.lock", "w") as lock:  # seeds trained side by side share a file
        if os.name == "posix":  # Windows has no fcntl
            import fcntl
            fcntl.flock(lock, fcntl.LOCK_EX)
        old = read_csv(path) if path.exists() else []
        rows = [row for row in old if tuple(row.get(k) for k in key) not in replaced] + new
        text = io.StringIO()
        columns = dict.fromkeys(name for row in rows for name in row)
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_whole(path, text.getvalue().encode())


def read_csv(path):
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


# -------- weak labels and factors

def weak_labels(factors, names, ranges):
    """Weak labels, App. A.1.1, A.3.1, Fig 9: factors {name: (N,)}, ranges {name: (low, high)} -> (N, M) int64
    classes from 0. Curvature, acceleration: zero, positive, negative; the others: parts of their range."""
    labels = []
    for name in names:
        if name in MULTI:
            labels.append(np.sign(factors[name]).astype(int) % 3)  # 0, 1, 2
        else:
            labels.append(np.digitize(factors[name], np.linspace(*ranges[name], CLASSES[name] + 1)[1:-1]))
        if name == "direction":  # the first class has the largest angles
            labels[-1] = CLASSES[name] - 1 - labels[-1]
    return np.stack(labels, 1)


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


# -------- decoder, robot, actor, execution

def layers(n_in, hidden, n_out):
    """Two hidden layers with ReLU."""
    return nn.Sequential(nn.Linear(n_in, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(),
                         nn.Linear(hidden, n_out))


class Decoder(nn.Module):
    """p_theta(tau | z), Fig 1: an LSTM over z and its own last mean -> a Gaussian over the next displacement.
    The trap: a decoder that reads the true last displacement needs no z, and z stays entangled. circle: index
    of a latent that is an angle, a whole turn from -1.5 to 1.5."""

    def __init__(self, z_dim, x_dim, hidden, circle=None):
        super().__init__()
        self.arguments = (z_dim, x_dim, hidden, circle)
        self.x_dim, self.circle = x_dim, circle
        self.cell = nn.LSTMCell(x_dim + z_dim + (circle is not None), hidden)
        self.head = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 2 * x_dim))
        self.register_buffer("axes", torch.eye(z_dim))  # canonical z -> latents: a signed permutation

    def forward(self, z, steps):
        """unroll for canonical z (B, M): axis m is factor m, + is more of it. z_single is (z_single, 0)."""
        return self.unroll(z @ self.axes[:z.shape[1]], steps)

    def unroll(self, z, steps):
        """Latents z of training (B, M) -> mean and log-variance of displacements, (B, steps, x_dim) each."""
        i = self.circle
        if i is not None:
            z = torch.cat([z[:, :i], on_circle(z[:, i]), z[:, i + 1:]], 1)
        mean, state, out = z.new_zeros(len(z), self.x_dim), None, []
        for _ in range(steps):
            state = self.cell(torch.cat([mean, z], 1), state)
            out.append(self.head(state[0]))
            mean = out[-1][:, :self.x_dim]
        return torch.stack(out, 1).chunk(2, 2)


def on_circle(z):
    """Angle latents (B,), of which 3 is a whole turn -> cosine and sine (B, 2)."""
    return torch.stack([(z * 2 * math.pi / 3).cos(), (z * 2 * math.pi / 3).sin()], 1)


def next_skill(z, names, relation):
    """The relation functions f, Sec. 4.2.2, 6.1.2, A.3.2: z (..., M) of one transition -> of the next. names
    of the axes; relation {factor of z_multi: weight} (the paper: -0.2, -0.1 by hand, for its axes)."""
    z = z.clone()
    for factor, weight in relation.items():
        change = weight * z[..., names.index(factor)]
        target = z[..., names.index(MULTI[factor])]  # a view
        if factor == "acceleration" and "direction" not in names:
            change = change * target.sign()  # f_speed of App. A.3.2: on a rail a speed has a sign
        target += change  # f_dir or f_speed
    return z


@torch.no_grad()
def commands_of(policy, z, steps):
    """The commands of skills z (B, M): (B, `steps`, c_dim) in trajectory units. WEDIS: first steps of the
    decoder for z_single, with relation functions in between; SeCTAR: its decoder's steps; DADS: z itself."""
    if policy.method == "dads":
        return z[:, None].expand(-1, steps, -1)
    if not policy.names:
        return policy.decoder(z, steps)[0]
    singles = []
    for _ in range(steps):
        singles.append(z[:, :sum(name in SINGLE for name in policy.names)])
        z = next_skill(z, policy.names, policy.relation)
    mean, _ = policy.decoder(torch.cat(singles), 1)
    return mean.view(steps, len(z), -1).transpose(0, 1)


class Robots:
    """n robots of one model (ant.xml: nq 15, nv 14, nu 8; half_cheetah.xml: 9, 9, 6) that step together on
    threads; equal to a loop over mj_step. In the plane a robot has the places x and y, on a rail x alone."""

    def __init__(self, spec, n, threads=2):
        model = spec.compile()
        self.batch = Batch(model, n, threads)
        self.places = 2 if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE else 1
        self.qpos, self.qvel, self.ctrl, self.time = map(self.batch.bind, ("qpos", "qvel", "ctrl", "time"))
        self.reset(np.arange(n))

    def reset(self, ids, rng=None):
        """Robots ids at the origin at rest; with rng, plus U(-0.1, 0.1) on qpos and N(0, 0.1) on qvel."""
        self.batch.reset(ids, keyframe=0, stage=mujoco.mjtStage.mjSTAGE_NONE)  # warm start and warnings too
        if rng is not None:
            self.qpos[ids] += rng.uniform(-0.1, 0.1, (len(ids), self.qpos.shape[1]))
            self.qvel[ids] = rng.normal(0, 0.1, (len(ids), self.qvel.shape[1]))

    def place(self):
        """Places (n, 2 or 1) in metres. Float32."""
        return torch.from_numpy(self.qpos[:, :self.places]).float()

    def observe(self):
        """The policy's state, App. A.1.3: qpos without the place, qvel. (n, 27), Half-Cheetah (n, 17)."""
        return torch.from_numpy(np.concatenate([self.qpos[:, self.places:], self.qvel], 1)).float()

    def step(self, action):
        """One environment step of 0.05 s. action (n, nu) in [-1, 1]. Returns displacement (n, 2 or 1) in
        metres, and which robots were unstable since their reset (n,): their displacement means nothing."""
        before = self.qpos[:, :self.places].copy()
        self.ctrl[:] = action
        self.batch.step(nstep=FRAME_SKIP)
        unstable = self.batch.warning.any((1, 2))
        return torch.from_numpy(self.qpos[:, :self.places] - before).float(), unstable


def rotate(v, angle):
    """Vectors (B, 2) turned counter-clockwise by angle (B,)."""
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([cos * v[:, 0] - sin * v[:, 1], sin * v[:, 0] + cos * v[:, 1]], 1)


def to_base_frame(s, c):
    """State (B, 27) of Robots.observe and command (B, 2), turned by the torso's heading -> (B, 26), (B, 2).
    The dynamics do not depend on the heading: what is learnt for one holds for all."""
    half = torch.atan2(s[:, 4], s[:, 1])  # half the heading: (w, 0, 0, z) is a turn about the vertical
    upright = torch.hypot(s[:, 1], s[:, 4])[:, None]
    tilt, velocity = rotate(s[:, 2:4], -half), rotate(s[:, 13:15], -2 * half)
    body = s[:, 5:13], velocity, s[:, 15:]  # the angular velocity is the torso's own already
    return torch.cat([s[:, :1], upright, tilt, *body], 1), rotate(c, -2 * half)


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
        """What all networks read, (B, n): state and command in the base frame, the state normalised."""
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


def closed_loop(c, reference, robots, scale):
    """Commands (n, 2 or 1), trajectory units: c and a share of reference - place, both in metres."""
    share = FEEDBACK * (2 - c.norm(dim=1, keepdim=True).clamp(max=1))  # slow commands: up to twice as much
    correction = share * (reference - robots.place()) / scale
    c = c + correction * (CORRECTION / correction.norm(dim=1, keepdim=True).clamp(min=CORRECTION))
    steps = torch.from_numpy(robots.time).float()[:, None] / 0.05  # since the last reset
    longest = (0.2 + (FASTEST - 0.2) * steps / SOFT_START).clamp(max=FASTEST)
    return c * (longest / torch.maximum(c.norm(dim=1, keepdim=True), longest))


def execute(policy, robots, commands, hold, closed, deterministic):
    """Alg. 2, lines 13-19: hold each command (n, T, c_dim) for `hold` (H_z) steps. Yields after each step."""
    reference = robots.place()
    for c in commands.unbind(1):
        for _ in range(hold):
            asked = closed_loop(c, reference, robots, policy.scale) if closed else c
            yield robots.step(policy.actor.act(robots.observe(), asked, deterministic).numpy())
            if closed:
                reference = reference + policy.scale * c


BLUE, RED, GREY = "#0072B2", "#D55E00", "#888888"
plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
                     "grid.alpha": 0.25, "figure.dpi": 110, "savefig.bbox": "tight", "legend.frameon": False,
                     "axes.titlesize": 10, "figure.constrained_layout.use": True})


def save_figure(figure, out, name):
    """Write <out>/figures/<name>.png."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    plt.close(figure)
    print(f"wrote {write_whole(Path(out) / 'figures' / f'{name}.png', buffer.getvalue())}")
