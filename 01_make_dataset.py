"""Stage 1: factors -> trajectories (App. A.1.1, Table 1, Fig 9).

Draws factors (speed, direction, curvature; in other experiments acceleration), turns each draw into a trajectory of T transitions
from the origin, and writes runs/dataset_<experiment>_seed<seed>.npz: trajectories (N, T + 1, 2 or 1), factors (N, M), names (M,),
ranges (M,). No robot is involved: the trajectories are what we want a robot to be able to do. Takes 6 s.
"""
import math

import numpy as np

import common
from common import parse_flags, plt, save, save_figure, stop, weak_labels

EXPERIMENT = "main"     # row of EXPERIMENTS below
SEED = 0                # random seed
OUT = "."               # folder for runs/ and figures/

TRAJECTORIES = 100_000  # N, App. A.1.1
LENGTH = 5              # T, transitions per trajectory
FACTORS = "speed direction curvature"  # what is drawn; without direction the trajectories are one-dimensional
SPEED_LOW = 0.0         # speed ~ U(SPEED_LOW, SPEED_HIGH), trajectory units per transition (Table 1, 2D)
SPEED_HIGH = 1.0        # no transition is longer than 1
DIRECTION = 90.0        # direction ~ U(-DIRECTION, DIRECTION), degrees: the right-sided semicircle
CURVATURE = 30.0        # curvature ~ U(-CURVATURE, CURVATURE), degrees turned per transition
ACCELERATION = 0.2      # acceleration ~ U(-ACCELERATION, ACCELERATION) times the speed, per transition; + is speeding up
STRAIGHT = 0.2          # probability that the curvature is exactly 0; the same for the acceleration

EXPERIMENTS = {  # a row names the constants in which an experiment differs from the ones above
    "main": {},
    "full": dict(DIRECTION=180.0),                                                        # the Ant of Fig 15
    "polar": dict(FACTORS="speed direction", DIRECTION=180.0),                            # Fig 11: radius and angle
    "speed_acc": dict(FACTORS="speed acceleration", SPEED_LOW=-1.0),                      # Fig 12, 16: one dimension
    "four_factors": dict(FACTORS="speed direction curvature acceleration", DIRECTION=180.0),  # Fig 13
}


def make_trajectories(speed, direction=None, curvature=0.0, acceleration=0.0, length=5):
    """Factors (N,) each -> points (N, length + 1, 2): steps of `speed`, the heading turned by `curvature` and the step longer by
    `acceleration` times `speed` at each one. Without direction: one dimension (N, length + 1, 1), where speed has a sign."""
    t = np.arange(length)
    speed = speed[:, None] * (1 + np.multiply.outer(acceleration, t))
    steps = speed[..., None]
    if direction is not None:
        heading = direction[:, None] + np.multiply.outer(curvature, t)
        steps = steps * np.stack([np.cos(heading), np.sin(heading)], -1)
    return np.pad(steps.cumsum(1), ((0, 0), (1, 0), (0, 0)))  # s_0 is fixed at the origin, Sec. 4.1


def draw_fig09(trajectories, factors):
    """Fig 9: the labelling criteria (left, middle) and trajectories of the data set by their curvature label (right)."""
    figure, (rings, fan, data) = plt.subplots(1, 3, figsize=(10.5, 3.9))
    for i, angle in enumerate(range(90, -90, -45)):
        shades = plt.get_cmap("Blues")(np.linspace(0.15, 0.6, 4))
        for j, radius in enumerate((0.25, 0.5, 0.75, 1.0)):
            t = np.radians(np.linspace(angle, angle - 45, 30))
            edge = [np.r_[r * f(t), (r - 0.25) * f(t[::-1])] for r, f in ((radius, np.cos), (radius, np.sin))]
            rings.fill(*edge, color=shades[j], ec="white")
            middle = np.radians(angle - 22.5)
            rings.text((radius - 0.125) * np.cos(middle), (radius - 0.125) * np.sin(middle), f"{j + 1},{i + 1}",
                       ha="center", va="center", fontsize=7)
    rings.set(title="labels (speed, direction)", xlabel="x of a transition", ylabel="y of a transition", aspect="equal")
    names = ("1: straight", "2: left", "3: right")
    colours = (common.GREY, common.BLUE, common.RED)
    for label, curvatures in enumerate(([0.0], [10, 20, 30], [-10, -20, -30])):
        for k, degrees in enumerate(curvatures):
            path = make_trajectories(np.ones(1), np.zeros(1), np.radians([degrees]), length=LENGTH)[0]
            fan.plot(*path.T, "o-", ms=3, color=colours[label], label=names[label] if k == 0 else None)
    fan.set(title="label curvature (10, 20, 30° per transition)", xlabel="x", ylabel="y", aspect="equal")
    fan.legend(loc="upper left")
    labels = weak_labels(factors, ["curvature"])[:, 0]
    for path, label in list(zip(trajectories, labels))[:300]:
        data.plot(*path.T, color=colours[label], lw=0.6, alpha=0.7)
    data.set(title="300 trajectories of the data set", xlabel="x (trajectory units)", ylabel="y (trajectory units)", aspect="equal")
    save_figure(figure, OUT, "fig09_dataset")


if __name__ == "__main__":
    config = parse_flags(globals())
    if min(TRAJECTORIES, LENGTH) < 1 or STRAIGHT > 1 or SPEED_LOW > SPEED_HIGH:
        stop("--trajectories and --length must be at least 1, --straight at most 1, --speed_low at most --speed_high")
    limits = {"speed": (SPEED_LOW, SPEED_HIGH), "direction": (-DIRECTION, DIRECTION), "curvature": (-CURVATURE, CURVATURE),
              "acceleration": (-ACCELERATION, ACCELERATION)}
    names = FACTORS.split()
    if "speed" not in names or sorted(names) != sorted(set(names) & set(limits)):
        stop(f"--factors {FACTORS!r} must name speed, and may name direction, curvature and acceleration, each once")
    rng = np.random.default_rng(SEED)
    factors = {}
    for name in names:
        factors[name] = rng.uniform(*limits[name], TRAJECTORIES)
        if name in ("direction", "curvature"):
            factors[name] = np.radians(factors[name])
    for name in [n for n in names if n in ("curvature", "acceleration")]:
        factors[name] *= rng.random(TRAJECTORIES) >= STRAIGHT
    trajectories = make_trajectories(**factors, length=LENGTH)
    ranges = [np.ptp(limits[name]) * (math.pi / 180 if name in ("direction", "curvature") else 1) for name in names]
    path = save(OUT, "dataset", EXPERIMENT, SEED, config, trajectories=trajectories.astype(np.float32),
                factors=np.stack(list(factors.values()), 1).astype(np.float32), names=np.array(names), ranges=np.array(ranges))

    print(f"Table 1, as run: {TRAJECTORIES} trajectories of T = {LENGTH} in {trajectories.shape[2]}D")
    print("factor        distribution              mean      min      max   exactly 0")
    units = {"speed": "", "direction": " deg", "curvature": " deg", "acceleration": " x speed"}
    for name in names:
        f = np.degrees(factors[name]) if "deg" in units[name] else factors[name]
        text = "U({:g}, {:g})".format(*limits[name]) + units[name]
        print(f"{name:13s} {text:22s} {f.mean():8.3f} {f.min():8.3f} {f.max():8.3f}   {np.mean(f == 0):.3f}")
    print(f"wrote {path}")
    if EXPERIMENT == "main":
        draw_fig09(trajectories, factors)
