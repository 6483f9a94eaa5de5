"""Stage 1: factors -> trajectories (App. A.1.1, Table 1, Fig 9).

Draws the factors of interest and makes of each draw a trajectory of T transitions from the origin. Writes,
below runs/, dataset_<experiment>_seed<seed>.npz with trajectories (N, T + 1, 2 or 1), factors (N, M), their
names (M,) and ranges (M, 2), angles in radians, and for main and full Fig 9. Takes 5 seconds. Expect of main:
a mean speed of 0.50, and 20 % of the trajectories straight.
"""
import math

import numpy as np

import common
from common import Count, Degrees, Positive, Share, Signed, plt, stop, weak_labels

EXPERIMENT: str = "main"      # row of EXPERIMENTS below
SEED: int = 0                 # random seed of the whole chain: data, decoder, policy
OUT: str = "runs"             # folder of all that is written
FIGURE: str = ""              # name of Fig 9 ("": dataset_<experiment>); other FACTORS than these have none

TRAJECTORIES: Count = 100_000  # N, App. A.1.1
LENGTH: Count = 5             # T, transitions per trajectory
FACTORS: str = "speed direction curvature"  # if direction is left out, trajectories have one dimension
SPEED_LOW: Signed = 0.0       # speed ~ U(SPEED_LOW, SPEED_HIGH), Table 1, trajectory units per transition
SPEED_HIGH: Positive = 1.0    # in one dimension a speed has a sign
DIRECTION: Degrees = 90.0     # direction ~ U(-DIRECTION, DIRECTION), degrees: the right-sided semicircle
CURVATURE: Degrees = 30.0     # curvature ~ U(-CURVATURE, CURVATURE), degrees per transition; + turns left
ACCELERATION: float = 0.2     # growth per transition, a share of the speed, ~ U(-ACCELERATION, ACCELERATION)
STRAIGHT: Share = 0.2         # probability that the curvature (ours: the acceleration too) is exactly 0

EXPERIMENTS = {  # a row names the constants in which an experiment differs
    "main": dict(FIGURE="fig09_dataset"),
    "full": dict(DIRECTION=180.0),                                        # the Ant of Fig 15
    "polar": dict(FACTORS="speed direction", DIRECTION=180.0),            # Fig 11: radius and angle
    "speed_acc": dict(FACTORS="speed acceleration", SPEED_LOW=-1.0),      # Fig 12 and 16, in one dimension
    "four_factors": dict(FACTORS="speed direction curvature acceleration", DIRECTION=180.0),  # Fig 13
}
# The example that 01, 02 and 03 follow
EXAMPLE = dict(speed=np.array([0.6]), direction=np.radians([20.0]), curvature=np.radians([-10.0]))


def make_trajectories(speed, direction=None, curvature=0.0, acceleration=0.0, length=5):
    """Factors (N,) each, angles in radians -> points (N, length + 1, 2), App. A.1.1. The first transition is
    `speed` long and points in `direction`; each next one turns by `curvature` and is longer by `acceleration`
    times `speed`. Without direction: one dimension, (N, length + 1, 1), in which the speed has a sign."""
    t = np.arange(length)
    displacements = (speed[:, None] * (1 + np.multiply.outer(acceleration, t)))[..., None]  # (N, T, 1)
    if direction is not None:
        heading = direction[:, None] + np.multiply.outer(curvature, t)
        displacements = displacements * np.stack([np.cos(heading), np.sin(heading)], -1)  # (N, T, 2)
    return np.pad(displacements.cumsum(1), ((0, 0), (1, 0), (0, 0)))  # s_0 is the origin, Sec. 4.1


