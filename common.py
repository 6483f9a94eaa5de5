"""What two or more of the four stages share, in the order a reader meets it:
command line -> artifacts and CSV -> weak labels and factors -> decoder -> robot -> actor -> roll-outs -> plots.

Units: trajectory units for decoder displacements (one transition at most 1), metres and radians in the world,
STEP_SCALE metres per trajectory unit for a robot, 0.05 s per environment step.
"""
import argparse
import ast
import contextlib
import csv
import ctypes.util
import hashlib
import io
import json
import math
import os
import signal
import sys
from pathlib import Path

if sys.platform == "linux" and "MUJOCO_GL" not in os.environ:  # off-screen rendering; must be set before mujoco loads, and
    os.environ["MUJOCO_GL"] = "egl" if ctypes.util.find_library("EGL") else "disable"  # the default, GLFW, aborts without a screen

import matplotlib
import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import nn

try:
    import fcntl
except ImportError:
    fcntl = None

matplotlib.use("Agg")  # figures are files; no window is ever opened
import matplotlib.pyplot as plt  # noqa: E402

HERE = Path(__file__).parent
FORMAT = 2  # artifact format; raise it when what is stored changes meaning
SCRIPT = {"dataset": "01_make_dataset.py", "wetvae": "02_train_wetvae.py", "policy": "03_train_policy.py"}


# ---------------------------------------------------------------- command line

def stop(message, code=2):
    """End with one line on stderr. Code 2: the input is wrong; 1: the run failed."""
    print(f"{Path(sys.argv[0]).name}: {message}", file=sys.stderr)
    raise SystemExit(code)


