"""Stage 4: decoder + policy -> mazes solved zero-shot, by MPC with trajectory scaling (Sec. 5, Algorithm 2, Table 2).

Reads runs/policy_*.pt (or those in pretrained/). Plans over skills, executes on the MuJoCo Ant between walls of real geoms.
  main      the table of WEDIS, Fig 3, 6, 8, 17 and a GIF per maze, results/mazes.csv: 2 minutes on two cores (AMD EPYC 7003)
  figure7   all methods and sample sizes, Fig 7, Table 2, the paper's claims tested, results/figure7.csv: 24 minutes on two cores, resumes
  matched   every method looks equally far ahead          fig18     S-maze and obstacles, Fig 18
  best      the best of the options below                 each writes results/<experiment>.csv
"""
import math
import time
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import common  # before mujoco: it chooses how mujoco renders
from common import (HERE, STEP_SCALE, Robots, ant_spec, artifact_name, bootstrap_interval, load, load_actor, load_decoder, next_skill,
                    parse_flags, plt, predict, read_csv, save_figure, stop, update_csv, write_whole)
import mujoco
import numpy as np
import torch
from PIL import Image  # comes with matplotlib

EXPERIMENT = "main"        # row of EXPERIMENTS below
SEED = 0                   # random seed of the trials
OUT = "."                  # folder for runs/, figures/ and results/
THREADS = 2                # CPU threads
POLICY = "ant_semi"        # experiment of 03
POLICY_SEED = 0            # and its seed
METHOD = "wedis"           # rows of METHODS below
MAZES = "maze1 maze2"      # rows of the table MAZE below
REWARDS = "dense sparse"   # Sec. 6.2
PREDICTIONS = "relation decoder"  # what the planner believes: the relation function's path, or the decoder's T free steps (the paper)
OBJECTIVES = "final"       # reward of the last planned state, or "sum" over all of them (the paper does not say)
TRIALS = 50                # per configuration; all step together
MEAN_ACTIONS = True        # of the policy, which falls less often so; false: sampled ones (the paper does not say)
RESUME = True              # figure7 skips what its CSV holds already; false: begins anew
ANIMATE = True             # false: no GIFs

# Table 2, WEDIS; the rows of METHODS name what is different for the other methods
EPISODE = 600              # H_E, environment steps
HOLD = 40                  # H_z, steps for which z_single is held
LENGTH = 5                 # T, transitions per skill
PLANNED_DENSE = 3          # H_P, skills planned ahead, dense reward
PLANNED_SPARSE = 3         # H_P, sparse reward
Z_RANGE = 1.5              # skills ~ U(-Z_RANGE, Z_RANGE)
FAST_ONLY = True           # speed ~ U(0, Z_RANGE): slower is useless here (App. A.1.4); false: the whole range
SAMPLES = 1000             # N, skill sequences per plan
SAMPLE_SIZES = ""          # several N, for figure 7; empty: SAMPLES
PENALTY = 100.0            # w_p, for each colliding transition of a plan
REWARD = 5.0               # w_r, sparse
EPSILON = 5.0              # metres, acceptable error: sparse reward and success
RADIUS = 1.0               # metres the planner grows walls by: the Ant's reach

# Beyond the paper, all off by default
LOOK_AHEADS = ""           # plan so many environment steps ahead, in place of Table 2's H_P; several for "matched"
PLANNER = "shooting"       # or "cem": CEM_ROUNDS rounds of N / CEM_ROUNDS samples, each after the first around the best so far
POOL = 65536               # shooting draws from so many skills, drawn and decoded once
CEM_ROUNDS = 4             # as many model roll-outs as shooting
CEM_ELITES = 0.1           # share of N / CEM_ROUNDS around which the next round is drawn
CEM_SPREAD = 0.5           # times the elites' deviation: how far around
REPLAN = 0                 # transitions executed before the rest of the plan is planned again; 0: all T, the paper
WARM = False               # the rest of the last plan is a candidate of the next
MARGIN = 0.0               # metres: planned transitions nearer than this to a grown wall cost MARGIN_PENALTY
MARGIN_PENALTY = 1.0       # in reward
STOP_AT_GOAL = 0.0         # metres: a trial ends when the Ant is this near and no longer comes nearer, a plan when it gets there; 0: off
TIE_BREAK = False          # sparse: of plans that reach the goal take the one that ends nearest (the paper's reward is flat within EPSILON)
SLOW_NEAR = 0.0            # metres from the goal within which FAST_ONLY is lifted

ALL = "wedis wedis_s wedis_nts dads sectar"
EXPERIMENTS = {  # a row names the constants in which an experiment differs from the ones above
    "main": {},
    "figure7": dict(METHOD=ALL, SAMPLE_SIZES="10 30 100 300 1000 3000", TRIALS=40),
    "matched": dict(METHOD=ALL, LOOK_AHEADS="200 600", PREDICTIONS="relation"),
    "fig18": dict(MAZES="s_maze obstacles", REWARDS="dense", PREDICTIONS="relation"),
    "best": dict(PREDICTIONS="relation", SAMPLE_SIZES="100 1000", PLANNER="cem", REPLAN=1, WARM=True, MARGIN=0.5, STOP_AT_GOAL=1.0,
                 TIE_BREAK=True, SLOW_NEAR=5.0),
}
OPTIONS = ("MEAN_ACTIONS", "PLANNER", "REPLAN", "WARM", "MARGIN", "STOP_AT_GOAL", "TIE_BREAK", "SLOW_NEAR")
PAPER = {name: globals()[name] for name in OPTIONS}

