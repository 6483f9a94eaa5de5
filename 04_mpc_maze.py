"""Stage 4: decoder + policy -> mazes solved without training in them (Sec. 5, Algorithm 2, Sec. 6.2).

In: policy_<POLICY>_seed<n>.pt of stage 3. Out: <OUT>/results/<EXPERIMENT>.csv, a row per trial, and figures.
  python 04_mpc_maze.py   Fig 3, 6, 8, 14, 17 and GIFs, 56 s on two cores; others: --experiment figure7 ..
Expect, mean final distance of 3 policies x 50 trials (dense maze 1, 2; sparse maze 1, 2): 4.1, 2.0, 4.7,
4.8 m as printed; 0.8, 0.5, 3.6, 3.5 m in closed loop. The start is 26.8 m from the goal.
"""
import hashlib
import io
import time
from functools import cache, partial
from itertools import cycle, product
from pathlib import Path
from types import SimpleNamespace

import common  # before mujoco: it chooses how mujoco renders
from common import BLUE, GREY, RED, commands_of, execute, plt, stop
import mujoco
import numpy as np
import torch
from PIL import Image  # comes with matplotlib

EXPERIMENT = "mazes"      # row of EXPERIMENTS below
SEED = 0                  # random seed of the trials
OUT = "runs"              # folder that everything is written to
THREADS = 2               # CPU threads
DRAW = "fig03 fig06 fig08 fig14 fig17 gif"  # rows of DRAWINGS below
DRIVE = False             # true: only serve a page with a slider for each axis of z
SECONDS = 0.0             # until the page ends by itself; 0: when it is closed
PORT = 8080               # of the page, on this machine alone; 0: the first free one

METHOD = "wedis"          # rows of METHODS below
MAZES = "maze1 maze2"     # rows of MAZE below
REWARDS = "dense sparse"  # Sec. 6.2
MODES = "printed closed"  # Algorithm 2 as printed; ours: closed loop with mean actions
POLICY = "ant_semi"       # experiment of 03
POLICY_SEEDS = "0"        # and its seeds
TRIALS = 50               # of each configuration (the paper: 10)

# Table 2, the row of WEDIS
EPISODE = 600             # H_E, environment steps
HOLD = 40                 # H_z, environment steps for which z_single is held
LENGTH = 5                # T, transitions of a skill
PLANNED = 3               # H_P, skills planned ahead, dense reward; sparse: to the end of the episode
Z_RANGE = 1.5             # skills ~ U(-Z_RANGE, Z_RANGE), but speed ~ U(0, Z_RANGE)

# Planning, App. A.1.4
SAMPLES = "1000"          # N, sequences of skills per plan; one or more numbers
LOOK_AHEAD = ""           # steps to plan ahead, one or more numbers ("": Table 2's H_P)
POOL = 65536              # skills, decoded once, that plans draw from (the paper: no pool)
PENALTY = 100.0           # w_p, for each transition of a plan that collides
REWARD_WEIGHT = 5.0       # w_r, sparse reward
EPSILON = 5.0             # epsilon, metres: acceptable error; who ends nearer succeeds
RADIUS = 1.0              # metres by which the planner grows the walls: the Ant's legs
GOAL = (24.0, 12.0)       # metres; the Ant starts at (0, 0)

