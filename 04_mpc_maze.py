"""Stage 4: decoder + policy -> mazes solved without training in them (Sec. 5, Algorithm 2, Sec. 6.2).

In: policy_<POLICY>_seed<n>.pt of stage 3. Out: <OUT>/results/<EXPERIMENT>.csv, a row per trial, and figures.
  python 04_mpc_maze.py   Fig 3, 6, 8, 14, 17, GIFs, 67 to 90 s on two cores; others: --experiment figure7 ..
Expect, with --policy_seeds 0,1,2, mean final distances over 3 x 50 trials (dense maze 1, 2; sparse maze 1, 2)
of 5.3, 4.4, 5.9, 9.3 m as printed; 1.5, 2.6, 4.5, 5.2 m planned with commands; 0.4, 0.8, 4.0, 3.7 m in closed
loop. The start is 26.8 m from the goal; the shortest path that stays 1 m from the walls is 36.4 m long.
"""
import time
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import cycle, product
from pathlib import Path
from types import SimpleNamespace

import common  # before mujoco: it chooses how mujoco renders
from common import BLUE, GREY, RED, Count, Signed, Threads, commands_of, convert, execute, plt, stop
import mujoco
import numpy as np
import torch

from extras import render

EXPERIMENT: str = "mazes"  # row of EXPERIMENTS below
SEED: int = 0             # random seed of the trials
OUT: str = "runs"         # folder that everything is written to
THREADS: Threads = 2      # CPU threads of the physics
DRAW: str = "fig03 fig06 fig08 fig14 fig17 gif"  # rows of DRAWINGS below

METHOD: str = "wedis"     # rows of METHODS below
MAZES: str = "maze1 maze2"  # rows of MAZE below
REWARDS: str = "dense sparse"  # Sec. 6.2
# printed: planned with one decoder run of T transitions; sampled actions, no feedback within a skill.
# commands: planned with what the robot is commanded. closed: as commands, with feedback and mean actions.
MODES: str = "printed commands closed"  # one or more of the three
POLICY: str = "ant_semi"  # experiment of 03
POLICY_SEEDS: tuple[int, ...] = (0,)  # and its seeds
TRIALS: Count = 50        # of each configuration (the paper: 10)

# Table 2, the row of WEDIS
EPISODE: Count = 600      # H_E, environment steps
HOLD: Count = 40          # H_z, environment steps for which z_single is held
LENGTH: Count = 5         # T, transitions of a skill
PLANNED: Count = 3        # H_P, skills planned ahead, dense reward; sparse: to the end of the episode
Z_RANGE: float = 1.5      # skills ~ U(-Z_RANGE, Z_RANGE), but speed ~ U(0, Z_RANGE)

# Planning, App. A.1.4
SAMPLES: tuple[Count, ...] = (10_000,)  # N, random sequences of which a plan is the best; one or more numbers
POOL: Count = 16384       # skills, decoded once, that plans draw from (the paper: no pool)
PENALTY: float = 100.0    # w_p, for each transition that collides
REWARD_WEIGHT: float = 5.0  # w_r, sparse reward
EPSILON: float = 5.0      # epsilon, metres: acceptable error; who ends nearer succeeds
RADIUS: float = 1.0       # metres by which the planner grows the walls, for the Ant's legs (not in the paper)
GOAL: tuple[Signed, Signed] = (24.0, 12.0)  # metres; the Ant starts at (0, 0)