METHODS = {  # Table 2: the constants in which a method differs from WEDIS
    "wedis": {},
    "wedis_s": dict(LENGTH=1, PLANNED_DENSE=4, PLANNED_SPARSE=15),             # single steps
    "wedis_nts": dict(HOLD=1, LENGTH=20, PLANNED_DENSE=4, PLANNED_SPARSE=30),  # no trajectory scaling
    "dads": dict(POLICY="ant_dads", EPISODE=300, HOLD=20, LENGTH=1, PLANNED_DENSE=4, PLANNED_SPARSE=15, Z_RANGE=1.0, FAST_ONLY=False),
    "sectar": dict(POLICY="ant_sectar", HOLD=1, LENGTH=40, PLANNED_DENSE=4, PLANNED_SPARSE=15, FAST_ONLY=False),
}

START = (0.0, 0.0)  # metres
GOAL = (24.0, 12.0)  # 26.8 away, 36 along the axes
HULL = [(-7, -6, -7, 19), (31, 32, -7, 19), (-7, 32, -7, -6), (-7, 32, 18, 19)]  # x0, x1, y0, y1
MAZE = {
    "maze1": HULL + [(17, 18, 5, 18), (5, 18, 5, 6)],   # L; the chamber at the top left is the trap
    "maze2": HULL + [(7, 8, 4, 18), (16, 17, -6, 8)],   # Z; the chamber at the bottom right is the trap
    "s_maze": [(-7, -6, -13, 13), (45, 46, -13, 13), (-7, 46, -13, -12), (-7, 46, 12, 13), (9, 10, -12, -0.5), (28, 29, 0.5, 12)],
    "obstacles": HULL + [(7, 9, 2.5, 4.5), (13, 15, 10, 12), (12, 14, 0, 2), (2, 4, 7, 9)],
}
FIG18 = {  # Fig 18: the constants of its caption; each episode is as long as its plan. Over one wall and under the next; around a block
    "s_maze": dict(HOLD=50, LENGTH=6, PLANNED_DENSE=2, PLANNED_SPARSE=2, EPISODE=600, GOAL=(38.0, 0.0)),
    "obstacles": dict(HOLD=50, LENGTH=5, PLANNED_DENSE=1, PLANNED_SPARSE=1, EPISODE=250, GOAL=(17.0, 8.0)),
}


# ---------------------------------------------------------------- the maze

def maze_spec(walls, goal=GOAL):
    """The Ant between real walls 1 m high, a sensor that says whether they touch, and the goal as a picture."""
    spec = ant_spec()
    maze = spec.worldbody.add_body(name="maze")
    for x0, x1, y0, y1 in walls:
        maze.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=[(x0 + x1) / 2, (y0 + y1) / 2, 0.5], conaffinity=1,
                      size=[(x1 - x0) / 2, (y1 - y0) / 2, 0.5], rgba=[0.45, 0.5, 0.6, 1])
    spec.worldbody.add_site(pos=[*goal, 0.1], type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.8, 0.1, 0], rgba=[0.85, 0.2, 0.1, 1])
    spec.add_sensor(name="touch", type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=mujoco.mjtObj.mjOBJ_BODY, objname="maze",
                    reftype=mujoco.mjtObj.mjOBJ_XBODY, refname="torso", intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1])
    return spec


def collides(path, walls, radius, chunk=20):
    """Which transitions of the paths (N, K + 1, 2) cross a wall grown by radius: (N, K) bool. Exact for segments and rectangles, by
    separating axes: they are apart if they are along x, along y or across the segment. Chunks far from a wall are left out first."""
    K = path.shape[1] - 1
    path = torch.cat([path, path[:, -1:].expand(-1, -K % chunk, -1)], 1)
    x, y = (v.unfold(1, chunk + 1, chunk).flatten(0, 1) for v in path.movedim(2, 0).contiguous())  # a row per chunk, ends shared
    low_x, high_x, low_y, high_y = x.amin(1), x.amax(1), y.amin(1), y.amax(1)
    hit = torch.zeros(len(x), chunk, dtype=torch.bool)
    for x0, x1, y0, y1 in walls:
        i = ((low_x <= x1 + radius) & (high_x >= x0 - radius) & (low_y <= y1 + radius) & (high_y >= y0 - radius)).nonzero().squeeze(1)
        reach_x, reach_y, half_x, half_y = x[i].diff() / 2, y[i].diff() / 2, (x1 - x0) / 2 + radius, (y1 - y0) / 2 + radius
        mid_x, mid_y = x[i, :-1] + reach_x - (x0 + x1) / 2, y[i, :-1] + reach_y - (y0 + y1) / 2  # of transitions, from the wall's middle
        far_x, far_y = reach_x.abs(), reach_y.abs()
        hit[i] |= ((mid_x.abs() <= far_x + half_x) & (mid_y.abs() <= far_y + half_y)
                   & ((reach_x * mid_y - reach_y * mid_x).abs() <= far_x * half_y + far_y * half_x))
    return hit.view(len(path), -1)[:, :K]