def main():
    config, _ = common.parse_flags(globals())  # each constant with a type is a flag, such as --seed 1
    limits = dict(speed=(SPEED_LOW, SPEED_HIGH), direction=(-DIRECTION, DIRECTION),
                  curvature=(-CURVATURE, CURVATURE), acceleration=(-ACCELERATION, ACCELERATION))
    check(FACTORS.split(), limits)
    names = [name for name in limits if name in FACTORS.split()]  # this order is that of z in all stages
    unit = dict(speed=1.0, direction=math.pi / 180, curvature=math.pi / 180, acceleration=1.0)
    rng = np.random.default_rng(SEED)
    factors = {name: unit[name] * rng.uniform(*limits[name], TRAJECTORIES) for name in names}  # Table 1
    for name in names:
        if name in common.MULTI:
            factors[name] *= rng.random(TRAJECTORIES) >= STRAIGHT  # 0 for some: straight lines, A.1.1
    trajectories = make_trajectories(**factors, length=LENGTH)  # Alg. 1, "Generate"
    ranges = {name: unit[name] * np.array(limits[name]) for name in names}  # the limits, in radians
    example = {}
    if names == list(EXAMPLE):
        example["example"] = make_trajectories(**EXAMPLE, length=LENGTH).astype(np.float32)
        example["example_factors"] = np.stack(list(EXAMPLE.values()), 1)
    path = common.save(OUT, "dataset", EXPERIMENT, SEED, config, trajectories=trajectories.astype(np.float32),
                       factors=np.stack(list(factors.values()), 1).astype(np.float32),
                       names=np.array(names), ranges=np.array(list(ranges.values())), **example)
    print(f"wrote {path}\nTable 1, as drawn: {TRAJECTORIES} trajectories of T = {LENGTH}; angles in degrees")
    for name, values in factors.items():
        shown, zero = values / unit[name], np.mean(values == 0)
        print(f"{name:12}  U{limits[name]!s:16}  mean {shown.mean():.3f}  min {shown.min():.3f}  "
              f"max {shown.max():.3f}  exactly 0: {zero:.3f}")
    if example:
        print("one skill, followed (degrees):", *(f"{k} {v[0] / unit[k]:g}" for k, v in EXAMPLE.items()))
        print("  its points:", *(f"({x:.2f}, {y:.2f})" for x, y in example["example"][0]), " its labels:",
              *weak_labels(EXAMPLE, names, ranges)[0] + 1)
        draw(trajectories[:4000], {name: values[:4000] for name, values in factors.items()}, ranges)


# ======== not needed to understand the method

def check(names, limits):
    """End with one line if these constants make no data set from which the factors can be learnt."""
    if "speed" not in names or not set(names) <= set(limits):
        stop(f"--factors {FACTORS!r} must name speed, and besides it only {' '.join(limits)}")
    if ("curvature" in names and "direction" not in names) or ("direction" in names and SPEED_LOW < 0):
        stop("--factors curvature needs direction; with direction --speed_low must be at least 0")
    for name in names:
        if name in common.MULTI and LENGTH == 1:
            stop(f"{name} needs --length 2 or more: it is a change from one transition to the next")
        if (name in common.MULTI and STRAIGHT == 1) or limits[name][0] >= limits[name][1]:
            stop(f"{name} never changes: widen its range, lower --straight, or leave it out of --factors")
    common.need_memory(100 * TRAJECTORIES * (LENGTH + 1), "--trajectories or --length")


def draw(trajectories, factors, ranges):
    """Fig 9: the labelling criteria (left, middle) and trajectories by their curvature label (right)."""
    figure, (fan, turns, data) = plt.subplots(1, 3, figsize=(10.5, 3.9))
    speed, direction, curvature = weak_labels(factors, ["speed", "direction", "curvature"], ranges).T
    speeds, directions = common.CLASSES["speed"], common.CLASSES["direction"]
    fan.scatter(*trajectories[:, 1].T, s=4, c=direction, cmap="Set2", vmax=7, alpha=(1 + speed) / speeds)
    for k, m in np.ndindex(speeds, directions):  # in the middle of each class
        size = np.interp((k + 0.5) / speeds, (0, 1), ranges["speed"])
        angle = np.interp(1 - (m + 0.5) / directions, (0, 1), ranges["direction"])  # 1: the largest angles
        fan.text(size * math.cos(angle), size * math.sin(angle), f"{k + 1},{m + 1}", ha="center", va="center")
    fan.set(title="labels (speed, direction)", xlabel="first transition: x", ylabel="y", aspect="equal")
    colours = (common.GREY, common.BLUE, common.RED)
    for label, (text, sign) in enumerate((("1: straight", 0), ("2: left", 1), ("3: right", -1))):
        turn = sign * ranges["curvature"][1] * np.array([1 / 3, 2 / 3, 1])
        paths = make_trajectories(np.ones(3), np.zeros(3), turn, length=LENGTH)
        turns.plot(*paths.T, "o-", ms=3, color=colours[label], label=[text, "_", "_"])
    turns.set(title=f"label curvature, {CURVATURE:g} degrees at most", xlabel="x", aspect="equal")
    turns.legend(loc="upper left", fontsize=8, handlelength=1)
    for path, label in zip(trajectories[:300], curvature):
        data.plot(*path.T, color=colours[label], lw=0.6, alpha=0.7)
    data.set(title="trajectories of the data set", xlabel="x (trajectory units)", aspect="equal")
    common.save_figure(figure, OUT, FIGURE or f"dataset_{EXPERIMENT}")


if __name__ == "__main__":
    main()