# Where a value comes from, the later wins: this file, the row of EXPERIMENTS, of MAZE, of METHODS, flags.
STUDY = dict(METHOD="wedis wedis_s wedis_nts dads dads_speed sectar", POLICY_SEEDS=(0, 1, 2), TRIALS=20)
EXPERIMENTS = {  # a row names the constants in which an experiment differs; its name is that of its CSV
    "mazes": {},
    "figure7": STUDY | dict(SAMPLES=(10, 100, 300, 1000, 3000, 10_000), DRAW="fig07"),  # a rerun goes on
    # needs --planned 99 --samples 1000, as METHODS override this row: dense plans of 600 steps, as WEDIS's
    "matched": STUDY | dict(METHOD="wedis_s wedis_nts", REWARDS="dense", DRAW=""),
    "fig18": dict(MAZES="s_maze obstacles", REWARDS="dense", MODES="printed closed", POLICY_SEEDS=(0, 1, 2),
                  DRAW="fig18"),
}
HULL = [(-7, -6, -11, 19), (31, 32, -11, 19), (-7, 32, -11, -10), (-7, 32, 18, 19)]  # x0, x1, y0, y1, metres
MAZE = {  # walls, and the constants in which a maze differs; plan a row of your own with --mazes <its name>
    "maze1": dict(WALLS=HULL + [(14, 15, -3.5, 18), (5, 14, -3.5, -2.5)]),  # L; the trap: left of the wall
    "maze2": dict(WALLS=HULL + [(9, 10, -10, 6.5), (17, 18, 2.5, 18)]),  # Z; the trap: between the walls
    "s_maze": dict(WALLS=[(-7, -6, -13, 13), (45, 46, -13, 13), (-7, 46, -13, -12), (-7, 46, 12, 13),
                          (9, 10, -12, -0.5), (28, 29, 0.5, 12)],
                   GOAL=(38, 0), HOLD=50, LENGTH=6, PLANNED=2),
    "obstacles": dict(WALLS=[(-7, -6, -7, 19), (31, 32, -7, 19), (-7, 32, -7, -6), (-7, 32, 18, 19),
                             (7, 9, 2.5, 4.5), (13, 15, 10, 12), (12, 14, 0, 2), (2, 4, 7, 9)],
                      GOAL=(17, 8), HOLD=50, PLANNED=1, EPISODE=250),
    "open": dict(WALLS=[]),  # for extras/drive.py
}
# App. A.1.4 gives DADS U(-1, 1), as it is trained, and SeCTAR U(-1.5, 1.5); Table 2 swaps the two.
DADS = dict(MODES="printed", POLICY="ant_dads", EPISODE=300, HOLD=20, LENGTH=1, PLANNED=4, Z_RANGE=1)
METHODS = {  # Table 2
    "wedis": {},
    "wedis_s": dict(MODES="printed commands", LENGTH=1, PLANNED=4),  # single steps
    "wedis_nts": dict(MODES="printed commands", HOLD=1, LENGTH=20, PLANNED=4,  # no trajectory scaling
                      SAMPLES=(10, 100, 300, 1000)),  # its sparse plans have 600 transitions: 0.4 s at 10,000
    "dads": DADS,
    "dads_speed": DADS | dict(EPISODE=285, HOLD=19),  # skills as long as WEDIS's transitions, 2.7 m
    "sectar": dict(MODES="printed", POLICY="ant_sectar", POLICY_SEEDS=(0,), HOLD=1, LENGTH=40, PLANNED=4,
                   SAMPLES=(10, 100, 300, 1000)),
}

# -------- Algorithm 2, Sec. 5; its lines are counted from "for i", each "end" is one
# case: a Configuration (below), the constants of one run in lower case. policy: what 03 has saved as
# case.policy: actor, decoder (DADS: dynamics), names, relation, scale (metres a step per trajectory unit).