# ---------------------------------------------------------------- skills

class Skills:
    """A method's settings in a maze, its policy, and what its skills promise."""

    def __init__(self, name, maze):
        names = "EPISODE HOLD LENGTH PLANNED_DENSE PLANNED_SPARSE Z_RANGE FAST_ONLY POLICY GOAL".split()
        settings = {key: globals()[key] for key in names} | METHODS[name] | FIG18.get(maze, {})
        vars(self).update({key.lower(): value for key, value in settings.items()}, name=name, maze=maze, walls=MAZE[maze], pools={}, table=None)

    def load(self):
        content = load(OUT, "policy", self.policy, POLICY_SEED, quiet=True)
        self.actor, self.decoder, self.sha = load_actor(content), load_decoder(content), content["sha256"][:8]
        self.weight = content.get("relation_weight")  # DADS and SeCTAR have none: they hold their z
        self.single = len(self.decoder.axes) - (self.weight is not None)  # entries of z that the policy is told
        self.predictions = PREDICTIONS.split() if self.name == "wedis" else ["decoder"] if self.weight is None else ["relation"]
        self.top = torch.full((len(self.decoder.axes),), float(self.z_range))
        return self

    def bottom(self, slow):
        """The least z that plans are drawn from; slow: slow skills too."""
        bottom = -self.top
        if self.fast_only and not slow:
            bottom[0] = 0  # canonical axes: z_speed is the first, and + is faster
        return bottom

    @torch.no_grad()
    def promise(self, z, prediction):
        """What each method believes: skills z (B, M) -> displacements (B, T, 2) in metres, a transition being H_z steps.

        WEDIS, "decoder": the decoder's T free steps, as in the paper. "relation": the first step of (speed, direction), T times, the
        direction moved by the relation function in between; as that is a function of two numbers, it is decoded once on a grid and
        read off (bilinear). DADS (T = 1) and SeCTAR (H_z = 1): the means of their own predictive models."""
        if prediction == "decoder":
            return STEP_SCALE * self.hold * predict(self.decoder, z, self.length)
        if self.table is None:
            self.reach = self.z_range * (1 + abs(self.weight) * self.length)
            speed, direction = torch.linspace(-self.z_range, self.z_range, 121), torch.linspace(-self.reach, self.reach, 1201)
            grid = torch.stack(torch.meshgrid(direction, speed, indexing="ij"), -1).flip(-1).flatten(0, 1)
            first = predict(self.decoder, torch.nn.functional.pad(grid, (0, 1)), 1, self.weight)
            self.table = first.view(1, 1201, 121, 2).permute(0, 3, 1, 2).contiguous()
        steps = torch.arange(self.length)
        where = torch.stack([(z[:, :1] / self.z_range).expand(-1, self.length), (z[:, 1:2] + self.weight * steps * z[:, 2:3]) / self.reach], -1)
        delta = torch.nn.functional.grid_sample(self.table, where[None], align_corners=True, padding_mode="border")[0]
        return STEP_SCALE * self.hold * delta.permute(1, 2, 0)

    def pool(self, prediction, slow):
        """The skills that random shooting draws from: (z (POOL, M), displacements (POOL, T, 2))."""
        if (prediction, slow) not in self.pools:
            z = torch.rand(POOL, len(self.top), generator=torch.Generator().manual_seed(SEED))
            z = self.bottom(slow) + (self.top - self.bottom(slow)) * z
            self.pools[prediction, slow] = z, torch.cat([self.promise(part, prediction) for part in z.split(2 ** 13)])
        return self.pools[prediction, slow]


# ---------------------------------------------------------------- Algorithm 2

def scaled_path(start, delta):
    """Alg. 2, lines 5-8, with its slips mended: the path of displacements (N, K, 2) from start (2,) goes on from the last planned
    state. Returns (N, K + 1, 2) in metres."""
    return start + torch.nn.functional.pad(delta.cumsum(1), (0, 0, 1, 0))


def score(path, walls, goal, sparse, objective):
    """Planning reward r_d or r_s of paths (N, K + 1, 2), Sec. 6.2: (N,)."""
    goal = torch.tensor(goal)
    distance = (path[:, 1 if objective == "sum" or STOP_AT_GOAL else -1:] - goal).norm(dim=2)  # nobody asks for the others
    cost = PENALTY * collides(path, walls, RADIUS)
    if MARGIN:
        cost = cost + MARGIN_PENALTY * collides(path, walls, RADIUS + MARGIN)
    if STOP_AT_GOAL:  # a plan that passes within it ends there: what comes after does not count
        step = path.diff(dim=1)
        along = (((goal - path[:, :-1]) * step).sum(2) / step.square().sum(2).clamp(min=1e-9)).clamp(0, 1)
        passing = (path[:, :-1] + along[..., None] * step - goal).norm(dim=2)
        nearest, where = passing.min(1, keepdim=True)
        after = (torch.arange(passing.shape[1]) > where) & (nearest < STOP_AT_GOAL)
        cost = cost.masked_fill(after, 0)
        distance = torch.where(after | (torch.arange(passing.shape[1]) == where) & (nearest < STOP_AT_GOAL), nearest, distance)
    r = REWARD * (distance < EPSILON) - TIE_BREAK * distance.clamp(max=EPSILON) / EPSILON if sparse else -distance
    return (r[:, -1] if objective == "final" else r.sum(1)) - cost.sum(1)


