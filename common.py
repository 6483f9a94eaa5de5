"""What two or more stages share, in the order in which a reader meets it:
command line -> artifacts and CSV -> weak labels and factors -> decoder -> robot -> actor -> execution -> plots.

Units: trajectory units for decoder displacements (one transition is at most 1), metres and radians in the world,
`scale` metres per trajectory unit and environment step for a robot, 0.05 s per environment step.
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
from types import SimpleNamespace

os.environ["MPLBACKEND"] = "Agg"  # figures are files; a notebook's backend would fail here
if sys.platform == "linux" and "MUJOCO_GL" not in os.environ:  # set before mujoco loads: GLFW aborts without a screen
    os.environ["MUJOCO_GL"] = "egl" if ctypes.util.find_library("EGL") else "disable"

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import nn

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

HERE = Path(__file__).parent
FORMAT = 3  # of the artifacts; raise it when the meaning of what is stored changes
SCRIPT = {"dataset": "01_make_dataset.py", "wetvae": "02_train_wetvae.py", "policy": "03_train_policy.py"}


# ---------------------------------------------------------------- command line

def stop(message, code=2):
    """End with one line on stderr. Code 2: the input is wrong; 1: the run failed."""
    print(f"{Path(sys.argv[0]).name}: {message}", file=sys.stderr)
    raise SystemExit(code)


def convert(value, like, negative, name):
    """value (text of a flag, or what a row of a table holds) -> the type of `like`. Exits with 2 if it does not fit."""
    kind = type(like)
    try:
        if kind is bool:
            result = {"true": True, "false": False}[str(value).lower()]
        elif kind is tuple:
            result = tuple(float(part) for part in (value.split() if isinstance(value, str) else value))
            if len(result) != len(like) or not np.isfinite(result).all():
                raise ValueError
        elif kind in (int, float):
            result = float(value)
            if not math.isfinite(result) or (result < 0 and not negative):
                raise ValueError
            if kind is int:
                result = int(result) if result.is_integer() else int("not whole")
        else:
            result = str(value)
    except (KeyError, TypeError, ValueError):
        wanted = {bool: "true or false", int: "a whole number", float: "a number", tuple: f"{len(like)} numbers"
                  if kind is tuple else ""}[kind]
        stop(f"{name} is {value!r}, but must be {wanted}{'' if negative or kind is bool else ', 0 or more'}")
    return result


def parse_flags(stage, argv=None):
    """Make each `NAME = value  # comment` at the top of a stage a flag --name, and set the stage's globals from it.

    stage: the script's globals(). A row of its table EXPERIMENTS overrides constants by name; a flag overrides both.
    Returns the configuration {NAME: value} and what flags alone say {NAME: value}. Exits with 2 and one line if a flag,
    a row or a type is wrong, or if nothing can be written to OUT.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if hasattr(signal, "SIGPIPE"):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # piped into head: end as other programs do
    sys.excepthook = one_line_when_stopped
    source = Path(stage["__file__"]).read_text(encoding="utf-8")
    lines = source.splitlines()
    comments = {}
    for node in ast.parse(source).body:
        name = getattr(node.targets[0], "id", "") if isinstance(node, ast.Assign) else ""
        if name.isupper() and type(stage[name]) in (bool, int, float, str, tuple):
            comments[name] = lines[node.end_lineno - 1].partition("  # ")[2]
            if "e" in ast.unparse(node.value) or "." not in ast.get_source_segment(source, node.value):
                if isinstance(stage[name], float) and stage[name].is_integer():
                    stage[name] = int(stage[name])  # 1e4 means ten thousand
    rows = stage["EXPERIMENTS"]
    negative = {name: isinstance(stage[name], tuple) or any(
        isinstance(value, (int, float)) and value < 0 for value in [stage[name], *(row.get(name) for row in rows.values())])
        for name in comments}

    parser = argparse.ArgumentParser(description=stage["__doc__"], allow_abbrev=False,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: stop(f"{message}; see --help")
    for name, comment in comments.items():
        shown = " ".join(f"{part:g}" for part in stage[name]) if isinstance(stage[name], tuple) else stage[name]
        parser.add_argument("--" + name.lower(), dest=name, metavar=type(stage[name]).__name__,
                            help=f"{comment} [{shown}]".replace("%", "%%"))
    parsed, unknown = parser.parse_known_args(argv)
    if unknown:
        stop(f"unknown flag {unknown[0]}; allowed: {' '.join('--' + name.lower() for name in comments)}")
    given = {name: convert(value, stage[name], negative[name], "--" + name.lower())
             for name, value in vars(parsed).items() if value is not None}
    experiment = given.get("EXPERIMENT", stage["EXPERIMENT"])
    if experiment not in rows:
        stop(f"unknown experiment {experiment!r}; allowed: {' '.join(rows)}")
    for name, value in rows[experiment].items():
        if name not in stage:
            stop(f"the row {experiment!r} of EXPERIMENTS names {name}, which is no constant of this file")
        if name in comments:
            value = convert(value, stage[name], negative[name], f"{name} in the row {experiment!r} of EXPERIMENTS")
        stage[name] = value
    stage["EXPERIMENT"] = experiment
    stage.update(given)
    write_whole(Path(stage["OUT"]) / f".can_write_{os.getpid()}", b"").unlink()  # before any work is lost
    return {name: stage[name] for name in comments}, given


def one_line_when_stopped(kind, error, trace):
    if kind is KeyboardInterrupt:
        print("\nstopped; what was saved stays, and --resume true goes on from the last checkpoint", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


# ---------------------------------------------------------------- artifacts and CSV

def write_whole(path, data):
    """Write bytes to path, whole or not at all, under a name that no other process uses. Returns the path."""
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(partial, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())  # on the disk before it takes the name: a power cut leaves no empty artifact
        os.replace(partial, path)  # atomic
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        stop(f"cannot write {path}: {error.strerror}; free the space or choose another place with --out", code=1)
    return path


def artifact_name(kind, experiment, seed):
    return f"{kind}_{experiment}_seed{seed}" + (".npz" if kind == "dataset" else ".pt")


def save(out, kind, experiment, seed, config, **content):
    """Write <out>/<kind>_<experiment>_seed<seed>. content: arrays (.npz) or tensors and plain values (.pt).
    The last 32 bytes are the SHA-256 of all bytes before them; numpy and torch read over them."""
    meta = dict(format=FORMAT, kind=kind, experiment=experiment, seed=seed, config=config,
                versions=dict(torch=str(torch.__version__), mujoco=mujoco.__version__, numpy=np.__version__))
    buffer = io.BytesIO()
    if kind == "dataset":
        np.savez(buffer, meta=json.dumps(meta), **content)
    else:
        torch.save(meta | content, buffer)
    data = buffer.getvalue()
    return write_whole(Path(out) / artifact_name(kind, experiment, seed), data + hashlib.sha256(data).digest())


def load(out, kind, experiment, seed, quiet=False):
    """Read an artifact from <out>/, else pretrained/, and say which. Returns its content, with "sha256" (hex digits).
    Exits with 2 and one line if it is missing, damaged, foreign or not finite."""
    name = artifact_name(kind, experiment, seed)
    make = f"make it with: python {SCRIPT[kind.partition('-')[0]]} --experiment {experiment} --seed {seed}"
    path = next((p for p in (Path(out) / name, HERE / "pretrained" / name) if p.exists()), None)
    if path is None:
        stop(f"no {name} in {out}/ or pretrained/; {make}")
    try:
        data = path.read_bytes()
        sound = hashlib.sha256(data[:-32]).digest() == data[-32:]
        if kind == "dataset":
            with np.load(io.BytesIO(data), allow_pickle=False) as file:
                content = {key: file[key] for key in file.files}
            content |= json.loads(str(content.pop("meta")))
        else:
            content = torch.load(io.BytesIO(data[:-32]), weights_only=True)
        found = {key: content.get(key) for key in ("format", "kind", "experiment", "seed")}
    except Exception:  # numpy, zipfile, json and torch raise a dozen kinds on a damaged file; all mean the same
        stop(f"{path} is damaged or is no artifact of this project; {make}")
    for key, needed in dict(format=FORMAT, kind=kind, experiment=experiment, seed=seed).items():
        if found[key] != needed:
            stop(f"{path} has {key} {found[key]!r} where {needed!r} is needed; {make}")
    if not sound:
        stop(f"{path} is damaged (its checksum does not match); {make}")
    if not all(np.isfinite(leaf).all() for leaf in numbers_in(content)):
        stop(f"{path} holds numbers that are not finite; {make}")
    if not quiet:
        print(f"using {path.relative_to(HERE) if path.is_relative_to(HERE) else path}")
    return content | dict(sha256=data[-32:].hex())


def numbers_in(content):
    """Every array of floating-point numbers in an artifact."""
    if isinstance(content, dict):
        content = list(content.values())
    if isinstance(content, (list, tuple)):
        for part in content:
            yield from numbers_in(part)
    elif isinstance(content, (np.ndarray, torch.Tensor)):
        array = np.asarray(content)
        if array.dtype.kind == "f":
            yield array


def check_same(artifact, config, free):
    """Exit with 2 unless an artifact was made with today's value of each constant that is not named in free."""
    for name in sorted(set(config) - set(free)):
        if artifact["config"].get(name) != config[name]:
            stop(f"{artifact['kind']} {artifact['experiment']} was made with {name} = {artifact['config'].get(name)}, not "
                 f"{config[name]}: give the same, or train anew")


@contextlib.contextmanager
def locked(path):
    """One process at a time: seeds trained side by side write rows into one file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path.with_name(path.name + ".lock"), "w") as file:
        if fcntl:
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def update_csv(path, rows, key):
    """Write rows (dicts), in place of those in the file that agree with one of them on the columns in key."""
    new = [{k: f"{v:.6g}" if isinstance(v, float) else str(v) for k, v in row.items()} for row in rows]
    replaced = {tuple(row[k] for k in key) for row in new}
    with locked(path):
        old = read_csv(path) if path.exists() else []
        text = io.StringIO()
        writer = csv.DictWriter(text, list(new[0]), extrasaction="ignore", restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows([row for row in old if tuple(row.get(k) for k in key) not in replaced] + new)
        write_whole(path, text.getvalue().encode())


def read_csv(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


# ---------------------------------------------------------------- weak labels and factors

SINGLE = ("speed", "direction")          # factors of z_single, Sec. 4.2.2: they act in each transition
MULTI = ("curvature", "acceleration")    # factors of z_multi: they act over several transitions
CLASSES = dict(speed=4, direction=4, curvature=3, acceleration=3, x=4, y=4)  # of each weak label, App. A.1.1, A.3.1


def weak_labels(factors, names, ranges):
    """Weak labels, App. A.1.1, A.3.1 and Fig 9. factors: {name: (N,)}, ranges: {name: (low, high)}. Returns (N, M)
    int64 classes, from 0 (the paper: from 1). Curvature and acceleration: none, positive, negative; the others: four
    equal segments of their range, of direction from the left downwards."""
    labels = []
    for name in names:
        if name in MULTI:
            label = np.select([factors[name] > 0, factors[name] < 0], [1, 2], 0)
        else:
            low, high = ranges[name]
            share = (factors[name] - low) / (high - low)
            if name == "direction":
                share = 1 - share
            label = np.clip(np.floor(CLASSES[name] * share), 0, CLASSES[name] - 1)
        labels.append(label.astype(np.int64))
    return np.stack(labels, 1)


def factors_of(displacement, names):
    """The factors in names of trajectories, from their transitions: displacement (N, T, 2 or 1) -> {name: (N,)}.

    Speed in the unit of the displacement (with a sign in one dimension), direction of the first transition in
    radians, curvature in radians per transition, x and y of the mean transition, acceleration as a share of the
    speed per transition (of 0.1 at least: standing still is noise); beside it, speed is that of the first one."""
    steps = displacement.shape[1]
    size = np.linalg.norm(displacement, axis=2) if displacement.shape[2] == 2 else displacement[..., 0]
    found = dict(speed=size.mean(1))
    if "acceleration" in names:
        found["speed"] = size[:, 0]
        gain = (size[:, -1] - size[:, 0]) / max(steps - 1, 1) * np.sign(size[:, 0])
        found["acceleration"] = gain / np.maximum(abs(size[:, 0]), 0.1)
    if displacement.shape[2] == 2:
        heading = np.arctan2(displacement[..., 1], displacement[..., 0])
        turn = (np.diff(heading, axis=1) + math.pi) % (2 * math.pi) - math.pi
        found["direction"], found["curvature"] = heading[:, 0], turn.sum(1) / max(steps - 1, 1)
        found["x"], found["y"] = displacement.mean(1).T
    return {name: found[name] for name in names}


def spread(values, name):
    """How far a factor (n,) ranges; of directions, which close in a circle, all of it but the largest gap."""
    if name != "direction":
        return np.ptp(values)
    angles = np.sort(values % (2 * math.pi))
    return 2 * math.pi - np.diff(angles, append=angles[0] + 2 * math.pi).max()


def cross_talk(curves, ranges):
    """C[i, j] = range of factor j while axis i is traversed / its range in the data, (axes, factors). curves: of each
    axis the factors {name: (n,)} along its traversal; ranges: {name: (low, high)} of the data."""
    return np.array([[spread(curve[name], name) / np.ptp(limits) for name, limits in ranges.items()]
                     for curve in curves])


def purity(C, i, j):
    """Purity of axis i for factor j: C[i, j] / sum_k C[i, k]. A row below 0.1 is a dead axis: nan."""
    return C[i, j] / C[i].sum() if C[i].max() >= 0.1 else math.nan


# ---------------------------------------------------------------- the decoder: predictive model and reward

class Decoder(nn.Module):
    """p_theta(tau | z), Fig 1: an LSTM that reads z and its own last mean, and gives a Gaussian over the next displacement.

    The trap: with the true last displacement as input, noise-free trajectories give their factors away after two steps,
    z is not needed and stays entangled. So the decoder never reads the truth, in training either.
    circle: index of a latent that is an angle, of which -1.5 and 1.5 are the same; the LSTM reads its cosine and sine."""

    def __init__(self, z_dim, x_dim, hidden, circle=None):
        super().__init__()
        self.arguments = (z_dim, x_dim, hidden, circle)
        self.x_dim, self.circle = x_dim, circle
        self.cell = nn.LSTMCell(x_dim + z_dim + (circle is not None), hidden)
        self.head = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 2 * x_dim))
        self.register_buffer("axes", torch.eye(z_dim))  # canonical z -> latents of training: a signed permutation

    def unroll(self, latents, steps):
        """Latents of training (B, M) -> mean and log-variance of the displacements, (B, steps, x_dim) each."""
        read = latents
        if self.circle is not None:
            read = torch.cat([latents[:, :self.circle], on_circle(latents[:, self.circle]), latents[:, self.circle + 1:]], 1)
        mean = latents.new_zeros(len(latents), self.x_dim)
        state, means, log_vars = None, [], []
        for _ in range(steps):
            state = self.cell(torch.cat([mean, read], 1), state)
            mean, log_var = self.head(state[0]).chunk(2, 1)
            means.append(mean)
            log_vars.append(log_var)
        return torch.stack(means, 1), torch.stack(log_vars, 1)

    def forward(self, z, steps):
        """Canonical z (B, M): axis m is factor m, + is more of it -> as unroll."""
        return self.unroll(z @ self.axes, steps)


def on_circle(z):
    """Angle latents (B,), of which 3 is a whole turn -> cosine and sine (B, 2)."""
    return torch.stack([(z * 2 * math.pi / 3).cos(), (z * 2 * math.pi / 3).sin()], 1)


class SkillDynamics(nn.Module):
    """q_phi(displacement | z) of DADS: a mixture of Gaussians with unit covariance on normalised displacements. Without the
    place nothing of the state is left for it to read, so it reads z alone. Displacements in trajectory units."""

    def __init__(self, z_dim=2, x_dim=2, hidden=512, components=4):
        super().__init__()
        self.arguments, self.x_dim = (z_dim, x_dim, hidden, components), x_dim
        self.net = nn.Sequential(nn.Linear(z_dim, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(),
                                 nn.Linear(hidden, components * (1 + x_dim)))
        self.register_buffer("x_mean", torch.zeros(x_dim))
        self.register_buffer("x_std", torch.ones(x_dim))

    def mixture(self, z):
        """z (B, m) -> log weights (B, K) and means (B, K, x_dim), normalised."""
        logit, mean = self.net(z).view(len(z), -1, 1 + len(self.x_mean)).split([1, len(self.x_mean)], 2)
        return logit.squeeze(2).log_softmax(1), mean

    def forward(self, z, steps):
        """As Decoder: the mean displacement, the same at each step, (B, steps, x_dim); no log-variance, it is a mixture's."""
        log_weight, mean = self.mixture(z)
        mean = self.x_mean + self.x_std * (log_weight.exp()[..., None] * mean).sum(1)
        return mean[:, None].expand(-1, steps, -1), None


def pack(module):
    """A network as plain values and tensors, for an artifact; unpack makes it again."""
    return dict(network=type(module).__name__, arguments=list(module.arguments), state=module.state_dict())


def unpack(packed):
    module = {one.__name__: one for one in (Decoder, SkillDynamics, Actor)}[packed["network"]](*packed["arguments"])
    module.load_state_dict(packed["state"])
    return module.requires_grad_(False)


def next_skill(z, names, relation):
    """The relation functions f, Sec. 4.2.2, 6.1.2 and A.3.2: z (..., M) of one transition -> of the next.

    names: the factor of each axis; relation: {factor of z_multi: weight}. The paper tunes the weights by hand (-0.2 and 0.1,
    signs by the axes of its training); 03 calibrates them from the decoder."""
    z = z.clone()
    for factor, weight in relation.items():
        change = weight * z[..., names.index(factor)]
        if factor == "curvature":
            z[..., names.index("direction")] += change  # f_dir
        elif "direction" in names:
            z[..., names.index("speed")] += change  # f_speed, two dimensions
        else:
            z[..., names.index("speed")] += change * z[..., names.index("speed")].sign()  # f_speed of App. A.3.2
    return z


def first_step(decoder, z_single):
    """Mean and log-variance (B, x_dim) of the decoder's first step for z = (z_single, 0): p_theta(s_1 | z), Sec. 6.1.2."""
    z = nn.functional.pad(z_single, (0, len(decoder.axes) - z_single.shape[1]))
    mean, log_var = decoder(z, 1)
    return mean[:, 0], log_var[:, 0]


@torch.no_grad()
def commands_of(policy, z, steps):
    """The commands of skills z (B, M): displacements (B, `steps`, c_dim) in trajectory units.

    WEDIS: the decoder's first step for z_single, `steps` (T) times, with z_single changed by the relation functions in
    between. SeCTAR: its decoder's T steps. DADS: z itself, whatever it means."""
    if isinstance(policy.decoder, SkillDynamics):
        return z[:, None].expand(-1, steps, -1)
    if not policy.names:
        return policy.decoder(z, steps)[0]
    singles = []
    for _ in range(steps):
        singles.append(z[:, :sum(name in SINGLE for name in policy.names)])
        z = next_skill(z, policy.names, policy.relation)
    mean, _ = first_step(policy.decoder, torch.cat(singles))
    return mean.view(steps, len(z), -1).transpose(0, 1)


# ---------------------------------------------------------------- the robot

FRAME_SKIP = 5  # physics steps of 0.01 s per environment step
REST = (0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1)  # the pose that the Ant's model file calls init_qpos


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
    world.add_light(pos=[0, 0, 1.3], dir=[0.2, 0.2, -1], diffuse=[0.8, 0.8, 0.8],
                    type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    spec.visual.headlight.diffuse = [0.3, 0.3, 0.3]
    spec.add_texture(name="tiles", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
                     width=64, height=64, rgb1=[0.86, 0.89, 0.86], rgb2=[0.78, 0.82, 0.79])
    tiles = spec.add_material(name="tiles", texrepeat=[0.5, 0.5], texuniform=True)
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[40, 40, 40], conaffinity=1, material="tiles",
                   rgba=[1, 1, 1, 1])
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
    """n robots of one model that step together on threads; equal to a loop over mj_step (mujoco.batch). A robot that is
    free in space has two coordinates of place, x and y; one on a rail has x alone."""

    def __init__(self, spec, n, threads=2):
        model = spec.compile()
        self.batch = Batch(model, n, threads)
        self.places = 2 if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE else 1
        self.rest = model.key_qpos[0].copy() if model.nkey else model.qpos0.copy()
        self.qpos, self.qvel, self.ctrl, self.time = map(self.batch.bind, ("qpos", "qvel", "ctrl", "time"))  # live views
        self.reset(np.arange(n))

    def reset(self, ids, rng=None, noise=0.1):
        """Put robots ids at the origin in the rest pose; with rng add U(-noise, noise) to positions, N(0, noise) to
        velocities."""
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)  # also clears the solver's warm start
        self.qpos[ids] = self.rest
        self.time[ids] = 1.0  # clocks start at 1 s, MuJoCo's own reset of an unstable simulation at 0
        if rng is not None:
            self.qpos[ids] += rng.uniform(-noise, noise, (len(ids), self.qpos.shape[1]))
            self.qvel[ids] = rng.normal(0, noise, (len(ids), self.qvel.shape[1]))

    def place(self):
        """x and y, or x alone, in metres: (n, 2 or 1). Float32."""
        return torch.from_numpy(self.qpos[:, :self.places].astype(np.float32))

    def age(self):
        """Environment steps since the last reset (n, 1). Float32."""
        return torch.from_numpy((self.time.reshape(-1, 1) - 1.0).astype(np.float32)) / 0.05

    def observe(self):
        """The policy's state: qpos without the place (App. A.1.3), qvel. Ant (n, 27), Half-Cheetah (n, 17). Float32."""
        return torch.from_numpy(np.concatenate([self.qpos[:, self.places:], self.qvel], 1).astype(np.float32))

    def upside_down(self):
        """Which robots have turned over (n,): the torso's z axis points down."""
        if self.places == 2:
            return (self.qpos[:, 4:6] ** 2).sum(1) > 0.5  # from its quaternion: 1 - 2 (x^2 + y^2) < 0
        return np.cos(self.qpos[:, 2]) < 0

    def step(self, action):
        """One environment step of 0.05 s. action (n, nu) in [-1, 1]. Returns displacement (n, 2 or 1) in metres and which
        simulations MuJoCo found unstable (n,): it has reset those, so that their displacement means nothing."""
        before, clock = self.qpos[:, :self.places].copy(), self.time.copy()
        self.ctrl[:] = action
        self.batch.step(nstep=FRAME_SKIP)
        unstable = (self.time <= clock).reshape(-1) | ~np.isfinite(self.qpos).all(1)
        return torch.from_numpy((self.qpos[:, :self.places] - before).astype(np.float32)), unstable


# ---------------------------------------------------------------- the skill policy

def rotate(v, angle):
    """Vectors (B, 2) turned counter-clockwise by angle (B,)."""
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([cos * v[:, 0] - sin * v[:, 1], sin * v[:, 0] + cos * v[:, 1]], 1)


def to_base_frame(s, c):
    """State (B, 27) of Robots.observe and command (B, 2), turned by the torso's heading -> (B, 26), (B, 2). Physics knows no
    north: what is learnt for one heading is learnt for all. Angular velocity is the torso's own already."""
    half = torch.atan2(s[:, 4], s[:, 1])  # half the heading: the quaternion (w, 0, 0, z) of a turn about the vertical
    upright = torch.hypot(s[:, 1], s[:, 4])[:, None]
    tilt, velocity = rotate(s[:, 2:4], -half), rotate(s[:, 13:15], -2 * half)
    return torch.cat([s[:, :1], upright, tilt, s[:, 5:13], velocity, s[:, 15:]], 1), rotate(c, -2 * half)


class Actor(nn.Module):
    """pi_psi(a | s, c): a Gaussian squashed by tanh. c is the command: the displacement that the decoder predicts for
    z_single, in trajectory units (the paper: z_single itself, Sec. 4.2.2)."""

    def __init__(self, s_dim, c_dim, a_dim, hidden, base_frame):
        super().__init__()
        self.arguments = (s_dim, c_dim, a_dim, hidden, base_frame)
        self.base_frame = base_frame
        s_dim -= base_frame  # a turned quaternion has no fourth number
        self.net = nn.Sequential(nn.Linear(s_dim + c_dim, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(),
                                 nn.Linear(hidden, 2 * a_dim))
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
        # log pi(a) = log N(u) - sum log(1 - tanh(u)^2), the last in a form that does not overflow for large |u|
        log_prob = -0.5 * noise ** 2 - log_std - 0.5 * math.log(2 * math.pi)
        log_prob = log_prob - 2 * (math.log(2) - u - nn.functional.softplus(-2 * u))
        return torch.tanh(u), log_prob.sum(1)

    @torch.no_grad()
    def act(self, s, c, deterministic=False):
        """Action (B, a_dim) for state s (B, s_dim) and command c (B, c_dim)."""
        return self(self.inputs(s, c), deterministic)[0]


FEEDBACK = 0.1        # closed loop: share of the distance to the reference that is added to each command (the paper: 0)
CORRECTION = 0.2      # at most so much, trajectory units
FASTEST = 0.85        # no command is longer, trajectory units; the fastest transition that training asks for is 1
SOFT_START = 40       # environment steps over which the longest command grows from 0.2 to FASTEST


def closed_loop(c, reference, robots, scale):
    """The command for a robot that should be at reference (n, 2 or 1), metres, and go on by c (n, 2 or 1), trajectory units."""
    correction = FEEDBACK * (reference - robots.place()) / scale
    c = c + correction * (CORRECTION / correction.norm(dim=1, keepdim=True).clamp(min=CORRECTION))
    longest = (0.2 + (FASTEST - 0.2) * robots.age() / SOFT_START).clamp(max=FASTEST)
    return c * (longest / torch.maximum(c.norm(dim=1, keepdim=True), longest))


def execute(policy, robots, commands, hold, closed, deterministic):
    """Alg. 2, lines 13-19: hold each command for `hold` (H_z) environment steps. commands (n, T, c_dim) in trajectory units.
    Yields what Robots.step returns, after each step (for contacts, frames and stopping)."""
    reference = robots.place()
    for c in commands.unbind(1):
        for _ in range(hold):
            asked = closed_loop(c, reference, robots, policy.scale) if closed else c
            yield robots.step(policy.actor.act(robots.observe(), asked, deterministic).numpy())
            if closed:
                reference = reference + policy.scale * c


def load_policy(out, experiment, seed, quiet=False):
    """A policy artifact of 03 as a namespace: networks actor and decoder; method, robot, names (of the axes; [] for DADS and
    SeCTAR), relation (weights of the relation functions), scale (metres per trajectory unit), and all else that it holds."""
    content = load(out, "policy", experiment, seed, quiet)
    return SimpleNamespace(**content | dict(actor=unpack(content["actor"]), decoder=unpack(content["decoder"])))


# ---------------------------------------------------------------- plots

# The paper's red, green, blue, cyan, yellow for latents (-1, -0.5, 0, 0.5, 1), in colour-blind safe hues (Okabe-Ito).
LATENT_COLOURS = dict(zip((-1, -0.5, 0, 0.5, 1), ("#D55E00", "#009E73", "#0072B2", "#56B4E9", "#F0E442")))
BLUE, RED, GREY = "#0072B2", "#D55E00", "#888888"
TRAVERSAL_MAP = "viridis"  # for many values of one latent
plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
                     "grid.alpha": 0.25, "figure.dpi": 110, "savefig.bbox": "tight", "legend.frameon": False,
                     "axes.titlesize": 10, "figure.constrained_layout.use": True})


def save_figure(figure, out, name):
    """Write <out>/figures/<name>.png."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    plt.close(figure)
    print(f"wrote {write_whole(Path(out) / 'figures' / f'{name}.png', buffer.getvalue())}")