METHODS = {  # Table 2. The later wins: the file, EXPERIMENTS, MAZE, METHODS, flags
    "wedis": {},
    "wedis_s": dict(MODES="printed", LENGTH=1, PLANNED=4),  # single steps
    "wedis_nts": dict(MODES="printed", HOLD=1, LENGTH=20, PLANNED=4),  # no trajectory scaling
    # App. A.1.4 gives DADS U(-1, 1), as it is trained, and SeCTAR U(-1.5, 1.5); Table 2 swaps the two.
    "dads": dict(MODES="printed", POLICY="ant_dads", POLICY_SEEDS="0 1", EPISODE=300, HOLD=20, LENGTH=1,
                 PLANNED=4, Z_RANGE=1.0),
    "sectar": dict(MODES="printed", POLICY="ant_sectar", POLICY_SEEDS="0 1", HOLD=1, LENGTH=40, PLANNED=4),
}
STUDY = dict(METHOD=" ".join(METHODS), POLICY_SEEDS="0 1 2", TRIALS=20)
EXPERIMENTS = {  # a row names the constants in which an experiment differs; its name is that of its CSV
    "mazes": {},
    "figure7": STUDY | dict(DRAW="fig07", SAMPLES="10 30 100 300 1000 3000"),  # stopped, it goes on
    "fig18": dict(MAZES="s_maze obstacles", REWARDS="dense", MODES="closed", POLICY_SEEDS="0 1 2",
                  DRAW="fig18"),
    "drive": dict(DRIVE=True, MAZES="open", MODES="closed"),
    "matched": STUDY | dict(DRAW="", LOOK_AHEAD="200 600"),  # all methods look equally far ahead
}
HULL = [(-7, -6, -7, 19), (31, 32, -7, 19), (-7, 32, -7, -6), (-7, 32, 18, 19)]  # x0, x1, y0, y1, metres
MAZE = {  # walls, and the constants in which a maze differs; plan a row of your own with --mazes <its name>
    "maze1": dict(WALLS=HULL + [(17, 18, 5, 18), (5, 18, 5, 6)]),  # L; the trap is at the top left
    "maze2": dict(WALLS=HULL + [(7, 8, 4, 18), (16, 17, -6, 8)]),  # Z; the trap is at the bottom right
    "s_maze": dict(WALLS=[(-7, -6, -13, 13), (45, 46, -13, 13), (-7, 46, -13, -12), (-7, 46, 12, 13),
                          (9, 10, -12, -0.5), (28, 29, 0.5, 12)],
                   GOAL=(38.0, 0.0), HOLD=50, LENGTH=6, PLANNED=2, EPISODE=600),
    "obstacles": dict(WALLS=HULL + [(7, 9, 2.5, 4.5), (13, 15, 10, 12), (12, 14, 0, 2), (2, 4, 7, 9)],
                      GOAL=(17.0, 8.0), HOLD=50, LENGTH=5, PLANNED=1, EPISODE=250),
    "open": dict(WALLS=[]),
}


# -------- Algorithm 2, Sec. 5
# Lines are counted from "for i"; a skill's commands (lines 17 and 18) are computed at once.
# A unit u is one method, maze, mode and policy; it holds the constants, in lower case. All its cases (reward,
# N, H_P) with all their trials run in one simulation.

def skill_pool(u):
    """The skills that plans draw from: z (POOL, M), and the displacements that they predict (POOL, T, 2),
    trajectory units. Printed: the decoder's mean for T free steps; closed: the commands."""
    high = torch.full((u.policy.decoder.arguments[0],), u.z_range)
    low = -high
    if u.policy.names:  # speed is the first axis; the paper: U(-1.5, 0), for its axis points the other way
        low[0] = 0
    z = low + (high - low) * torch.rand(u.pool, len(low))
    if u.mode == "closed":
        return z, torch.cat([commands_of(u.policy, part, u.length) for part in z.split(8192)])
    return z, torch.cat([u.policy.decoder(part, u.length)[0] for part in z.split(8192)])


def scaled_path(state, delta, scale):
    """Trajectory scaling, Fig 3: displacements (N, T, 2) after states (N, 1, 2) -> the T states, metres.
    scale: H_z times a trajectory unit's metres. The paper prints s_0 where the planned state must stand."""
    return state + scale * delta.cumsum(1)


def reward(path, u, kind):
    """Planning reward r_d or r_s, Sec. 6.2, of paths (N, K + 1, 2), metres -> (N,): the task reward of the
    last state less w_p for each transition that collides."""
    distance = (path[:, -1] - torch.tensor(u.goal)).norm(dim=1)  # -r(s)
    penalty = u.penalty * collides(path, u.walls, u.radius).sum(1)
    if kind == "sparse":
        return u.reward_weight * (distance < u.epsilon) - penalty  # r_s
    return -distance - penalty  # r_d


