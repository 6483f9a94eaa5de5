"""What each departure from the paper does: python tests/ablations.py FOLDER writes results/ablations.csv

FOLDER/<name>_s<seed>/policy_ant_semi_seed<seed>.pt: policies of 03 that were trained with one thing set back to the paper's
value (name `shipped`: nothing), by python 03_train_policy.py --updates 50000 --threads 1 --seed <seed> --out
FOLDER/<name>_s<seed> and the flags in SET_BACK below, some with 03 edited as EDITS says. Each is measured as 03 does, and plans in
Maze 1 as 04 does; about a minute each. Rows made with the same policy and constants are kept. tests/report.py makes of them a table,
and the effects in README.md.
python tests/ablations.py closed   what the parts of the closed loop do to the shipped ant_semi policies, without training:
results/closed_loop.csv, 7 minutes.
python tests/ablations.py planner   what the departures of the planner do, with the same policies: results/planner.csv, 4 minutes.
"""
import importlib
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import torch

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
import common  # noqa: E402

torch.set_num_threads(1)  # the tensors are small: threads only wait for one another
NOT_YET = "not measured yet"
MEASURES = {  # column -> in words, format, factor
    "tracking_error": ("tracking error, open loop", ".2f", 1), "tracking_error_closed": ("tracking error, closed loop", ".2f", 1),
    "follow_median_m_open": ("median following error, m, open loop", ".2f", 1),
    "follow_median_m": ("median following error, m, closed loop", ".2f", 1),
    "follow_p90_m_open": ("90 % of following errors, m, open loop", ".2f", 1),
    "follow_p90_m": ("90 % of following errors, m, closed loop", ".2f", 1),
    "fall_rate_open": ("falls, %, open loop", ".1f", 100), "fall_rate": ("falls, %, closed loop", ".1f", 100),
    "slowest_speed": ("slowest skill, executed / predicted", ".2f", 1), "fastest_speed": ("fastest skill, executed / predicted", ".2f", 1),
    "updates_per_second": ("updates a second", ".0f", 1), "maze1_distance_m": ("Maze 1, distance to the goal, m", ".1f", 1),
    "maze1_success": ("Maze 1, success, %", ".0f", 100),
}
IN_EACH_CELL = ("tracking_error", "tracking_error_closed", "fall_rate", "maze1_distance_m")
SET_BACK = {  # name -> flags of 03
    "shipped": "", "base_frame": "--base_frame false", "relabelled": "--relabelled 0", "no_floor": "--floor_start 0 --floor_end 0",
    "schedules": "--averaged 0 --decay_from 1", "reward_scale": "--reward_scale 1 --temperature 0.01", "skill_steps": "--skill_steps 200",
    "actor_every": "--actor_every 1", "rate": "--learning_rate 3e-4 --decay_from 1", "hidden": "--hidden 512", "robots": "--robots 64",
    "floor_end": "--floor_end 0.04",
    "variance": "", "together": "",
    "paper": "--base_frame false --relabelled 0 --floor_start 0 --floor_end 0 --averaged 0 --decay_from 1 --reward_scale 1 "
    "--temperature 0.01 --skill_steps 200 --actor_every 1 --learning_rate 3e-4 --hidden 512 --updates 17500"}  # in the same minutes
VARIANCE = ("variance = STEP_SCALE ** 2 * log_var.exp()", "variance = 0.05 * log_var.exp()")
TOGETHER = ("    robots.time[:] = rng.integers(0, EPISODE, ROBOTS) * robots.step_seconds\n", "")
EDITS = {"variance": [VARIANCE], "together": [TOGETHER], "paper": [VARIANCE, TOGETHER]}  # name -> in 03, (text, what replaces it)
PLANNERS = {  # name -> flags of 04, and in 04, (text, what replaces it)
    "as_shipped": ("", []), "radius": ("--radius 0", []), "horizon": ("", [("min(case.planned, skills - i)", "case.planned")]),
    "pool": ("--pool 500000", []), "noise": ("", [("robots.reset([n], np.random.default_rng((case.seed, case.policy_seed, n)))",
                                                   "robots.reset([n])")])}
LABEL_MODELS = dict(own_axis="warm_up", beta_warm_up="own_axis", own_axis_and_warm_up="plain")  # rows `seeds` of 02