def parse_flags(stage, argv=None):
    """Make every `NAME = value  # comment` at the top of a stage a flag --name, and set the stage's globals from it.

    stage: the script's globals(). A row of its EXPERIMENTS table overrides constants by name, flags override both.
    Returns the configuration {NAME: value}. Exits with 2 and one line on an unknown flag, experiment or wrong type.
    """
    if argv is None:  # a real command line: Ctrl-C and SIGTERM end with one line too
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        sys.excepthook = lambda kind, error, trace: (
            print("\nstopped by hand; what was saved stays, and training goes on from its last checkpoint with --resume true", file=sys.stderr)
            if kind is KeyboardInterrupt else sys.__excepthook__(kind, error, trace))
    lines = Path(stage["__file__"]).read_text().splitlines()
    comments = {}
    for node in ast.parse("\n".join(lines)).body:
        if isinstance(node, ast.Assign) and (name := getattr(node.targets[0], "id", "")).isupper():
            if type(stage[name]) in (bool, int, float, str):
                comments[name] = lines[node.end_lineno - 1].partition("  # ")[2]

    def typed(kind):
        def parse(text):
            if kind is bool and text.lower() not in ("true", "false"):
                raise ValueError
            value = text.lower() == "true" if kind is bool else kind(text)
            if kind in (int, float) and not 0 <= value < math.inf:
                raise ValueError
            return value
        parse.__name__ = {bool: "true or false", int: "whole number, 0 or more", float: "number, 0 or more"}.get(kind, "text")
        return parse

    parser = argparse.ArgumentParser(description=stage["__doc__"], allow_abbrev=False,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: stop(f"{message}; see --help")
    for name, comment in comments.items():
        parser.add_argument("--" + name.lower(), dest=name, type=typed(type(stage[name])), metavar=type(stage[name]).__name__,
                            help=f"{comment} [{stage[name]}]".replace("%", "%%"))
    given, unknown = parser.parse_known_args(argv)
    if unknown:
        stop(f"unknown flag {unknown[0]}; allowed: {' '.join('--' + n.lower() for n in comments)}")
    flags = {name: value for name, value in vars(given).items() if value is not None}
    experiment = flags.get("EXPERIMENT", stage["EXPERIMENT"])
    if experiment not in stage["EXPERIMENTS"]:
        stop(f"unknown experiment {experiment!r}; allowed: {' '.join(stage['EXPERIMENTS'])}")
    stage.update(stage["EXPERIMENTS"][experiment])
    stage.update(flags)
    return stage["EXPERIMENTS"][experiment] | {name: stage[name] for name in comments}


# ---------------------------------------------------------------- artifacts and CSV

def artifact_name(kind, experiment, seed):
    return f"{kind}_{experiment}_seed{seed}" + (".npz" if kind == "dataset" else ".pt")


def leaves(content):
    """Every array and plain value in an artifact, depth first, keys sorted: what a checksum is taken of."""
    if isinstance(content, dict):
        content = [part for key in sorted(content, key=str) for part in (str(key), content[key])]
    if isinstance(content, (list, tuple)):
        for part in content:
            yield from leaves(part)
    else:
        yield content.numpy() if isinstance(content, torch.Tensor) else content


def checksum(content):
    """SHA-256 over all of it but the entry "sha256": a changed byte that zip and torch let pass is noticed all the same."""
    sha = hashlib.sha256()
    for leaf in leaves({key: value for key, value in content.items() if key != "sha256"}):
        if isinstance(leaf, np.ndarray):
            sha.update(f"{leaf.dtype}{leaf.shape}".encode())
            sha.update(np.ascontiguousarray(leaf).tobytes())
        else:
            sha.update(repr(leaf).encode() + b"\0")
    return sha.hexdigest()


def write_whole(path, write):
    """write(file) to path, whole or not at all: a reader sees the old file or the new one, never half of one."""
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(partial, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())  # on the disk before it takes the name: a power cut leaves no empty artifact
        os.replace(partial, path)  # atomic
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        stop(f"cannot write {path}: {error.strerror}; free the space or choose another place with --out", code=1)


def save(out, kind, experiment, seed, config, **content):
    """Write runs/<kind>_<experiment>_seed<seed>, whole or not at all. content: arrays (.npz) or tensors and plain values (.pt)."""
    path = Path(out) / "runs" / artifact_name(kind, experiment, seed)
    meta = dict(format=FORMAT, kind=kind, experiment=experiment, seed=seed, config=config,
                versions=dict(torch=str(torch.__version__), mujoco=mujoco.__version__, numpy=np.__version__))
    meta["sha256"] = checksum(meta | content)
    write_whole(path, lambda file: np.savez(file, meta=json.dumps(meta), **content) if kind == "dataset"
                else torch.save(meta | content, file))
    return path


def load(out, kind, experiment, seed, quiet=False):
    """Read an artifact from runs/, else pretrained/, and say which was taken. Exits with 2 and one line if it is not sound."""
    name = artifact_name(kind, experiment, seed)
    make = f"make it with: python {SCRIPT[kind.partition('-')[0]]} --experiment {experiment} --seed {seed}"
    path = next((p for p in (Path(out) / "runs" / name, HERE / "pretrained" / name) if p.exists()), None)
    if path is None:
        stop(f"no {name} in runs/ or pretrained/; {make}")
    try:
        if kind == "dataset":
            with np.load(path, allow_pickle=False) as file:
                content = {key: file[key] for key in file.files}
            content |= json.loads(str(content.pop("meta")))
        else:
            content = torch.load(path, weights_only=True)
        found = {key: content.get(key) for key in ("format", "kind", "experiment", "seed")}
        sound = content.get("sha256") == checksum(content)
        finite = all(np.isfinite(leaf).all() for leaf in leaves(content) if isinstance(leaf, np.ndarray) and leaf.dtype.kind == "f")
    except Exception:  # numpy, zipfile, json and torch raise a dozen kinds on a damaged file; all mean the same to a reader
        stop(f"{path} is not readable (truncated, damaged or not an artifact of this project); {make}")
    for key, wanted in dict(format=FORMAT, kind=kind, experiment=experiment, seed=seed).items():
        if found[key] != wanted:
            stop(f"{path} has {key} {found[key]!r} where {wanted!r} is needed; {make}")
    if not sound:
        stop(f"{path} is damaged (its checksum does not match); {make}")
    if not finite:
        stop(f"{path} holds numbers that are not finite; {make}")
    if not quiet:
        print(f"using {path.relative_to(HERE) if path.is_relative_to(HERE) else path}")
    return content


def resumable(out, kind, experiment, seed, resume):
    """Whether training is to go on from a checkpoint; one that was stopped before its first checkpoint begins anew."""
    found = (Path(out) / "runs" / artifact_name(kind, experiment, seed)).exists()
    if resume and not found:
        print(f"no {artifact_name(kind, experiment, seed)} in runs/ yet: training from the beginning")
    return resume and found


def check_same(artifact, config, names):
    """Exit with 2 unless the artifact was made with today's value of each constant in names."""
    for name in sorted(names):
        if (old := artifact["config"].get(name)) != config[name]:
            stop(f"{artifact_name(*(artifact[key] for key in ('kind', 'experiment', 'seed')))} was made with --{name.lower()} {old}, "
                 f"not {config[name]}; give the same, or train anew")


@contextlib.contextmanager
def locked(path):
    """One process at a time: seeds trained side by side write rows into one file."""
    with open(path.with_name(path.name + ".lock"), "w") as file:
        if fcntl:  # not on Windows: let only one process write there
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def update_csv(path, rows, key):
    """Write rows (dicts), replacing those in the file that agree with one of them on the columns in key."""
    new = [{k: f"{v:.6g}" if isinstance(v, float) else str(v) for k, v in row.items()} for row in rows]
    ours = {tuple(row[k] for k in key) for row in new}
    path.parent.mkdir(parents=True, exist_ok=True)
    with locked(path):
        old = read_csv(path) if path.exists() else []
        text = io.StringIO()
        writer = csv.DictWriter(text, list(new[0]), extrasaction="ignore", restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows([row for row in old if tuple(row.get(k) for k in key) not in ours] + new)
        write_whole(path, lambda file: file.write(text.getvalue().encode()))


def read_csv(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def bootstrap_interval(values, draws=10_000):
    """95 % bootstrap interval of the mean of values (n,): (low, high)."""
    means = np.random.default_rng(0).choice(values, (draws, len(values))).mean(1)
    return np.quantile(means, [0.025, 0.975])


# ---------------------------------------------------------------- weak labels and factors

LABEL_RULES = {  # weak label: (number of classes, class from the factors, counted from 0), App. A.1.1 and A.3.1
    "speed": (4, lambda f: np.floor(f["speed"] / 0.25)),
    "direction": (4, lambda f: np.floor((math.pi / 2 - f["direction"]) / (math.pi / 4))),  # from +90 degrees downwards
    "curvature": (3, lambda f: np.select([f["curvature"] > 0, f["curvature"] < 0], [1, 2], 0)),  # straight, left, right
    "angle": (4, lambda f: np.floor(f["direction"] % (2 * math.pi) / (math.pi / 2))),  # full circle, quarters from 0 degrees
    "x": (4, lambda f: np.floor((f["speed"] * np.cos(f["direction"]) + 1) / 0.5)),
    "y": (4, lambda f: np.floor((f["speed"] * np.sin(f["direction"]) + 1) / 0.5)),
    "velocity": (4, lambda f: np.floor((f["speed"] + 1) / 0.5)),  # speed with a sign, one dimension
    "acceleration": (3, lambda f: np.select([f["acceleration"] > 0, f["acceleration"] < 0], [1, 2], 0)),  # none, up, down
}


def weak_labels(factors, names):
    """factors: dict name -> (N,). Returns (N, M) int64 classes counted from 0 (the paper counts from 1)."""
    rules = [LABEL_RULES[name] for name in names]
    return np.stack([np.clip(rule(factors), 0, classes - 1).astype(np.int64) for classes, rule in rules], axis=1)


def factors_of(displacement, accelerating=False):
    """Factors of trajectories given by their transitions. displacement (N, T, 2 or 1) -> dict of (N,): speed in the unit of the
    displacement (in one dimension with its sign), direction of the first transition in radians, curvature in radians per
    transition, x and y of a mean transition. accelerating: speed is that of the first transition, and acceleration is what a
    transition gains, over the speed (but never over less than 0.1, or standing still would be noise)."""
    one_d, T = displacement.shape[2] == 1, displacement.shape[1]
    size = displacement[..., 0] if one_d else np.linalg.norm(displacement, axis=-1)
    found = dict(speed=size[:, 0] if accelerating else size.mean(1))
    if accelerating and T > 1:
        found["acceleration"] = (size[:, -1] - size[:, 0]) / (T - 1) * np.sign(size[:, 0]) / np.maximum(abs(size[:, 0]), 0.1)
    if not one_d:
        heading = np.arctan2(displacement[..., 1], displacement[..., 0])
        turn = (np.diff(heading, axis=1) + math.pi) % (2 * math.pi) - math.pi
        found |= dict(direction=heading[:, 0], curvature=turn.mean(1) if T > 1 else np.zeros(len(turn)),
                      x=displacement[..., 0].mean(1), y=displacement[..., 1].mean(1))
    return found


def spread(values, name):
    """How far a factor (n,) ranges; of directions, which close in a circle, all of it but the largest gap."""
    if name != "direction":
        return np.ptp(values)
    angles = np.sort(values % (2 * math.pi))
    return 2 * math.pi - np.diff(angles, append=angles[0] + 2 * math.pi).max()


def cross_talk(curves, names, ranges):
    """C[i, j] = range of factor j while axis i is traversed / full range of factor j; purity_i = C[i, i] / sum_j C[i, j].

    curves: one dict of factors per axis, in the order of names; ranges: the data's. Returns C (M, M), purity (M,). No encoder.
    Axes whose factors are not known yet may be more or fewer than names: then only C means something."""
    C = np.array([[spread(curve[name], name) / full for name, full in zip(names, ranges)] for curve in curves])
    return C, np.diag(C) / C.sum(1)[:len(names)]


# ---------------------------------------------------------------- the decoder: predictive model and reward

class Decoder(nn.Module):
    """p_theta(tau | z), Fig 1: an LSTM that reads z and its own last mean and gives a Gaussian over the next displacement.

    The trap: with the true last displacement as input, noise-free trajectories give their factors away after two steps,
    z is not needed and stays entangled. So the decoder never sees the truth, in training either.
    """

    def __init__(self, z_dim, x_dim=2, hidden=64, circle=False):
        super().__init__()
        self.cell = nn.LSTMCell(x_dim + z_dim + circle, hidden)
        self.head = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 2 * x_dim))
        self.register_buffer("axes", torch.eye(z_dim, z_dim + circle))  # canonical z -> latents of training: a signed permutation
        self.register_buffer("circle", torch.zeros(3 * circle))  # which axis the first two latents are the circle of, sign, offset

    def latents(self, z):
        """Canonical z (B, M) -> latents of training (B, M), or (B, M + 1) where direction is a point on a circle, z_dir = 1 a third of it."""
        out = z @ self.axes
        if len(self.circle):
            angle = z[:, int(self.circle[0])] * self.circle[1] * (2 * math.pi / 3) + self.circle[2]
            out = torch.cat([angle.cos()[:, None], angle.sin()[:, None], out[:, 2:]], 1)
        return out

    def unroll(self, latents, steps):
        """Latents of training (B, L) -> mean and log-variance of the displacements, (B, steps, x_dim) each, in trajectory units."""
        state, outputs = None, []
        mean = latents.new_zeros(len(latents), self.cell.input_size - latents.shape[1])
        for _ in range(steps):
            state = self.cell(torch.cat([mean, latents], 1), state)
            mean, log_var = self.head(state[0]).chunk(2, 1)
            outputs.append(torch.stack([mean, log_var]))
        return torch.stack(outputs, 2).unbind(0)

    def forward(self, z, steps):
        """Canonical z (B, M) -> as unroll."""
        return self.unroll(self.latents(z), steps)


class SkillDynamics(nn.Module):
    """q_phi(displacement | z) of DADS: a mixture of Gaussians with identity covariance on normalised displacements. The x-y prior slices
    the place away and nothing else of the state is left: it reads z alone. Displacements in trajectory units."""

    def __init__(self, z_dim=2, x_dim=2, hidden=512, components=4):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(z_dim, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(),
                                 nn.Linear(hidden, components * (1 + x_dim)))
        for name, value in (("x_mean", torch.zeros(x_dim)), ("x_std", torch.ones(x_dim)), ("axes", torch.eye(z_dim))):  # axes: see Decoder
            self.register_buffer(name, value)

    def mixture(self, z):
        """z (B, m) -> log weights (B, K) and means (B, K, x_dim), normalised."""
        logit, mean = self.net(z).view(len(z), -1, 1 + len(self.x_mean)).split([1, len(self.x_mean)], 2)
        return logit.squeeze(2).log_softmax(1), mean

    def log_prob(self, x, log_weight, mean):
        """log q of normalised x under a mixture: (B, x_dim) -> (B,), each under its own; (B, 1, x_dim) -> (B, L), each under all L."""
        square = (x[..., None, :] - mean).square().sum(-1)
        return (log_weight - 0.5 * square).logsumexp(-1) - 0.5 * x.shape[-1] * math.log(2 * math.pi)

    def forward(self, z, steps):
        """As Decoder: the mean displacement, the same at every step, (B, steps, x_dim); no log-variance, it is a mixture's."""
        log_weight, mean = self.mixture(z)
        mean = self.x_mean + self.x_std * (log_weight.exp()[..., None] * mean).sum(1)
        return mean[:, None].expand(-1, steps, -1), None


def load_decoder(content):
    """The predictive model of an artifact: the Decoder of WEDIS and SeCTAR or the SkillDynamics of DADS."""
    state = content["decoder"]
    if "x_std" in state:
        last, x_dim = state["net.4.bias"], len(state["x_mean"])
        dynamics = SkillDynamics(len(state["axes"]), x_dim, len(state["net.0.bias"]), len(last) // (1 + x_dim))
        dynamics.load_state_dict(state)
        return dynamics.requires_grad_(False)
    decoder = Decoder(len(state["axes"]), len(state["head.2.bias"]) // 2, len(state["head.0.bias"]), len(state["circle"]) > 0)
    decoder.load_state_dict(state)
    return decoder.requires_grad_(False)


def next_skill(z, weight):
    """The relation functions, Sec. 6.1.2 and A.3.2. Ant, z (..., 3) = (speed, direction, curvature): f_dir(z_dir, z_cur) = z_dir + weight
    z_cur; Half-Cheetah, z (..., 2) = (speed, acceleration): f_speed(z_speed, z_acc) = z_speed + weight sign(z_speed) z_acc. The
    paper tunes the weight by hand; 03 calibrates it from the decoder."""
    if z.shape[-1] == 2:
        return torch.stack([z[..., 0] + weight * z[..., 0].sign() * z[..., 1], z[..., 1]], -1)
    return torch.stack([z[..., 0], z[..., 1] + weight * z[..., 2], z[..., 2]], -1)


def single(z):
    """z_single: speed and direction of (speed, direction, curvature), speed of (speed, acceleration)."""
    return z[..., :z.shape[-1] - 1]


def first_step(decoder, z):
    """Mean and log-variance (B, x_dim) of the decoder's first step for z_single = z (B, m), z_multi = 0."""
    return (v[:, 0] for v in decoder(nn.functional.pad(z, (0, len(decoder.axes) - z.shape[1])), 1))


@torch.no_grad()
def predict(decoder, z, steps, weight=None):
    """Displacements (B, T, x_dim), in trajectory units, that skills z (B, M) promise: the decoder's means.

    weight None: `steps` free steps of the decoder, as in the paper. Else its first step, `steps` times, with z moved by
    the relation function in between: exactly what the policy will be told to do."""
    if weight is None:
        return decoder(z, steps)[0]
    skills = [z]
    for _ in range(steps - 1):
        skills.append(next_skill(skills[-1], weight))
    mean, _ = first_step(decoder, single(torch.stack(skills, 1)).flatten(0, 1))
    return mean.view(len(z), steps, -1)


# ---------------------------------------------------------------- the robot

FRAME_SKIP = 5       # physics steps of 0.01 s per environment step
STEP_SCALE = 0.1     # metres per trajectory unit and environment step, Ant (App. A.1.3: mean / 10)
REST = (0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1)  # the pose the Ant's model file calls init_qpos


def ant_spec():
    """The Ant of the MuJoCo benchmarks (8 hinges, 13 bodies), built in code. nq 15, nv 14, nu 8, RK4 at 0.01 s."""
    spec = mujoco.MjSpec()
    spec.modelname, spec.compiler.degree = "ant", True
    spec.option.integrator, spec.option.timestep = mujoco.mjtIntegrator.mjINT_RK4, 0.01
    joint, geom = spec.default.joint, spec.default.geom
    joint.armature, joint.damping, joint.limited = 1, [1, 0, 0], True
    geom.density, geom.friction, geom.margin, geom.rgba = 5, [1, 0.5, 0.5], 0.01, [0.8, 0.6, 0.4, 1]
    geom.condim, geom.conaffinity = 3, 0  # contype 1 against conaffinity 0: legs do not collide with one another
    capsule = dict(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.08, 0, 0])

    world = spec.worldbody
    world.add_light(pos=[0, 0, 1.3], dir=[0.2, 0.2, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, diffuse=[0.8, 0.8, 0.8])
    spec.visual.headlight.diffuse = [0.3, 0.3, 0.3]
    spec.add_texture(name="tiles", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER, width=64, height=64,
                     rgb1=[0.86, 0.89, 0.86], rgb2=[0.78, 0.82, 0.79])
    spec.add_material(name="tiles", texrepeat=[0.5, 0.5], texuniform=True).textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[40, 40, 40], conaffinity=1, material="tiles", rgba=[1, 1, 1, 1])
    torso = world.add_body(name="torso", pos=[0, 0, 0.75])
    torso.add_freejoint(name="root").margin = 0.01
    torso.add_geom(name="torso_geom", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.25, 0, 0])
    legs = [("1", 1, 1, [-1, 1, 0], [30, 70]), ("2", -1, 1, [1, 1, 0], [-70, -30]),
            ("3", -1, -1, [-1, 1, 0], [-70, -30]), ("4", 1, -1, [1, 1, 0], [30, 70])]
    for name, x, y, axis, bend in legs:
        leg = torso.add_body(name="leg_" + name)
        leg.add_geom(name="aux_" + name, fromto=[0, 0, 0, 0.2 * x, 0.2 * y, 0], **capsule)
        thigh = leg.add_body(name="thigh_" + name, pos=[0.2 * x, 0.2 * y, 0])
        thigh.add_joint(name="hip_" + name, axis=[0, 0, 1], range=[-30, 30])
        thigh.add_geom(name="thigh_" + name, fromto=[0, 0, 0, 0.2 * x, 0.2 * y, 0], **capsule)
        shin = thigh.add_body(name="shin_" + name, pos=[0.2 * x, 0.2 * y, 0])
        shin.add_joint(name="ankle_" + name, axis=axis, range=bend)
        shin.add_geom(name="shin_" + name, fromto=[0, 0, 0, 0.4 * x, 0.4 * y, 0], **capsule)
    for name in "4123":  # the order of the benchmark's actuators
        for part in ("hip_", "ankle_"):
            motor = spec.add_actuator(name=part + name, target=part + name, trntype=mujoco.mjtTrn.mjTRN_JOINT,
                                      ctrllimited=True, ctrlrange=[-1, 1])
            motor.set_to_motor()
            motor.gear[0] = 150
    spec.add_key(name="rest", qpos=REST)
    return spec


class Robots:
    """n robots of one model that step together on threads; equal to a loop over mj_step (mujoco.batch). A robot that is free to move
    has two coordinates of place, x and y; one on a rail only x."""

    def __init__(self, spec, n, threads=2):
        model = spec.compile()
        self.batch, self.place = Batch(model, n, threads), 2 if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE else 1
        self.rest = model.key_qpos[0].copy() if model.nkey else model.qpos0.copy()
        self.qpos, self.qvel, self.ctrl, self.time = map(self.batch.bind, ("qpos", "qvel", "ctrl", "time"))  # live views
        self.reset(np.arange(n))

    def reset(self, ids, rng=None, noise=0.1):
        """Put robots ids at the origin in the rest pose; with rng add U(-noise, noise) to positions, N(0, noise) to velocities."""
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)  # also clears the solver's warm start
        self.qpos[ids], self.time[ids] = self.rest, 1.0  # clocks start at 1 s, MuJoCo's own reset of an unstable simulation at 0
        if rng is not None:
            self.qpos[ids] += rng.uniform(-noise, noise, (len(ids), self.qpos.shape[1]))
            self.qvel[ids] = rng.normal(0, noise, (len(ids), self.qvel.shape[1]))

    def observe(self):
        """The policy's state, Ant (n, 27), Half-Cheetah (n, 17): qpos without the place, qvel. Float32."""
        return torch.from_numpy(np.concatenate([self.qpos[:, self.place:], self.qvel], 1, dtype=np.float32, casting="same_kind"))

    def step(self, action):
        """One environment step of 0.05 s. action (n, 8) in [-1, 1]. Returns displacement (n, 2 or 1) in metres and which
        simulations MuJoCo found unstable (n,): it has reset those, so that their displacement means nothing."""
        before, clock = self.qpos[:, :self.place].copy(), self.time.copy()
        self.ctrl[:] = action
        self.batch.step(nstep=FRAME_SKIP)
        unstable = (self.time <= clock).reshape(-1) | ~np.isfinite(self.qpos).all(1)
        return torch.from_numpy((self.qpos[:, :self.place] - before).astype(np.float32)), unstable