def plan(u, kind, samples, horizon, pool, s0):
    """Algorithm 2, lines 2 to 12: the best of `samples` (N) random sequences of `horizon` (H_P) skills from
    s0 (2,), metres. Returns its first skill z (M,) and its path (H_P T + 1, 2)."""
    z, delta = pool
    state = s0.expand(samples, 1, 2)  # line 2
    picked = torch.randint(len(z), (samples, horizon))  # line 3
    path = [state]
    for j in range(horizon):  # line 4
        delta_j = delta[picked[:, j]]  # lines 5 and 6
        path.append(scaled_path(state, delta_j, u.policy.scale * u.hold))  # line 7
        state = path[-1][:, -1:]  # line 8
    path = torch.cat(path, 1)
    best = reward(path, u, kind).argmax()  # lines 10 and 11
    return z[picked[best, 0]], path[best].clone()  # the trap: a view would keep all N paths in memory


def run(u):
    """Algorithm 2 for all cases and trials of a unit. Returns rows for the CSV, and trials 0 to 2 of each
    case with their poses (steps + 1, nq) and, for each plan, its step and path (H_P T + 1, 2)."""
    skill_steps = u.hold * u.length
    skills = u.episode // skill_steps
    cases = []
    for kind, samples, steps in product(u.rewards, u.samples, u.look_ahead):
        planned = skills if kind == "sparse" else u.planned  # App. A.1.4
        if steps:
            planned = max(1, steps // skill_steps)
        cases.append((kind, samples, min(planned, skills)))
    trials = [SimpleNamespace(u=u, reward=kind, samples=samples, planned=planned, trial=n, plans=[], time=0)
              for kind, samples, planned in dict.fromkeys(cases) for n in range(u.trials)]
    robots = common.Robots(maze_spec(u), len(trials), THREADS)  # an unstable one starts anew at the origin
    for first in range(0, len(trials), u.trials):  # every case has the same starts
        robots.reset(np.arange(first, first + u.trials), np.random.default_rng(u.seed))
    torch.manual_seed(u.seed)
    pool, closed = skill_pool(u), u.mode == "closed"
    poses = [robots.qpos.copy()]
    for i in range(skills):  # line 1
        chosen = []
        for t, s0 in zip(trials, robots.place()):  # line 20, of the round before
            clock = time.perf_counter()
            horizon = min(t.planned, skills - i)  # no plan looks beyond the end of the episode
            z, path = plan(u, t.reward, t.samples, horizon, pool, s0)  # lines 2 to 12
            t.time += time.perf_counter() - clock
            t.plans.append((len(poses) - 1, path.numpy()))
            chosen.append(z)
        commands = commands_of(u.policy, torch.stack(chosen), u.length)  # lines 17 and 18
        for _ in execute(u.policy, robots, commands, u.hold, closed, deterministic=closed):  # lines 13 to 19
            poses.append(robots.qpos.copy())

    rows = []
    for n, t in enumerate(trials):
        t.poses = np.stack([pose[n] for pose in poses])
        distance = np.linalg.norm(t.poses[-1, :2] - u.goal)
        rows.append(dict(
            maze=u.maze, reward=t.reward, method=u.method, mode=u.mode, look_ahead=t.planned * skill_steps,
            samples=t.samples, trial=t.trial, seed=u.seed, final_distance=distance,
            success=int(distance < u.epsilon), planning_ms=1e3 * t.time / skills,
            policy_seed=u.policy_seed, policy=u.policy.sha256[:8], settings=u.settings))
    return rows, [t for t in trials if t.trial < 3]


def main():
    units = units_of(*common.parse_flags(globals()))
    torch.set_num_threads(1)  # tensors are small here; THREADS are for the physics
    if DRIVE:
        import drive  # not in the paper
        return drive.drive(units[0], maze_spec(units[0]), skill_pool(units[0]), plan, SECONDS, PORT)
    path, start = Path(OUT) / "results" / f"{EXPERIMENT}.csv", time.time()
    examples, done = [], set()
    if path.exists() and set(DRAW.split()) <= {"fig06", "fig07", "fig14"}:  # others need the paths
        done = {row.get("settings") for row in common.read_csv(path)}
    for u in units:
        if u.settings in done:
            print(f"{u.title}: in {path} already, with the same settings")
            continue
        rows, found = run(u)
        common.update_csv(path, rows, ("maze", "method", "mode", "seed", "policy_seed"))
        examples += found
        print(f"{time.time() - start:4.0f} s  {u.title}", flush=True)
    present = {u.settings for u in units}
    rows = [row for row in common.read_csv(path) if row.get("settings") in present]
    print(f"wrote {path}; mean distance to the goal at the end, share of trials nearer than EPSILON:")
    print_table(rows)
    for name in DRAW.split():
        if name not in NEED_GL or can_render():
            DRAWINGS[name](rows, units, examples)


def maze_spec(u):
    """The Ant between real walls 1 m high, and the goal as a red disc."""
    spec = mujoco.MjSpec.from_file(str(common.HERE / "ant.xml"))
    maze = spec.worldbody.add_body(name="maze")
    for x0, x1, y0, y1 in u.walls:
        maze.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=[(x0 + x1) / 2, (y0 + y1) / 2, 0.5], conaffinity=1,
                      size=[(x1 - x0) / 2, (y1 - y0) / 2, 0.5], rgba=[0.45, 0.5, 0.6, 1])
    spec.worldbody.add_site(pos=[*u.goal, 0.1], type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.8, 0.1, 0],
                            rgba=[0.85, 0.2, 0.1, 1])
    return spec