def plan_and_execute(case, policy):
    """Algorithm 2 for case.trials robots side by side. Returns their poses (steps + 1, trials, nq), and for
    each i the first skills z_1* of the best plans, (trials, M), and the paths of these plans, (trials,
    horizon * T + 1, 2), metres."""
    robots = common.Robots(maze_spec(case), case.trials, THREADS)
    pool = skill_pool(case, policy)
    for n in range(case.trials):  # trial n of a policy starts alike for all methods, modes and mazes
        robots.reset([n], np.random.default_rng((case.seed, case.policy_seed, n)))
    torch.manual_seed(hash((case.seed, case.policy_seed, 1)))  # plans of its own for each policy
    closed = case.mode == "closed"
    skills = case.episode // (case.hold * case.length)  # H_E / (H_z T)
    poses, plans = [robots.qpos.copy()[None]], []
    for i in range(skills):  # line 1
        horizon = min(case.planned, skills - i)  # a departure: no plan looks beyond the end of the episode
        best_plans = [plan(case, policy, pool, horizon, s0) for s0 in robots.place()]  # lines 2 to 11
        z, paths = map(torch.stack, zip(*best_plans))
        # The policy is given commands, not z_single: the decoder's first displacements for (z_single, 0)
        commands = commands_of(policy, z, case.length)  # lines 12, 17 and 18, for all t: (trials, T, 2)
        # lines 13 to 16, 19; in closed loop with mean actions
        poses.append(execute(policy, robots, commands, case.hold, closed, deterministic=closed))
        plans.append((z, paths))  # line 20: the robots are at s_0 of the next round
    return np.concatenate(poses), plans


def plan(case, policy, pool, horizon, s0):
    """Algorithm 2, lines 2 to 11: the best of N random sequences of `horizon` (H_P) skills from s0 (2,),
    metres. Returns its first skill z_1* (M,) and its path (H_P T + 1, 2), metres."""
    z, delta = pool
    state = s0.expand(case.samples, 1, 2)  # line 2
    picked = torch.randint(len(z), (case.samples, horizon))  # line 3; their distribution: skill_pool
    path = [state]
    for j in range(horizon):  # line 4
        delta_j = delta[picked[:, j]]  # lines 5 and 6: the displacements that skill_pool decoded, (N, T, 2)
        # Trajectory scaling, Fig 3, in metres. The paper prints s_0 where the planned state must stand
        path.append(state + policy.scale * case.hold * delta_j.cumsum(1))  # line 7
        state = path[-1][:, -1:]  # line 8
    path = torch.cat(path, 1)  # (N, H_P T + 1, 2)
    # Without collisions a sparse reward is w_r or 0, so plans tie: argmax takes the first, a random one
    best = planning_reward(path, case).argmax()  # lines 10 and 11
    return z[picked[best, 0]], path[best].clone()  # a copy: a view would keep all N paths in memory


def skill_pool(case, policy):
    """The skills that plans draw from: z (POOL, M), and the displacements (POOL, T, 2) that the planner
    predicts for them, trajectory units; the decoder's mean, without sampling (App. A.1.4)."""
    torch.manual_seed(hash((case.seed, case.policy_seed, 0)))
    high = torch.full([len(policy.decoder.axes)], case.z_range)
    low = -high
    if "speed" in policy.names:  # the paper: U(-1.5, 0), for its axis points the other way
        low[policy.names.index("speed")] = 0
    z = low + (high - low) * torch.rand(case.pool, len(low))  # line 3
    if case.mode == "printed":
        return z, policy.decoder(z, case.length)[0]  # one run of T transitions with all of z
    return z, commands_of(policy, z, case.length)  # first steps, chained by the f^m


def planning_reward(path, case):
    """r_d or r_s, Sec. 6.2, of paths (N, H_P T + 1, 2), metres -> (N,): the task reward of the last state
    (the paper does not say which states count) less w_p for each transition (theirs: state) that collides."""
    distance = (path[:, -1] - torch.tensor(case.goal)).norm(dim=1)  # -r(s)
    penalty = case.penalty * collides(path, case.walls, case.radius).sum(1)
    if case.reward == "sparse":
        return case.reward_weight * (distance < case.epsilon) - penalty  # r_s
    return -distance - penalty  # r_d