# ---------------------------------------------------------------- the skill policy

FASTEST = 0.85  # trajectory units: the longest step that a calibrated policy is told, a skill's of z_speed = 2
EXPLORER = 3.0  # the last entry of the z that means "explore" to SeCTAR's policy: far from N(0, I), and no plan asks for it
ANKLES = torch.tensor([1.0, -1.0, -1.0, 1.0])  # legs 1 2 3 4: which way a bent ankle counts


def turn_legs(x, turns, signs):
    """Hip and ankle values of four legs (B, 8), leg by leg counter-clockwise, as seen from a frame turned by `turns` quarter turns
    (B,). signs (4,): of the ankles, in x's order of legs; frames turned back have all of them bent the positive way."""
    legs = x.view(-1, 4, 2)[torch.arange(len(x))[:, None], (torch.arange(4) + turns[:, None]) % 4]
    order = signs[(torch.arange(4) + turns[:, None]) % 4] * signs
    return torch.stack([legs[..., 0], legs[..., 1] * order], -1).flatten(1)


def egocentric(s, step):
    """The world as the Ant sees it. s (B, 27) of Robots.observe, step (B, 2): the displacement the skill asks for.

    Physics knows no north, and the Ant looks the same after a quarter turn: everything is turned into the frame of the torso's
    heading, and that by quarter turns until the wanted step points ahead within 45 degrees. Returns the state (B, 26), the
    step (B, 2) and the quarter turns (B,). What is learnt for one direction is so learnt for all."""
    alpha, beta = torch.complex(s[:, 1], s[:, 4]), torch.complex(s[:, 2], s[:, 3])  # quaternion = alpha + beta i: heading, tilt
    ahead = torch.polar(torch.ones(len(s)), -2 * alpha.angle())  # turns the world until the torso faces along x
    turns = (torch.angle(torch.view_as_complex(step) * ahead) / (math.pi / 2)).round()
    back = torch.polar(torch.ones(len(s)), -turns * (math.pi / 2))
    turns = turns.long()
    plane = torch.stack([torch.view_as_complex(step) * ahead * back, beta * torch.polar(torch.ones(len(s)), -alpha.angle()) * back,
                         torch.complex(s[:, 13], s[:, 14]) * ahead * back,     # velocity: of the world
                         torch.complex(s[:, 16], s[:, 17]) * back], 1)         # angular velocity: of the torso
    step, *plane = torch.view_as_real(plane).unbind(1)
    state = torch.cat([s[:, :1], alpha.abs()[:, None], *plane, s[:, 15:16], s[:, 18:19],
                       turn_legs(s[:, 5:13], turns, ANKLES), turn_legs(s[:, 19:27], turns, ANKLES)], 1)
    return state, step, turns