# ---------------------------------------------------------------- measuring

def prepared(stage3, stage4, folder, seed):
    """Set both stages for the policy in a folder: its configuration in Maze 1, the policy, the digest of all that makes a row."""
    common.parse_flags(vars(stage3), ["--out", str(folder), "--seed", str(seed), "--threads", "1"])
    flags = f"--mazes maze1 --rewards dense --modes commands --samples 1000 --trials 20 --threads 1 --draw fig06 --policy_seeds {seed}"
    (run,) = stage4.check(*common.parse_flags(vars(stage4), ["--out", str(folder), *flags.split()]))
    return run


def measured(stage3, stage4, c, policy):
    """All MEASURES of a policy; c: its configuration in Maze 1."""
    row = dict(tracking_error=stage3.tracking(policy, False), tracking_error_closed=stage3.tracking(policy, True))
    for closed, end in ((False, "_open"), (True, "")):
        row |= {name + end: value for name, value in stage3.following(policy, closed).items() if name + end in MEASURES}
    z = stage3.traversal(policy, 0, [-1.5, 1.5])
    executed, predicted = (np.linalg.norm(path[:, -1], axis=1) for path in (
        stage3.roll_out(policy, z, stage3.SINGLE_RUN, False), stage3.predicted_path(policy, z, stage3.SINGLE_RUN)))
    row["slowest_speed"], row["fastest_speed"] = (executed / predicted).tolist()
    row["updates_per_second"] = policy.updates / policy.seconds
    poses, _ = stage4.plan_and_execute(c, policy)
    distances = np.linalg.norm(poses[-1, :, :2] - c.goal, axis=1)
    return row | dict(maze1_distance_m=float(distances.mean()), maze1_success=float((distances < c.epsilon).mean()))