def plan(skills, case, start, horizon, first, warm, generator):
    """The best of case.samples sequences of `horizon` skills from start (2,), of the first of which `first` transitions are left.
    warm: a sequence to beat, or None. Returns the sequence (H_P, M) and its path (transitions + 1, 2)."""
    slow = math.dist(start, skills.goal) < SLOW_NEAR
    low, high = skills.bottom(slow), skills.top
    rounds, elite, deviation = CEM_ROUNDS if PLANNER == "cem" else 1, None, None
    tried, paths, scores = torch.empty(0), torch.empty(0), torch.empty(0)
    for i in range(rounds):
        n = case.samples * (i + 1) // rounds - case.samples * i // rounds
        if PLANNER == "shooting":
            z, delta = skills.pool(case.prediction, slow)
            pick = torch.randint(len(z), (n, horizon), generator=generator)
            z, delta = z[pick], delta[pick]
        else:
            z = low + (high - low) * torch.rand(n, horizon, len(low), generator=generator)
            if deviation is not None:  # around elites, not around their mean: the ways to both sides of a wall have it in between
                around = tried[elite][torch.randint(len(elite), (n,), generator=generator)]
                z = (around + CEM_SPREAD * deviation * torch.randn(z.shape, generator=generator)).clamp(low, high)
            delta = skills.promise(z.flatten(0, 1), case.prediction).view(n, horizon, -1, 2)
        if warm is not None and i == 0:
            z[0], delta[0] = warm, skills.promise(warm, case.prediction)
        path = scaled_path(start, torch.cat([delta[:, 0, :first], delta[:, 1:].flatten(1, 2)], 1))
        tried, paths = torch.cat([tried, z]), torch.cat([paths, path])
        scores = torch.cat([scores, score(path, skills.walls, skills.goal, case.reward == "sparse", case.objective)])
        elite = scores.topk(min(len(scores), max(3, int(CEM_ELITES * case.samples / rounds)))).indices
        if scores[elite[0]] > scores[elite[-1]]:  # else all alike, as with a sparse reward: nothing to draw towards
            deviation = tried[elite].std(0) + 0.02
    return tried[elite[0]].clone(), paths[elite[0]].clone()  # the trap: a view would keep all N paths of every decision in memory