def collides(path, walls, radius):
    """Which transitions of paths (N, K + 1, 2) touch a wall grown by radius, metres: (N, K) bool. Exact, by
    separating axes: segment and rectangle are apart if they are along x, along y, or across the segment."""
    (x, y), (dx, dy) = path[:, :-1].unbind(2), path.diff(dim=1).unbind(2)
    low, high = torch.minimum(path[:, :-1], path[:, 1:]), torch.maximum(path[:, :-1], path[:, 1:])
    hit = torch.zeros(x.shape, dtype=torch.bool)
    for x0, x1, y0, y1 in walls:
        x0, x1, y0, y1 = x0 - radius, x1 + radius, y0 - radius, y1 + radius
        near = ((low <= torch.tensor([x1, y1])) & (high >= torch.tensor([x0, y0]))).all(2)
        across = dx * (y - (y0 + y1) / 2) - dy * (x - (x0 + x1) / 2)
        hit |= near & (across.abs() <= (dx.abs() * (y1 - y0) + dy.abs() * (x1 - x0)) / 2)
    return hit


# -------- what is planned: rows, flags, checks

# not for rows of MAZE and METHODS
OF_A_RUN = "EXPERIMENT OUT THREADS DRAW METHOD MAZES DRIVE SECONDS PORT".split()
load_once = cache(common.load)


def words(text, name, allowed):
    """The words of text. Exits with 2 if there are none, or one is not allowed."""
    for word in text.split() or [""]:
        if word not in allowed:
            stop(f"unknown {word!r} in --{name}; allowed: {' '.join(allowed)}")
    return list(dict.fromkeys(text.split()))


def numbers(text, name, like=1):
    """The whole numbers of text. Exits with 2 if there are none."""
    return [common.convert(word, like, name) for word in text.split() or [""]]