def main(folder):
    stages = importlib.import_module("03_train_policy"), importlib.import_module("04_mpc_maze")
    path, there = ROOT / "results" / "ablations.csv", sorted(path.parent for path in folder.glob("*_s*/policy_ant_semi_seed*.pt"))
    done = {row["settings"] for row in common.read_csv(path)} if path.exists() else set()
    if not there:
        common.stop(f"no policy in {folder}/<name>_s<seed>/")
    for folder in there:
        name, seed = re.fullmatch(r"(\w+)_s(\d+)", folder.name).groups()
        c, policy, settings = prepared(*stages, folder, int(seed))
        if settings in done:
            print(f"{name}, seed {seed}: in {path} already")
            continue
        row = dict(without=name, seed=seed) | measured(*stages, c, policy) | dict(settings=settings)
        common.update_csv(path, [row], ("without", "seed"))
        print(*(f"{key} {value:.3g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()), sep="  ")


# ---------------------------------------------------------------- parts of the closed loop, without training

LOOPS = {  # what differs in common.py
    "as shipped": {}, "no limit": dict(CORRECTION=1e6), "half the limit": dict(CORRECTION=0.1), "half the feedback": dict(FEEDBACK=0.1),
    "no feedback": dict(FEEDBACK=0.0)}


def closed_loops(stage3, folder, seeds):
    """A row for each policy ant_semi in the folder and each law."""
    rows = []
    for seed in seeds:
        common.parse_flags(vars(stage3), ["--out", str(folder), "--seed", str(seed), "--threads", "1"])
        policy = SimpleNamespace(**common.load(stage3.OUT, "policy", "ant_semi", seed))
        ranges = common.load(stage3.OUT, "wetvae", "main", seed)["ranges"]
        for name, changes in LOOPS.items():
            before = {key: getattr(common, key) for key in changes}
            vars(common).update(changes)
            try:
                row = dict(loop=name, seed=seed, tracking_error_closed=stage3.tracking(policy, True)) | stage3.following(policy, True)
                row["purity_speed"] = stage3.executed_cross_talk(policy, ranges, True)[1][0]
            finally:
                vars(common).update(before)
            rows.append(row)
            print(*(f"{key} {value:.3g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()),
                  sep="  ", flush=True)
    common.update_csv(ROOT / "results" / "closed_loop.csv", rows, ("loop", "seed"))


# ---------------------------------------------------------------- departures of the planner

def planners(folder, flags="--policy_seeds 0,1,2 --rewards dense --modes closed --draw fig06 --threads 1"):
    """A row for each policy ant_semi in the folder, each maze and each planner: mean distance to the goal, and success."""
    path, rows = ROOT / "04_mpc_maze.py", []
    for name, (own_flags, edits) in PLANNERS.items():
        source = path.read_text(encoding="utf-8")
        for old, new in edits:
            source = source.replace(old, new)
        stage4 = sys.modules["edited_04"] = ModuleType("edited_04")  # a dataclass looks itself up there
        stage4.__file__ = str(path)
        exec(compile(source, path, "exec"), vars(stage4))
        for c, policy, _ in stage4.check(*common.parse_flags(vars(stage4), ["--out", str(folder), *flags.split(), *own_flags.split()])):
            poses, _ = stage4.plan_and_execute(c, policy)
            distances = np.linalg.norm(poses[-1, :, :2] - c.goal, axis=1)
            rows.append(dict(planner=name, maze=c.maze, policy_seed=c.policy_seed, distance_m=float(distances.mean()),
                             success=float((distances < c.epsilon).mean())))
            print(*rows[-1].values(), flush=True)
    common.update_csv(ROOT / "results" / "planner.csv", rows, ("planner", "maze", "policy_seed"))


def planner_effect(name, rows):
    """Mean distance to the goal in Maze 1 and 2, over policies, with one departure of the planner set back."""
    found = [[float(row["distance_m"]) for row in rows if (row["planner"], row["maze"]) == (name, maze)] for maze in ("maze1", "maze2")]
    return "{:.1f} and {:.1f} m".format(*map(np.mean, found)) if all(found) else NOT_YET


def planner_table(rows):
    """Lines of markdown: a row for each planner, a cell for each policy."""
    lines = []
    for name in dict.fromkeys(row["planner"] for row in rows):
        flags, edits = PLANNERS[name]
        words = "; ".join([f"`{flags}`"] * bool(flags) + [f"`{old}` -> `{new}`" for old, new in edits]) or "-"
        cells = [", ".join(f"{float(row['distance_m']):.1f} m {100 * float(row['success']):.0f} %" for row in rows
                           if (row["planner"], row["maze"]) == (name, maze)) for maze in ("maze1", "maze2")]
        lines.append(f"| {name} | {words} | {' | '.join(cells)} |")
    return ["| planner | flags of 04, edits in it | Maze 1, seeds 0, 1, 2 | Maze 2 |", "|---|---|---|---|", *lines] if rows else []


def closed_table(rows):
    """Lines of markdown: a row for each law, a cell for each seed."""
    head, seeds = ["closed loop"], list(dict.fromkeys(row["seed"] for row in rows))
    shown = {"tracking_error_closed": (".2f", 1), "follow_median_m": (".2f", 1), "follow_p90_m": (".2f", 1), "fall_rate": (".1f", 100),
             "purity_speed": (".2f", 1)}
    lines = []
    for name in dict.fromkeys(row["loop"] for row in rows):
        cells = [" / ".join(f"{factor * float(row[column]):{form}}" for row in rows if row["loop"] == name)
                 for column, (form, factor) in shown.items()]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    head += ["tracking error", "following error, median m", "90 %, m", "falls, %", "purity, speed"]
    head[0] += f" (seeds {', '.join(seeds)})"
    return ["| " + " | ".join(head) + " |", "|---" * len(head) + "|", *lines] if rows else []


# ---------------------------------------------------------------- numbers for both READMEs

def means(rows, name):
    """Means over the seeds of an ablation, and over those seeds of `shipped`, and what all seeds of `shipped` differ by (nan:
    there is one), by measure. None if there are none."""
    own_rows, all_shipped = ([row for row in rows if row["without"] == who] for who in (name, "shipped"))
    seeds = {row["seed"] for row in own_rows}
    same = [row for row in all_shipped if row["seed"] in seeds]
    if not same:
        return None
    found = dict(seeds=len(own_rows))
    for column, (_, _, factor) in MEASURES.items():
        own, shipped, every = ([factor * float(row.get(column) or "nan") for row in some] for some in (own_rows, same, all_shipped))
        found[column] = np.mean(own), np.mean(shipped), np.ptp(every) if len(every) > 1 else np.nan
    return SimpleNamespace(**found)


def table(rows):
    """Lines of markdown: a row for each ablation; [] if there are none."""
    lines = []
    for name in dict.fromkeys(row["without"] for row in sorted(rows, key=lambda row: row["without"] != "shipped")):
        found = means(rows, name)
        edits = [f"`{old.strip()}` -> `{new}`" if new else f"without `{old.strip()}`" for old, new in EDITS.get(name, [])]
        back = "; ".join([SET_BACK.get(name), *edits] if SET_BACK.get(name) else edits)
        cells = [f"`{name}`", back or "-", str(found.seeds) if found else "`shipped` is missing"]
        for column, (_, form, _) in MEASURES.items() if found else ():
            own, shipped, two_seeds = getattr(found, column)
            units = f" ({(own - shipped) / two_seeds:+.1f})" if name != "shipped" and two_seeds > 0 else ""
            cells.append("-" if np.isnan(own) else f"{own:{form}}{units}")
        lines.append("| " + " | ".join(cells + ["-"] * (3 + len(MEASURES) - len(cells))) + " |")
    head = ["without", "flags of 03, edits in it", "seeds", *(words for words, _, _ in MEASURES.values())]
    return ["| " + " | ".join(head) + " |", "|---" * len(head) + "|", *lines] if lines else []


def effect(name, results):
    """What a departure does: tracking error in open / closed loop, falls in closed loop and the distance to the goal in Maze 1
    without it, the mean of its seeds; of `shipped`, or if there is one seed, by seed. results: reads a file of results/."""
    if name in PLANNERS:
        return planner_effect(name, results("planner"))
    if name in LABEL_MODELS:
        return label_effect(LABEL_MODELS[name], results("wetvae"))
    rows, cells = [row for row in results("ablations") if row["without"] == name], []
    for group in [[row] for row in rows] if name == "shipped" or len(rows) == 1 else [rows] * bool(rows):
        error, closed, falls, away = (np.mean([MEASURES[column][2] * float(row[column]) for row in group]) for column in IN_EACH_CELL)
        seed = f"seed {group[0]['seed']}: " if len(group) == 1 else ""
        cells.append(f"{seed}{error:.2f} / {closed:.2f}, {falls:.0f} %, {away:.1f} m")
    return "; ".join(cells) or NOT_YET


def full_effect(name, results):
    """The same without Maze 1, of full trainings: without a departure (its seeds), and of the shipped policies of these seeds."""
    rows = [row for row in results("full_trainings") if (row["without"], row["loop"]) == (name, "as shipped")]
    if name == "base_frame":
        rows = [row for row in results("policies") if row["experiment"] == "ant_world_frame"]
    seeds = {row["seed"] for row in rows}
    shipped = [row for row in results("policies") if row["experiment"] == "ant_semi" and row["seed"] in seeds]
    if not shipped:
        return NOT_YET
    cells = []
    for group in (rows, shipped):
        error, closed, falls = (np.mean([MEASURES[column][2] * float(row[column]) for row in group]) for column in IN_EACH_CELL[:3])
        cells.append(f"{error:.2f} / {closed:.2f}, {falls:.1f} %")
    return " instead of ".join(cells)


def label_effect(labels, rows):
    """The least purity over the seeds of 02, without and with a departure of the WET-VAE."""
    worst = []
    for model in (labels, "seeds"):
        pure = [0.0 if row["purity"] == "nan" else float(row["purity"]) for row in rows
                if (row["experiment"], row["labels"]) == ("seeds", model)]
        worst.append((min(pure, default=None), len({row["seed"] for row in rows if (row["experiment"], row["labels"]) == (
            "seeds", model)})))
    if None in (worst[0][0], worst[1][0]):
        return NOT_YET
    return f"worst purity of {worst[0][1]} seeds: {worst[0][0]:.2f} instead of {worst[1][0]:.2f}"


if __name__ == "__main__":
    if sys.argv[1:] == ["closed"]:
        closed_loops(importlib.import_module("03_train_policy"), ROOT / "pretrained", (0, 1, 2))
    elif sys.argv[1:] == ["planner"]:
        planners(ROOT / "pretrained")
    elif len(sys.argv) == 2 and Path(sys.argv[1]).is_dir():
        main(Path(sys.argv[1]))
    else:
        common.stop("usage: python tests/ablations.py FOLDER, or: closed, or: planner")