def main():
    runs = check(*common.parse_flags(globals()))
    torch.set_num_threads(1)  # tensors are small here; THREADS are for the physics
    table, start = Path(OUT) / "results" / f"{EXPERIMENT}.csv", time.time()
    rows, old, examples = [], [], {}
    if table.exists() and set(DRAW.split()) <= {"fig06", "fig07", "fig14"}:  # others need the paths
        old = common.read_csv(table)
    for case, policy, settings in runs:
        own = [row for row in old if row.get("settings") == settings]
        kept = len(own) == case.trials
        if not kept:
            poses, plans = plan_and_execute(case, policy)
            if not examples:
                follow_one_skill(case, policy, poses, *plans[0])
            distances = np.linalg.norm(poses[-1, :, :2] - case.goal, axis=1).tolist()
            median = np.argsort(distances)[case.trials // 2]  # the trial that is drawn
            example = case, poses[:, median], [paths[median].numpy() for _, paths in plans]
            examples.setdefault((case.maze, case.method, case.mode, case.reward), example)
            same = dict(maze=case.maze, reward=case.reward, method=case.method, mode=case.mode,
                        look_ahead=case.planned * case.hold * case.length, samples=case.samples,
                        seed=case.seed, policy_seed=case.policy_seed, policy=policy.sha256[:8],
                        settings=settings)
            own = [same | dict(trial=n, final_distance=distance, success=int(distance < case.epsilon))
                   for n, distance in enumerate(distances)]
            own = common.update_csv(table, own, ("settings", "trial"))
        rows += own
        ends = np.array([float(row["final_distance"]) for row in own])
        print(f"{time.time() - start:4.0f} s  {case.title}: {ends.mean():.1f} m from the goal, "
              f"{100 * np.mean(ends < case.epsilon):.0f} % within {case.epsilon:g} m" + " (known)" * kept,
              flush=True)
    print(f"wrote {table}")
    for name in DRAW.split():
        DRAWINGS[name](rows, [case for case, _, _ in runs], examples)


# ======== not needed to understand the method

@dataclass(frozen=True)
class Configuration:
    """One run of plan_and_execute: one value of each constant, and the walls of its maze, metres."""
    method: str
    mode: str
    maze: str
    walls: tuple
    reward: str
    samples: int
    planned: int  # skills that its plans look ahead, by its reward
    policy: str
    policy_seed: int
    trials: int
    seed: int
    episode: int
    hold: int
    length: int
    z_range: float
    pool: int
    penalty: float
    reward_weight: float
    epsilon: float
    radius: float
    goal: tuple

    @property
    def title(self):
        return (f"{self.method} {self.mode}, {self.maze} {self.reward}, N = {self.samples}, {self.policy} "
                f"seed {self.policy_seed}")


def configurations_of(method, maze, v):
    """The configurations of a method in a maze; v: its constants, and WALLS: {NAME: value}."""
    same = {field.name: v.get(field.name.upper()) for field in fields(Configuration)}  # the others: below
    skills, found = v["EPISODE"] // (v["HOLD"] * v["LENGTH"]), {}  # H_E / (H_z T)
    for mode, reward, seed, samples in product(v["MODES"].split(), v["REWARDS"].split(), v["POLICY_SEEDS"],
                                               v["SAMPLES"]):
        planned = skills if reward == "sparse" else min(v["PLANNED"], skills)  # App. A.1.4
        of_one = dict(method=method, maze=maze, mode=mode, reward=reward, policy_seed=seed, samples=samples)
        found[Configuration(**same | of_one | dict(planned=planned))] = True  # each once, in this order
    return list(found)


def check(config, given):
    """All runs: (configuration, policy, digest of its settings). Exits with 2, in a line that names the mend,
    before any work, if one makes no sense. config: file, EXPERIMENTS, flags; given: the flags alone."""
    def words(text, name, allowed):
        found = [text] if text in allowed else text.split()  # the name of a reader's own row may have blanks
        for word in found or [""]:
            if word not in allowed:
                stop(f"unknown {word!r} in --{name}; allowed: {' '.join(allowed)}")
        return list(dict.fromkeys(found))

    words(DRAW or "fig06", "draw", DRAWINGS)  # "" draws nothing
    of_a_run = "EXPERIMENT OUT THREADS DRAW METHOD MAZES".split()  # not for rows of MAZE and METHODS
    kinds, policies, runs = common.types_of(globals()), {}, []
    physics = {name: common.made_by({})[name] for name in ("FRAME_SKIP", "ant.xml")}  # as it was trained with
    for method, maze in product(words(METHOD, "method", METHODS), words(MAZES, "mazes", MAZE)):
        of, v = f"{method} in {maze}", config.copy()
        for name, value in (MAZE[maze] | METHODS[method]).items():
            if name not in [*kinds, "WALLS"] or name in of_a_run:
                stop(f"{of}: {name} is no constant that a row may set")
            v[name] = value if name == "WALLS" else convert(value, kinds[name], f"{of}: {name}")
        v |= given  # the last of the sources
        walls = v.get("WALLS", ())
        words(v["MODES"], "modes", ["printed", "commands", "closed"])
        words(v["REWARDS"], "rewards", ["dense", "sparse"])
        if not isinstance(walls, (list, tuple)):
            stop(f"{of}: WALLS is {walls!r}, but must be a list of (x0, x1, y0, y1)")
        v["WALLS"] = tuple(convert(wall, tuple[(Signed,) * 4], f"{of}: a wall") for wall in walls)
        for x0, x1, y0, y1 in v["WALLS"]:
            if x0 >= x1 or y0 >= y1:
                stop(f"{of}: a wall is {(x0, x1, y0, y1)}, but must be (x0, x1, y0, y1), x0 < x1, y0 < y1")
            for what, (x, y) in (("start", (0, 0)), ("goal", v["GOAL"])):
                if x0 - 0.25 < x < x1 + 0.25 and y0 - 0.25 < y < y1 + 0.25:  # metres, the torso
                    stop(f"{of}: the wall {(x0, x1, y0, y1)} stands on the {what}: move one of them")
        skill_steps = v["HOLD"] * v["LENGTH"]
        whole = v["EPISODE"] // skill_steps * skill_steps
        if not whole:
            stop(f"{of}: an episode of {v['EPISODE']} steps is shorter than a skill: --episode {skill_steps}")
        if whole < v["EPISODE"]:
            print(f"{of}: a skill takes {skill_steps} steps, so an episode of {v['EPISODE']} ends at {whole}")
        for case in configurations_of(method, maze, v):
            key = case.policy, case.policy_seed
            if key not in policies:
                policies[key] = SimpleNamespace(**common.load(OUT, "policy", *key, **physics))
            policy = policies[key]
            if policy.robot != "ant":
                stop(f"{case.title}: mazes are for the ant: choose another --policy")
            if policy.method != "wedis" and case.mode != "printed":
                stop(f"{case.title}: this mode is for policies of WEDIS: --modes printed")
            if policy.method == "dads" and case.length > 1:
                stop(f"{case.title}: DADS predicts one step: --length 1")
            size = 40 * case.samples * (case.planned * case.length + 1) + 4000 * case.pool * case.length
            size += case.trials * (120 * case.episode + 1e6)
            common.need_memory(size, "--samples, --pool or --trials")
            settings = common.digest(common.made_by(asdict(case)) | dict(sha256=policy.sha256))
            runs.append((case, policy, settings))
    return runs


def maze_spec(case):
    """The Ant between real walls 1 m high, and the goal as a red disc."""
    spec = common.robot_spec("ant")
    maze = spec.worldbody.add_body(name="maze")
    for x0, x1, y0, y1 in case.walls:
        maze.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=[(x0 + x1) / 2, (y0 + y1) / 2, 0.5], conaffinity=1,
                      size=[(x1 - x0) / 2, (y1 - y0) / 2, 0.5], rgba=[0.45, 0.5, 0.6, 1])
    spec.worldbody.add_site(pos=[*case.goal, 0.1], type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.8, 0.1, 0],
                            rgba=[0.85, 0.2, 0.1, 1])
    return spec