def settings(method, maze, config, given):
    """The constants of a method in a maze. The later wins: config (file, EXPERIMENTS), MAZE, METHODS, given
    (flags). Exits with 2 if they make no sense."""
    rows, of = MAZE[maze] | METHODS[method], f"{method} in {maze}"
    walls = rows.pop("WALLS", [])
    for name, value in rows.items():
        if name not in config or name in OF_A_RUN:
            stop(f"{of}: {name} is no constant that a row may set")
        rows[name] = common.convert(value, config[name], f"{of}: {name}")
    values = {name.lower(): value for name, value in (config | rows | given).items() if name not in OF_A_RUN}
    u = SimpleNamespace(**values | dict(method=method, maze=maze, walls=walls))
    u.modes = words(u.modes, "modes", ["printed", "closed"])
    u.rewards = words(u.rewards, "rewards", ["dense", "sparse"])
    u.samples = numbers(u.samples, "--samples")
    u.look_ahead = numbers(u.look_ahead, "--look_ahead") if u.look_ahead else [0]
    u.policy_seeds = numbers(u.policy_seeds, "--policy_seeds", 0)
    if "fig07" in DRAW and len(u.look_ahead) > 1:
        stop("fig07 is for one --look_ahead")
    if u.episode < u.hold * u.length:
        stop(f"{of}: an episode has {u.episode} steps, but one skill {u.hold * u.length}")
    for wall in walls:
        if not (isinstance(wall, tuple) and len(wall) == 4 and wall[0] < wall[1] and wall[2] < wall[3]):
            stop(f"{of}: WALLS: each is (x0, x1, y0, y1), x0 < x1, y0 < y1")
    return u


def units_of(config, given):
    """All units of a run."""
    units = []
    if DRAW:
        words(DRAW, "draw", DRAWINGS)
    for method, maze in product(words(METHOD, "method", METHODS), words(MAZES, "mazes", MAZE)):
        shared = settings(method, maze, config, given)
        for mode, seed in product(shared.modes, shared.policy_seeds):
            title = f"{method} {mode}, {maze}, {shared.policy} seed {seed}"
            policy = SimpleNamespace(**load_once(OUT, "policy", shared.policy, seed))
            if policy.robot != "ant" or mode == "closed" and not policy.names:
                stop(f"{title}: mazes are for the ant, the closed loop for WEDIS alone")
            if policy.method == "dads" and shared.length > 1:
                stop(f"{title}: DADS predicts one step: --length 1")
            u = SimpleNamespace(**vars(shared) | dict(mode=mode, policy_seed=seed, title=title))
            del u.modes, u.policy_seeds  # what else is planned changes no result
            following = common.FEEDBACK, common.CORRECTION, common.FASTEST, common.SOFT_START
            made_by = repr([sorted(vars(u).items()), policy.sha256, following])
            u.settings = hashlib.sha256(made_by.encode()).hexdigest()[:8]
            u.policy = policy
            units.append(u)
    return units


# -------- measuring, drawing: not part of the method

def values_of(rows, column, **where):
    """A column of the rows that agree with where: (policies, trials)."""
    found = {}
    for row in rows:
        if all(row[name] == str(value) for name, value in where.items()):
            found.setdefault(row["policy_seed"], []).append(float(row[column]))
    return np.array(list(found.values()))


def resampled_means(values, rng, draws=10_000):
    """Means (draws,) of values (policies, trials), policies and trials of each drawn with replacement: the
    hierarchical bootstrap."""
    policies, trials = values.shape
    drawn = rng.integers(policies, size=(draws, policies, 1))
    return values[drawn, rng.integers(trials, size=(draws, policies, trials))].mean((1, 2))


def print_table(rows):
    """A line per maze, reward, method, N and look-ahead, the modes side by side."""
    form, lines = "{maze:10} {reward:7} {method:10} N {samples:>5}, {look_ahead:>3} steps ahead", {}
    for row in rows:
        end = float(row["final_distance"]), float(row["success"])
        lines.setdefault(form.format(**row), {}).setdefault(row["mode"], []).append(end)
    for line, modes in lines.items():
        means = [(mode, *np.mean(ends, 0)) for mode, ends in modes.items()]
        cells = [f"{mode} {distance:4.1f} m {100 * success:3.0f} %" for mode, distance, success in means]
        print(line, *cells, sep=" | ")