class Actor(nn.Module):
    """pi_psi(a | s, z_single): a Gaussian squashed by tanh, Sec. 4.2.2. Normalises the state by fixed statistics. With a decoder it is
    egocentric: it sees the step that the decoder predicts for z instead of z, from the torso's heading. Turned without a decoder (DADS), it
    takes z itself for a step."""

    def __init__(self, s_dim, z_dim, a_dim, hidden, decoder=None, turned=False):
        super().__init__()
        self.decoder = decoder
        self.register_buffer("turned", torch.tensor(turned or decoder is not None))
        self.net = nn.Sequential(nn.Linear(s_dim + z_dim, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(),
                                 nn.Linear(hidden, 2 * a_dim))
        self.register_buffer("s_mean", torch.zeros(s_dim))
        self.register_buffer("s_std", torch.ones(s_dim))
        self.register_buffer("told", torch.zeros(0, 0, 2))  # calibrated by 03: by speed and angle of a wanted step, what to add to it

    def inputs(self, s, z, step=None):
        """s (B, n), z (B, m), step (B, 2): what z asks for, if it is known -> what the networks see (B, s_dim + z_dim) and by how
        many quarter turns the legs are counted on (B,)."""
        turns = torch.zeros(len(s), dtype=torch.int64)
        if self.turned:
            s, z, turns = egocentric(s, self.wanted(z) if step is None else step)
        return torch.cat([((s - self.s_mean) / self.s_std).clamp(-10, 10), z], -1), turns

    def wanted(self, z, t=0):
        """The step (B, 2) that z asks for at transition t: always WEDIS's first (the relation function moves z), SeCTAR's t-th."""
        if self.decoder is None:
            return z
        step = self.decoder(nn.functional.pad(z, (0, len(self.decoder.axes) - z.shape[1])), t + 1)[0][:, t]
        return torch.where(z[:, -1:] == EXPLORER, z[:, :2], step)

    def forward(self, x, deterministic=False):
        """x of inputs -> action (B, a_dim) in (-1, 1), log-probability (B,)."""
        mean, log_std = self.net(x).chunk(2, -1)
        log_std = log_std.clamp(-5, 2)
        noise = torch.zeros_like(mean) if deterministic else torch.randn_like(mean)
        u = mean + log_std.exp() * noise
        # log pi(a) = log N(u) - sum log(1 - tanh(u)^2), the last in a form that does not overflow for large |u|
        log_prob = -0.5 * noise ** 2 - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = log_prob - 2 * (math.log(2) - u - nn.functional.softplus(-2 * u))
        return torch.tanh(u), log_prob.sum(-1)

    @torch.no_grad()
    def act(self, s, z, deterministic=False, t=0):
        """The action (B, a_dim) for the robot's own motors."""
        return self.follow(s, self.wanted(z, t), deterministic)

    @torch.no_grad()
    def follow(self, s, step, deterministic=False):
        """As act, asked for a step (B, 2) instead of a skill."""
        step = self.tell(s, step)
        x, turns = self.inputs(s, step, step)
        action, _ = self(x, deterministic)
        return self.seen(action, -turns)

    def tell(self, s, step):
        """What to tell the policy for a step (B, 2) to be made: itself, unless 03 has calibrated that."""
        if not len(self.told):
            return step
        nodes, share = self.nodes(s, step)
        more = torch.view_as_complex((self.told.flatten(0, 1)[nodes] * share[..., None]).sum(1))  # ahead, and to the left of the step
        step = torch.view_as_complex(step)
        step = step + more * torch.polar(torch.ones(len(s)), step.angle())
        return torch.view_as_real(step / (step.abs() / FASTEST).clamp(min=1))

    def nodes(self, s, step):
        """Between which four entries of told, flattened, a step (B, 2) lies, (B, 4), and their shares (B, 4): rows are speeds from 0 to
        FASTEST, columns angles from the torso's heading, round a quarter turn, after which the Ant looks the same."""
        rows, columns = self.told.shape[:2]
        angle = torch.view_as_complex(step).angle() - 2 * torch.complex(s[:, 1], s[:, 4]).angle()  # see egocentric
        row = (step.norm(dim=1) * (rows - 1) / FASTEST).clamp(max=rows - 1.001)
        column = angle * 4 / (2 * math.pi) % 1 * columns
        i, j, down, right = row.long(), column.long(), row.frac(), column.frac()
        nodes = [k * columns + m % columns for k in (i, i + 1) for m in (j, j + 1)]
        return torch.stack(nodes, 1), torch.stack([u * v for u in (1 - down, down) for v in (1 - right, right)], 1)

    def seen(self, action, turns):
        """Actions with legs counted on by quarter turns: of the motors -> of the networks; with -turns back again."""
        return action if not self.turned else turn_legs(action, turns, ANKLES.roll(1))  # motors begin with leg 4


def load_actor(content):
    state = content["actor"]
    a_dim, hidden, s_dim = len(state["net.4.bias"]) // 2, len(state["net.0.bias"]), len(state["s_mean"])
    decoder = load_decoder(content) if "decoder.axes" in state else None
    actor = Actor(s_dim, state["net.0.weight"].shape[1] - s_dim, a_dim, hidden, decoder, bool(state["turned"]))
    actor.told = state["told"].clone()  # its length is free
    actor.load_state_dict(state)
    return actor.requires_grad_(False)


@torch.no_grad()
def execute(actor, robots, z, steps, hold, weight, deterministic):
    """Alg. 2, execution: hold z_single for `hold` (H_z) environment steps, move it by the relation function, `steps` (T) times.
    z (n, M); weight None (DADS, SeCTAR): there is no relation function, the policy is told all of z and at which transition it is. Yields
    after each environment step (for contacts, frames and stopping); the robots hold the state."""
    for t in range(steps):
        for _ in range(hold):
            told, at = (z, t) if weight is None else (single(z), 0)
            yield robots.step(actor.act(robots.observe(), told, deterministic, at).numpy())
        z = z if weight is None else next_skill(z, weight)


# ---------------------------------------------------------------- plots

# The paper's red, green, blue, cyan, yellow for latents (-1, -0.5, 0, 0.5, 1), in colour-blind safe hues (Okabe-Ito).
LATENT_COLOURS = dict(zip((-1, -0.5, 0, 0.5, 1), ("#D55E00", "#009E73", "#0072B2", "#56B4E9", "#F0E442")))
BLUE, RED, GREY = "#0072B2", "#D55E00", "#888888"
TRAVERSAL_MAP = "viridis"  # for many values of one latent
plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
                     "grid.alpha": 0.25, "figure.dpi": 110, "savefig.bbox": "tight", "legend.frameon": False,
                     "axes.titlesize": 10, "figure.constrained_layout.use": True})


def save_figure(figure, out, name):
    path = Path(out) / "figures" / f"{name}.png"
    write_whole(path, lambda file: figure.savefig(file, format="png"))
    plt.close(figure)
    print(f"wrote figures/{path.name}")