def collides(path, walls, radius):
    """Which transitions of paths (N, K + 1, 2) touch a wall grown by radius, metres: (N, K) bool. Exact, by
    separating axes: segment and rectangle meet if they do along x, along y, and across the segment."""
    parts = path.split(max(1, 50_000 // path.shape[1]))  # in the cache: 5 times faster for 600 transitions
    if len(parts) > 1:
        return torch.cat([collides(part, walls, radius) for part in parts])
    x0, x1, y0, y1 = torch.tensor(walls, dtype=torch.float32).view(-1, 4).T[..., None, None]  # (walls, 1, 1)
    half_x, half_y = (x1 - x0) / 2 + radius, (y1 - y0) / 2 + radius
    dx, dy = path.diff(dim=1).permute(2, 0, 1).contiguous() / 2  # half of each transition, (N, K)
    x, y = (path[:, :-1] + path[:, 1:]).permute(2, 0, 1).contiguous() / 2  # its middle
    x, y = x - (x0 + x1) / 2, y - (y0 + y1) / 2  # less that of each wall, (walls, N, K)
    meet_x, meet_y = x.abs() <= dx.abs() + half_x, y.abs() <= dy.abs() + half_y
    meet_across = (dx * y - dy * x).abs() <= dx.abs() * half_y + dy.abs() * half_x
    return (meet_x & meet_y & meet_across).any(0)


def follow_one_skill(case, policy, poses, z, paths):
    """Print the first plan's skill of trial 0, its predicted and its executed end."""
    ends = *paths[0, case.length], *poses[case.hold * case.length, 0, :2]
    print(f"the first skill of trial 0, {case.title}:")
    print("  z:", *(f"{value:.2f}" for value in z[0]), "", *policy.names)  # names: of WEDIS alone
    print("  predicted end ({:.2f}, {:.2f}) m, executed ({:.2f}, {:.2f}) m".format(*ends))


def values_of(rows, column, **where):
    """A column of the rows that agree with where: (policies, trials), in the order of the seeds as text."""
    found = {}
    for row in rows:
        if all(row[name] == str(value) for name, value in where.items()):
            found.setdefault(row["policy_seed"], []).append(float(row[column]))
    return np.array([found[seed] for seed in sorted(found)])


def interval(values):
    """95 % interval of the mean of values (policies, trials): Student's t over the means of the policies; if
    there is one policy, over its trials, which says nothing about the next policy."""
    means = values.mean(1) if len(values) > 1 else values[0]
    df = max(len(means) - 1, 1)
    t = {1: 12.71, 2: 4.30, 3: 3.18, 4: 2.78, 5: 2.57, 6: 2.45, 7: 2.36, 8: 2.31}.get(df, 1.96 + 2.5 / df)
    return means.mean() + np.array([-1, 1]) * t * means.std() / df ** 0.5


# -------- drawing; examples: {(maze, method, mode, reward): (configuration, poses, paths of the plans)}

def draw_maze(ax, case, text, marker):
    for x0, x1, y0, y1 in case.walls:
        ax.add_patch(plt.Rectangle((x0, y0), x1 - x0, y1 - y0, color="#7a869a", lw=0))
    ax.plot(0, 0, "o", ms=5, color="black")
    ax.plot(*case.goal, marker, ms=9, color=RED)
    ax.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=text)


def draw_fig03(rows, configurations, examples):
    """Fig 3: trajectory scaling, on the first plan: the same shape, H_z times as large, and executed."""
    case, poses, paths = next(iter(examples.values()))
    path = paths[0] - paths[0][0]
    figure, axes = plt.subplots(1, 2, figsize=(8, 3.2))
    for ax, scale, text in zip(axes, (1 / case.hold, 1), ("predicted", f"scaled by $H_z$ = {case.hold}")):
        for first in range(0, len(path) - 1, case.length):
            ax.plot(*(path[first:first + case.length + 1] * scale).T, ".-")
        ax.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"{case.mode}: {text}")
    axes[1].plot(*(poses[:case.hold * case.length + 1, :2] - poses[0, :2]).T, "k", lw=1, label="executed")
    axes[1].legend()
    common.save_figure(figure, OUT, "fig03_trajectory_scaling")