def draw_maze(ax, u, title, marker):
    for x0, x1, y0, y1 in u.walls:
        ax.add_patch(plt.Rectangle((x0, y0), x1 - x0, y1 - y0, color="#7a869a", lw=0))
    ax.plot(0, 0, "o", ms=5, color="black")
    ax.plot(*u.goal, marker, ms=9, color=RED)
    ax.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=title)


def draw_fig03(rows, units, examples):
    """Fig 3: trajectory scaling, on a trial's first plan: the same shape, H_z times as large."""
    u, path = examples[0].u, examples[0].plans[0][1]
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2))
    for ax, scale, title in zip(axes, (1, u.hold), ("predicted", f"scaled by $H_z$ = {u.hold}")):
        for first in range(0, len(path) - 1, u.length):
            ax.plot(*((path[first:first + u.length + 1] - path[0]) * scale / u.hold).T, ".-")
        ax.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=title)
    common.save_figure(figure, OUT, "fig03_trajectory_scaling")


def draw_fig06(rows, units, examples):
    """Fig 6: the navigation tasks, goals as red circles."""
    mazes = {u.maze: u for u in units}
    figure, axes = plt.subplots(1, len(mazes), figsize=(4.5 * len(mazes), 3), squeeze=False)
    for ax, (maze, u) in zip(axes[0], mazes.items()):
        draw_maze(ax, u, maze, "o")
    common.save_figure(figure, OUT, "fig06_mazes")


def draw_fig07(rows, units, examples):
    """Fig 7: mean final distance against N, its 95 % interval over policies and trials; thin: each policy;
    dashed: the goal's distance from the start."""
    panels, rng = dict.fromkeys((row["maze"], row["reward"]) for row in rows), np.random.default_rng(0)
    curves = dict.fromkeys((u.method, u.mode) for u in units)
    sizes = sorted({int(row["samples"]) for row in rows})
    colours = [BLUE, RED, "#009E73", "#E69F00", "#CC79A7", "#56B4E9"]  # Okabe-Ito
    figure, axes = plt.subplots(1, len(panels), figsize=(3.6 * len(panels), 4), sharey=True, squeeze=False)
    for ax, (maze, kind) in zip(axes[0], panels):
        for (method, mode), colour, marker in zip(curves, cycle(colours), cycle("osD^vPX")):
            where = dict(maze=maze, reward=kind, method=method, mode=mode)
            found = {n: values_of(rows, "final_distance", samples=n, **where) for n in sizes}
            found = {n: values for n, values in found.items() if values.size}
            if not found:
                continue  # a row of METHODS may plan for one reward only
            means = [values.mean(1) for values in found.values()]
            resampled = [resampled_means(values, rng) for values in found.values()]
            low, high = np.quantile(resampled, [0.025, 0.975], axis=1)
            ax.fill_between(list(found), low, high, color=colour, alpha=0.15)
            ax.plot(list(found), means, color=colour, lw=0.5, alpha=0.6)
            ax.plot(list(found), np.mean(means, 1), color=colour, marker=marker, label=f"{method}, {mode}")
        goal = next(u.goal for u in units if u.maze == maze)
        ax.axhline(np.linalg.norm(goal), ls="--", color=GREY)
        ax.set(xscale="log", xlabel="N, samples per plan", title=f"{maze}, {kind} reward")
    axes[0, 0].set(ylim=(0, None), ylabel="final distance (m)")
    labels = {label: line for ax in axes[0] for line, label in zip(*ax.get_legend_handles_labels())}
    figure.legend(labels.values(), labels, loc="outside lower center", ncols=6)
    common.save_figure(figure, OUT, "fig07_planning")