def run(skills, cases):
    """TRIALS episodes of MPC for each case, all at once; every case has the same starts. Returns, per case: rows for the CSV and, per
    trial, the poses (steps + 1, 15) and what was predicted at each decision: (its step, the path until the next (transitions + 1, 2))."""
    torch.manual_seed(SEED)
    n = TRIALS * len(cases)
    robots = Robots(maze_spec(skills.walls, skills.goal), n, THREADS)
    for c in range(len(cases)):
        robots.reset(np.arange(c * TRIALS, (c + 1) * TRIALS), np.random.default_rng(SEED))
    touch = robots.batch.bind("sensordata")
    generators = [torch.Generator().manual_seed(1000 * SEED + trial) for _ in cases for trial in range(TRIALS)]
    skills_left = skills.episode // (skills.hold * skills.length)
    ahead = [min(skills_left, case.look_ahead // (skills.hold * skills.length) or
                 (skills.planned_sparse if case.reward == "sparse" else skills.planned_dense)) for case in cases]
    contacts, poses, plans = np.zeros(n, int), [robots.qpos.copy()], [[] for _ in range(n)]
    ended, best, sequence, planning = np.zeros(n, bool), np.full(n, np.inf), [None] * n, np.zeros(n)
    z = torch.zeros(n, len(skills.top))
    for case in cases:  # what is decoded once is, before the clock runs
        skills.pool(case.prediction, slow=False)
    for t in range(skills_left * skills.length):
        done = t % skills.length  # transitions of this skill
        if done % (REPLAN or skills.length) == 0:
            for i in np.flatnonzero(~ended):
                clock = time.perf_counter()
                horizon, warm = min(ahead[i // TRIALS], skills_left - t // skills.length), None  # never past the episode's end
                if WARM and sequence[i] is not None:
                    warm = torch.cat([z[i:i + 1], sequence[i][1:]] if done else [sequence[i][1:], sequence[i][-1:]])[:horizon]
                position = torch.from_numpy(robots.qpos[i, :2].astype(np.float32))
                sequence[i], path = plan(skills, cases[i // TRIALS], position, horizon, skills.length - done, warm, generators[i])
                z[i] = sequence[i][0]
                planning[i] += time.perf_counter() - clock
                plans[i].append((t * skills.hold, path[:1 + min(REPLAN or skills.length, skills.length - done)].numpy()))
        for _ in range(skills.hold):
            at = done if skills.weight is None else 0  # SeCTAR's policy walks its steps one by one
            _, unstable = robots.step(skills.actor.act(robots.observe(), z[:, :skills.single], MEAN_ACTIONS, at).numpy())
            if (unstable & ~ended).any():
                stop(f"MuJoCo found trial {(unstable & ~ended).argmax() % TRIALS} of {skills.maze} unstable; "
                     "choose another --seed or train the policy longer", code=1)
            pose = np.where(ended[:, None], poses[-1], robots.qpos)  # a trial that has ended stands still
            contacts += (touch[:, 0] > 0) & ~ended
            poses.append(pose)
            distance = np.hypot(*(pose[:, :2] - skills.goal).T)
            best = np.minimum(best, distance)
            ended |= (best < STOP_AT_GOAL) & (distance > best + 0.05)
        if skills.weight is not None:
            z = next_skill(z, skills.weight)
    poses = np.stack(poses, 1)
    distance = np.linalg.norm(poses[..., :2] - skills.goal, axis=2)
    length = np.linalg.norm(np.diff(poses[..., :2], axis=1), axis=2).sum(1)
    for c, case in enumerate(cases):
        mine = slice(c * TRIALS, (c + 1) * TRIALS)
        rows = [dict(maze=skills.maze, reward=case.reward, method=skills.name, prediction=case.prediction, objective=case.objective,
                     look_ahead=ahead[c] * skills.hold * skills.length, samples=case.samples, trial=i - c * TRIALS, seed=SEED,
                     final_distance=distance[i, -1], min_distance=distance[i].min(), success=int(distance[i, -1] < EPSILON),
                     contacts=contacts[i], path_length=length[i], planning_ms=1e3 * planning[mine].sum() / sum(map(len, plans[mine])),
                     options=case.options, policy_seed=POLICY_SEED, policy=skills.sha) for i in range(n)[mine]]
        yield case, rows, poses[mine], plans[mine]


# ---------------------------------------------------------------- tables

KEY = ("maze", "reward", "method", "prediction", "objective", "look_ahead", "samples", "options", "policy_seed", "seed", "trial")
HEADER = ("| maze | reward | prediction | objective | mean final distance (m) | 95 % interval | median | success (< 5 m) | wall steps | trials |\n"
          "|---|---|---|---|---|---|---|---|---|---|")


def distances(rows):
    return np.array([float(row["final_distance"]) for row in rows])


def markdown(rows):
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in [rows[0], ["---"] * len(rows[0]), *(row.values() for row in rows)])


def summary(rows):
    """One line of the table, from CSV rows of one configuration: mean final distance with its 95 % bootstrap interval."""
    d = distances(rows)
    low, high = bootstrap_interval(d)
    success = 100 * np.mean([int(row["success"]) for row in rows])
    contacts = np.mean([int(row["contacts"]) for row in rows])
    first = rows[0]
    return (f"| {first['maze']} | {first['reward']} | {first['prediction']} | {first['objective']} | {d.mean():.2f} | {low:.2f} .. {high:.2f} "
            f"| {np.median(d):.2f} | {success:.0f} % | {contacts:.0f} | {len(d)} |")


def table2():
    """Table 2 from the settings that the planner uses, as rows."""
    every = [Skills(name, "maze1") for name in METHODS]
    return [dict(method=s.name, episode_steps=s.episode, hold=s.hold, length=s.length, steps_per_skill=s.hold * s.length,
                 skills_dense=s.planned_dense, skills_sparse=s.planned_sparse, z_range=s.z_range, slowest_speed=0 if s.fast_only else -s.z_range)
            for s in every]


OTHERS = [name for name in METHODS if name != "wedis"]
CLAIMS = {  # Sec. 6.2.1: words -> pairs of (method, samples) that should end nearer and (method, samples) that should not
    "WEDIS shows the outstanding results for all the cases": [(("wedis", 1000), (m, 1000)) for m in OTHERS],
    "... even with less planning samples": [(("wedis", 100), (m, 1000)) for m in OTHERS],
    "WEDIS-S and DADS are superior than WEDIS-NTS": [((m, 1000), ("wedis_nts", 1000)) for m in ("wedis_s", "dads")],
    "WEDIS-S outperforms DADS": [(("wedis_s", 1000), ("dads", 1000))],
    "SeCTAR has poor performance": [((m, 1000), ("sectar", 1000)) for m in METHODS if m != "sectar"],
}


def claims(rows, prediction):
    """Each claim in each panel: how many metres nearer the better one ends, with the 95 % bootstrap interval of the difference of the
    means. It holds if the interval is above 0, does not if below, and is undecided else. prediction: of WEDIS."""
    def of(maze, reward, method, samples):
        return distances([r for r in rows if (r["maze"], r["reward"], r["method"], r["samples"]) == (maze, reward, method, str(samples))
                          and (method != "wedis" or r["prediction"] == prediction)])

    rng, found = np.random.default_rng(0), []
    for words, maze, reward in product(CLAIMS, MAZES.split(), REWARDS.split()):
        for better, worse in CLAIMS[words]:
            a, b = of(maze, reward, *better), of(maze, reward, *worse)
            difference, low, high, verdict = "", "", "", "no data"
            if len(a) and len(b):
                difference = b.mean() - a.mean()
                low, high = np.quantile(rng.choice(b, (10_000, len(b))).mean(1) - rng.choice(a, (10_000, len(a))).mean(1), [0.025, 0.975])
                verdict = "holds" if low > 0 else "does not hold" if high < 0 else "undecided"
            found.append(dict(claim=words, prediction=prediction, maze=maze, reward=reward, better=better[0], better_samples=better[1],
                              worse=worse[0], worse_samples=worse[1], difference=difference, low=low, high=high, verdict=verdict))
    return found


def verdicts(found):
    """Of how many comparisons each claim holds, as rows."""
    cases = dict.fromkeys((c["claim"], c["prediction"]) for c in found)
    return [{"claim, Sec. 6.2.1": words, "WEDIS predicted by": prediction}
            | {verdict: sum((c["claim"], c["prediction"], c["verdict"]) == (words, prediction, verdict) for c in found)
               for verdict in ("holds", "undecided", "does not hold", "no data")} for words, prediction in cases]


# ---------------------------------------------------------------- pictures

def draw_maze(axes, maze, cross=True):
    for x0, x1, y0, y1 in MAZE[maze]:
        axes.add_patch(plt.Rectangle((x0, y0), x1 - x0, y1 - y0, color="#7a869a", lw=0))
    axes.plot(*START, "o", ms=5, color="black")
    if cross:
        axes.plot(*FIG18.get(maze, {}).get("GOAL", GOAL), "x", color="black", ms=8, mew=2, label="goal")
    x0, x1, y0, y1 = np.transpose(MAZE[maze])
    axes.set(xlim=(x0.min(), x1.max()), ylim=(y0.min(), y1.max()), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.grid(False)


def draw_fig06():
    """Fig 6: the two navigation tasks, goals as red circles."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2))
    for ax, maze in zip(axes, ("maze1", "maze2")):
        draw_maze(ax, maze, cross=False)
        ax.add_patch(plt.Circle(GOAL, 1.0, color=common.RED))
        ax.annotate("start", START, (1, -2.5))
        ax.set_title(f"Maze {maze[-1]}")
    save_figure(figure, OUT, "fig06_mazes")


def draw_fig03(skills):
    """Fig 3: trajectory scaling, on a plan from the start. Left: T single steps per skill as predicted; right: scaled by H_z."""
    case = SimpleNamespace(reward="dense", prediction="relation", objective="final", samples=SAMPLES)
    path = plan(skills, case, torch.tensor(START), skills.planned_dense, skills.length, None, torch.Generator().manual_seed(SEED))[1].numpy()
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), width_ratios=(1, 1.6))
    draw_maze(right, skills.maze)
    right.annotate("the left panel, to scale", (0.3, -0.3), (-1, -4.5), fontsize=8, arrowprops=dict(arrowstyle="-", lw=0.7))
    for ax, points in ((left, path / skills.hold), (right, path / skills.hold), (right, path)):
        for n in range(skills.planned_dense):
            part = points[n * skills.length:(n + 1) * skills.length + 1]
            ax.plot(*part.T, ".-", color=COLOURS[n], lw=1.6, ms=2 if ax is right and points is not path else 6, label=f"skill $z_{n + 1}$")
    left.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"predicted, $T$ = {skills.length} steps a skill")
    right.set_title(f"scaled by $H_z$ = {skills.hold}, dense reward")
    left.margins(0.12)
    left.legend()
    save_figure(figure, OUT, "fig03_trajectory_scaling")


def draw_examples(name, runs, trials):
    """Fig 8, 17, 18: a row per maze. Blue: predicted at each decision, red: executed, cross: goal, dashed grey: the error between
    the last positions of the two at each planning step."""
    trials = [n for n in trials if n < TRIALS]
    if not runs or not trials:
        return
    figure, axes = plt.subplots(len(runs), len(trials), figsize=(3.7 * len(trials), 2.8 * len(runs)), squeeze=False)
    for row, (maze, reward, rows, poses, plans) in zip(axes, runs):
        for n, ax in zip(trials, row):
            draw_maze(ax, maze)
            for i, (_, path) in enumerate(plans[n]):
                end = poses[n, plans[n][i + 1][0] if i + 1 < len(plans[n]) else -1, :2]
                ax.plot(*path.T, ".-", color=common.BLUE, ms=4, lw=1.4, label="predicted" if i == 0 else None)
                ax.plot(*np.stack([path[-1], end]).T, "--", color=common.GREY, lw=1.2, label="error of the end" if i == 0 else None)
            ax.plot(*poses[n, :, :2].T, color=common.RED, lw=1.2, label="executed")
            ax.set_title(f"{maze}, {reward}, trial {n}: ends {float(rows[n]['final_distance']):.1f} m away")
            ax.set_ylabel("y (m)" if ax is row[0] else "")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    save_figure(figure, OUT, name)


COLOURS = (common.BLUE, common.RED, "#009E73", "#E69F00", "#56B4E9", "#CC79A7")  # Okabe-Ito
LOOK = {("wedis", "relation"): "WEDIS, relation", ("wedis", "decoder"): "WEDIS, decoder (paper)", ("wedis_s", "relation"): "WEDIS-S",
        ("wedis_nts", "relation"): "WEDIS-NTS", ("dads", "decoder"): "DADS", ("sectar", "decoder"): "SeCTAR"}


def draw_fig07(rows):
    """Fig 7: mean final distance with its 95 % bootstrap interval against the sample size; dashed: staying at the start."""
    figure, axes = plt.subplots(2, 2, figsize=(8.5, 6), sharex=True, sharey=True)
    for ax, (maze, reward) in zip(axes.flat, product(("maze1", "maze2"), ("dense", "sparse"))):
        for (method, prediction), label, colour, marker in zip(LOOK, LOOK.values(), COLOURS, "osD^vP"):
            mine = [r for r in rows if (r["maze"], r["reward"], r["method"], r["prediction"]) == (maze, reward, method, prediction)]
            sizes = sorted({int(r["samples"]) for r in mine})
            groups = [distances([r for r in mine if int(r["samples"]) == size]) for size in sizes]
            if groups:
                low, high = np.array([bootstrap_interval(d) for d in groups]).T
                mean, beside = np.array([d.mean() for d in groups]), 1.04 ** (len(ax.containers) - 2)  # so that no bar hides another
                ax.errorbar(np.array(sizes) * beside, mean, [mean - low, high - mean], marker=marker, color=colour, label=label,
                            ms=4, lw=1.2, capsize=2)
        ax.axhline(math.dist(GOAL, START), color=common.GREY, ls="--", lw=1)
        ax.set(xscale="log", ylim=(0, 30), title=f"Maze {maze[-1]}, {reward} reward")
    axes[0, 0].annotate("staying at the start", (10, math.dist(GOAL, START)), (0, 2), textcoords="offset points", fontsize=8, color="#555555")
    for ax in axes[1]:
        ax.set_xlabel("samples per plan, N")
    figure.supylabel("mean final distance to the goal (m), 95 % interval", fontsize=9)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    save_figure(figure, OUT, "fig07_planning")


def animate(maze, poses, every=6):
    """GIF of one run from its poses (steps + 1, 15): rendered by mujoco (left the maze, right the Ant), or where there is no GL
    library a top view with the Ant's legs by matplotlib. Says which."""
    model = maze_spec(MAZE[maze]).compile()
    data, frames = mujoco.MjData(model), []
    try:
        renderer, how = mujoco.Renderer(model, 240, 360), "rendered by mujoco"
    except Exception:  # no GL library, no display, no device: the kinds differ by platform
        renderer, how = None, "drawn by matplotlib (for MuJoCo's renderer install an EGL or OSMesa library)"
    for i in range(0, len(poses), every):
        data.qpos[:] = poses[i]
        mujoco.mj_forward(model, data)
        if renderer is None:
            frames.append(top_view(maze, model, data, poses[:i + 1]))
            continue
        views = []
        for lookat, distance, elevation in (((12.5, 5.5, 0), 35, -70), ((*poses[i, :2], 0.5), 5, -35)):
            camera = mujoco.MjvCamera()
            camera.lookat, camera.distance, camera.azimuth, camera.elevation = lookat, distance, 90, elevation
            renderer.update_scene(data, camera)
            for x, y in poses[:i + 1:10, :2]:  # the trail
                mujoco.mjv_initGeom(renderer.scene.geoms[renderer.scene.ngeom], mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, 0.2),
                                    np.array([x, y, 0.15]), np.eye(3).ravel(), np.array([0.84, 0.37, 0, 1], np.float32))
                renderer.scene.ngeom += 1
            views.append(renderer.render().copy())
        frames.append(Image.fromarray(np.concatenate(views, 1)))
    path = Path(OUT) / "figures" / f"{maze}.gif"
    frames = [frame.quantize(64, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE) for frame in frames]
    write_whole(path, lambda file: frames[0].save(file, "GIF", save_all=True, append_images=frames[1:] + [frames[-1]] * 10,
                                                  duration=60, loop=0, optimize=True))
    print(f"wrote figures/{path.name}, {how}")


def top_view(maze, model, data, trail):
    figure, ax = plt.subplots(figsize=(6, 3.6), dpi=80)
    draw_maze(ax, maze)
    ax.plot(*trail[:, :2].T, color=common.RED, lw=1)
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE):
        reach = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
        ax.plot(*np.stack([data.geom_xpos[geom] - reach, data.geom_xpos[geom] + reach])[:, :2].T, color="#6b4a2b", lw=2)
    figure.canvas.draw()
    image = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())
    plt.close(figure)
    return image


if __name__ == "__main__":
    config = parse_flags(globals())
    mazes = [maze for maze in MAZE if (maze in FIG18) == (EXPERIMENT == "fig18")]
    for what, given, allowed in (("maze", MAZES, mazes), ("reward", REWARDS, ("dense", "sparse")),
                                 ("prediction", PREDICTIONS, ("relation", "decoder")), ("objective", OBJECTIVES, ("final", "sum")),
                                 ("method", METHOD, METHODS), ("planner", PLANNER, ("shooting", "cem"))):
        if not given or (wrong := set(given.split()) - set(allowed)):
            stop(f"unknown {what} {' '.join(sorted(wrong)) if given else ''!r}; allowed: {' '.join(allowed)}")
    if min(TRIALS, SAMPLES, HOLD, LENGTH) < 1 or EPISODE < HOLD * LENGTH:
        stop("--trials, --samples, --hold and --length must be at least 1, and --episode at least hold x length")
    if not all(number.isdigit() and int(number) for number in (SAMPLE_SIZES + " " + LOOK_AHEADS).split()):
        stop("--sample_sizes and --look_aheads are whole numbers above 0 with blanks between them")
    torch.set_num_threads(THREADS)
    options = " ".join(f"{name.lower()}={globals()[name]}" for name in OPTIONS if globals()[name] != PAPER[name])
    path = Path(OUT) / "results" / f"{'mazes' if EXPERIMENT == 'main' else EXPERIMENT}.csv"
    start, table, seen = time.time(), [], {}
    for method, maze in product(METHOD.split(), MAZES.split()):
        skills = Skills(method, maze)
        name = artifact_name("policy", skills.policy, POLICY_SEED)
        if skills.policy != POLICY and not any((folder / name).exists() for folder in (Path(OUT) / "runs", HERE / "pretrained")):
            if maze == MAZES.split()[0]:
                print(f"{method} is left out: no {name}; make it with: python 03_train_policy.py --experiment {skills.policy} --seed {POLICY_SEED}")
            continue
        skills.load()
        cases = [SimpleNamespace(objective=objective, look_ahead=int(ahead), reward=reward, prediction=prediction, samples=int(samples),
                                 options=options)
                 for objective, ahead, reward, prediction, samples in product(OBJECTIVES.split(), (LOOK_AHEADS or "0").split(), REWARDS.split(),
                                                                              skills.predictions, (SAMPLE_SIZES or str(SAMPLES)).split())]
        columns = ("maze", "method", "reward", "prediction", "objective", "samples", "options", "seed", "policy", "trial")
        wanted = {(maze, method, c.reward, c.prediction, c.objective, str(c.samples), options, str(SEED), skills.sha, str(trial))
                  for c in cases for trial in range(TRIALS)}
        if EXPERIMENT == "figure7" and RESUME and path.exists() and wanted <= {tuple(row[c] for c in columns) for row in read_csv(path)}:
            print(f"{method} in {maze} is in {path.name} already, with this policy and these settings")
            continue
        for case, rows, poses, plans in run(skills, cases):
            update_csv(path, rows, KEY)
            own = f"| {method} | {case.samples} | {rows[0]['look_ahead']} " * (EXPERIMENT != "main")
            table.append(own + summary(rows))
            ms, real = rows[0]["planning_ms"], 50 * skills.hold * min(REPLAN or skills.length, skills.length)  # ms of the world in between
            print(f"{time.time() - start:4.0f} s  {table[-1]}  {ms:.1f} ms a plan, {100 * ms / real:.2g} % of real time", flush=True)
            if case.prediction == "relation" and case.objective == "final":
                seen[maze, case.reward] = maze, case.reward, rows, poses, plans
    own = ("", "") if EXPERIMENT == "main" else ("| method | samples | steps ahead ", "|---|---|---")
    print("\n" + "\n".join([a + b for a, b in zip(own, HEADER.split("\n"))] + table))
    print(f"staying at the start scores {math.dist(FIG18.get(MAZES.split()[0], {}).get('GOAL', GOAL), START):.1f} m; seed {SEED}, "
          f"{SAMPLE_SIZES or SAMPLES} samples, policy {POLICY} seed {POLICY_SEED}{', ' * bool(options)}{options}")

    dense, sparse = ([seen[maze, reward] for maze in MAZES.split() if (maze, reward) in seen] for reward in ("dense", "sparse"))
    if EXPERIMENT == "main":
        draw_fig06()
        draw_examples("fig08_mpc_examples", sparse, range(3))
        draw_examples("fig17_more_examples", dense, range(3))
        if seen:
            draw_fig03(skills)
        for maze, _, _, poses, _ in (dense or sparse) if ANIMATE else ():
            animate(maze, poses[0])
    elif EXPERIMENT == "fig18":
        draw_examples("fig18_s_maze_obstacles", dense, range(3))
    elif EXPERIMENT == "figure7" and path.exists():
        rows = [r for r in read_csv(path) if (r["options"], r["seed"], r["objective"]) == (options, str(SEED), OBJECTIVES.split()[0])]
        draw_fig07(rows)
        found = [claim for prediction in PREDICTIONS.split() for claim in claims(rows, prediction)]
        update_csv(path.with_name("table2.csv"), table2(), ("method",))
        update_csv(path.with_name("claims.csv"), found, tuple(found[0])[:8])
        print(f"\n{markdown(table2())}\n\n{markdown(verdicts(found))}")