def draw_fig06(rows, configurations, examples):
    """Fig 6: the navigation tasks, goals as red circles."""
    mazes = {case.maze: case for case in configurations}
    figure, axes = plt.subplots(1, len(mazes), figsize=(4.5 * len(mazes), 3.3), squeeze=False)
    for ax, (maze, case) in zip(axes[0], mazes.items()):
        draw_maze(ax, case, maze, "o")
    common.save_figure(figure, OUT, "fig06_mazes")


def draw_fig07(rows, configurations, examples):
    """Fig 7: mean final distance against N, with its 95 % interval over policies; dashed: the goal's distance
    from the origin."""
    panels = {(case.maze, case.reward): np.hypot(*case.goal) for case in configurations}
    okabe_ito = cycle([BLUE, RED, "#009E73", "#E69F00", "#CC79A7", "#56B4E9"])
    colours = dict(zip(dict.fromkeys(case.method for case in configurations), okabe_ito))
    marks = dict(printed="o-", commands="s--", closed="^:")
    figure, axes = plt.subplots(1, len(panels), figsize=(3.6 * len(panels), 4), sharey=True, squeeze=False)
    for ax, ((maze, reward), distance) in zip(axes[0], panels.items()):
        ax.axhline(distance, ls="--", color=GREY)
        for method, mode in dict.fromkeys((case.method, case.mode) for case in configurations):
            found, where = [], dict(maze=maze, reward=reward, method=method, mode=mode)
            for samples in sorted({case.samples for case in configurations}):
                values = values_of(rows, "final_distance", samples=samples, **where)
                if values.size:
                    found.append([samples, values.mean(), *interval(values)])
            samples, mean, low, high = np.array(found).reshape(-1, 4).T
            ax.fill_between(samples, low, high, color=colours[method], alpha=0.12)
            ax.plot(samples, mean, marks[mode], color=colours[method], ms=4, label=f"{method}, {mode}")
        ax.set(xscale="log", xlabel="N, samples per plan", title=f"{maze}, {reward} reward")
    axes[0, 0].set(ylim=(0, None), ylabel="final distance (m)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    common.save_figure(figure, OUT, "fig07_planning")


def draw_examples(name, reward, rows, configurations, examples):
    """Fig 8, 17, 18: what median trials plan and do; a row per method and maze, a column per mode."""
    shown = {key[:3]: example for key, example in examples.items() if key[3] == reward}
    if not shown:
        return print(f"no {name}: no trial has the {reward} reward")
    lines, modes = dict.fromkeys(key[:2] for key in shown), dict.fromkeys(key[2] for key in shown)
    figure, axes = plt.subplots(len(lines), len(modes), squeeze=False,
                                figsize=(3.6 * len(modes), 3 * len(lines)))
    for ax, (line, mode) in zip(axes.flat, product(lines, modes)):
        if (*line, mode) not in shown:
            ax.axis("off")
            continue
        case, poses, paths = shown[*line, mode]
        draw_maze(ax, case, f"{case.method} {mode}, {case.maze}", "x")
        for path, end in zip(paths, poses[case.hold * case.length::case.hold * case.length, :2]):
            ax.plot(*np.stack([path[case.length], end]).T, "--", color=GREY, lw=1.2)
            ax.plot(*path[:case.length + 1].T, ".-", color=BLUE, ms=4)
        ax.plot(*poses[:, :2].T, color=RED, lw=1.2)
    figure.supxlabel("blue: predicted, orange: executed, dashed: error of the end", fontsize=9)
    common.save_figure(figure, OUT, name)


DRAWINGS = dict(fig03=draw_fig03, fig06=draw_fig06, fig07=draw_fig07, fig14=lambda *_: render.fig14(OUT),
                gif=lambda _, __, examples: render.gif(maze_spec, examples, OUT),
                fig08=partial(draw_examples, "fig08_mpc_examples", "sparse"),
                fig17=partial(draw_examples, "fig17_more_examples", "dense"),
                fig18=partial(draw_examples, "fig18_s_maze_obstacles", "dense"))

if __name__ == "__main__":
    main()