def draw_examples(name, kind, rows, units, examples):
    """Fig 8, 17, 18: planned and executed paths of each method's first policy, a row per maze and mode."""
    seed = {u.method: u.policy_seed for u in reversed(units)}
    shown = [e for e in examples if e.reward == kind and e.u.policy_seed == seed[e.u.method]]
    if not shown:
        return print(f"no {name}: no trial has the {kind} reward")
    wide = min(3, shown[0].u.trials)
    high = -(-len(shown) // wide)
    figure, axes = plt.subplots(high, wide, figsize=(3.6 * wide, 2.4 * high), squeeze=False)
    for ax, example in zip(axes.flat, shown):
        u, poses = example.u, example.poses
        draw_maze(ax, u, u.title, "x")
        for first, path in example.plans:
            ends = np.stack([path[u.length], poses[first + u.hold * u.length, :2]])
            ax.plot(*ends.T, "--", color=GREY, lw=1.2)
            ax.plot(*path[:u.length + 1].T, ".-", color=BLUE, ms=4)
        ax.plot(*poses[:, :2].T, color=RED, lw=1.2)
    for ax in axes.flat[len(shown):]:
        ax.axis("off")
    figure.supxlabel("blue: predicted, orange: executed, dashed: error of the end", fontsize=9)
    common.save_figure(figure, OUT, name)


@cache  # the trap: where a first try fails, a second one ends the process
def can_render():
    """Whether MuJoCo can draw off-screen. If not, says so once."""
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception:  # its kind differs by platform
        print("no Fig 14, no GIF: MuJoCo's renderer finds no GL library (install EGL or OSMesa)")
        return False
    return True


def render(model, poses, height, width):
    """Pictures (height, width, 3) of a model in poses (n, nq)."""
    renderer, data, pictures = mujoco.Renderer(model, height, width), mujoco.MjData(model), []
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        renderer.update_scene(data)
        pictures.append(renderer.render())
    renderer.close()
    return pictures


def draw_fig14(rows, units, examples):
    """Fig 14: both robots."""
    figure, axes = plt.subplots(1, 2, figsize=(8, 3.2))
    for ax, name in zip(axes, ("ant", "half_cheetah")):
        model = mujoco.MjModel.from_xml_path(str(common.HERE / f"{name}.xml"))
        model.stat.extent = 2.2  # metres, what the default camera shows
        model.vis.map.shadowclip = 2  # or the floor is speckled
        ax.imshow(*render(model, model.key_qpos[:1], 400, 500))
        ax.set(title=name, xticks=[], yticks=[])
        ax.grid(False)
    common.save_figure(figure, OUT, "fig14_robots")


def draw_gif(rows, units, examples):
    """A GIF per maze: trial 0 of its first reward in the last mode."""
    firsts = [example for example in examples if (example.trial, example.reward) == (0, example.u.rewards[0])]
    for maze, example in {example.u.maze: example for example in firsts}.items():
        spec = maze_spec(example.u)
        for x, y in example.poses[::10, :2]:
            spec.worldbody.add_site(pos=[x, y, 0], size=[0.15, 0.15, 0.15], rgba=[0, 0.45, 0.7, 1])
        model = spec.compile()
        model.vis.global_.azimuth, model.vis.global_.elevation = 90, -65
        model.stat.extent *= 0.37  # the walls fill the picture
        pictures = [Image.fromarray(picture) for picture in render(model, example.poses[::8], 320, 480)]
        palette = pictures[0].quantize(48, Image.Quantize.MAXCOVERAGE)  # one for all, or colours flicker
        frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
        buffer = io.BytesIO()
        frames[0].save(buffer, "GIF", save_all=True, append_images=frames[1:], duration=80, loop=0)
        print(f"wrote {common.write_whole(Path(OUT) / 'figures' / f'{maze}.gif', buffer.getvalue())}")


DRAWINGS = dict(fig03=draw_fig03, fig06=draw_fig06, fig07=draw_fig07, fig14=draw_fig14, gif=draw_gif,
                fig08=partial(draw_examples, "fig08_mpc_examples", "sparse"),
                fig17=partial(draw_examples, "fig17_more_examples", "dense"),
                fig18=partial(draw_examples, "fig18_s_maze_obstacles", "dense"))
NEED_GL = {"fig14", "gif"}

if __name__ == "__main__":
    main()
