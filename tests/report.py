"""A maintainer's command: ships the results of runs, and makes every table and line number of both READMEs.

python tests/report.py --ship runs_a runs_b   copies policies, decoders, CSV rows and figures of these folders into pretrained/,
    results/ and figures/ (rows replace those with the same KEYS; the later folder wins), makes the learning curves and the
    claims, then does what follows. After more than one folder, Fig 7 of all rows: python 04_mpc_maze.py --experiment figure7 --out .
python tests/report.py   writes results/README.md, and in README.md each part between <!-- table NAME --> and <!-- end -->, and
    each effect of a departure between <!-- without NAME --> (in half a training) or <!-- full NAME --> (in a full one) and
    <!-- / --> (tests/ablations.py has the names)

A table whose rows are not there is one sentence instead. tests/test_readme.py holds text and CSVs together.
"""
import argparse
import importlib
import math
import re
import shutil
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
import common  # noqa: E402
import ablations  # noqa: E402
import claims as judge  # noqa: E402

stage4 = importlib.import_module("04_mpc_maze")
PLANNING = ("mazes", "figure7", "fig18", "matched")
KEYS = {  # of each shipped file: the columns that name a row, or a group of rows that is replaced as a whole
    "wetvae": ("experiment", "seed", "labels", "factor"),
    "policies": ("experiment", "seed"),
    "ablations": ("without", "seed"),
    "bench": ("what", "peer_name"),
} | dict.fromkeys(PLANNING, judge.PLANNED)
DECODERS = ("main", "main_none", "full", "speed_acc")  # that policies and Fig 4 need, of all seeds
CORES = {"1": "one core, another training beside it", "2": "two cores"}
LARGEST = 2_000_000  # bytes of a shipped file
SHORTEST_PATH = 36.4  # metres, in Maze 1 and 2; tests/test_maze.py computes it
NOT_YET = "not measured yet"
PANELS = [(maze, kind) for maze in ("maze1", "maze2") for kind in ("dense", "sparse")]
MODES = ("printed", "commands", "closed")
METHODS = [*(("wedis", mode) for mode in MODES), *((m, mode) for m in judge.ABLATIONS for mode in MODES[:2]),
           *((m, "printed") for m in judge.RIVALS)]
NAMES = dict(wedis="WEDIS", wedis_s="WEDIS-S", wedis_nts="WEDIS-NTS", dads="DADS", dads_speed="DADS, H_z by its speed",
             sectar="SeCTAR", maze1="Maze 1", maze2="Maze 2", s_maze="S-maze", obstacles="obstacles",
             printed="as printed", commands="commands", closed="closed loop")
POLICIES = ["ant_semi", "ant_full", "half_cheetah", "ant_world_frame", "ant_dads", "ant_sectar"]
RIVALS = dict(dads="ant_dads", dads_speed="ant_dads", sectar="ant_sectar")


# ---------------------------------------------------------------- shipping

def ship(*folders):
    """Copy what runs/ folders hold into the shipped folders; never checkpoints, data sets or unmeasured policies."""
    for runs in folders:
        for path in sorted((runs / "results").glob("*.csv")):
            if path.stem in KEYS and (rows := common.read_csv(path)):
                rows = judge.latest(rows, KEYS[path.stem])
                common.update_csv(ROOT / "results" / path.name, rows, KEYS[path.stem])
                print(f"merged {len(rows)} rows of {path} into results/{path.name}")
        for path in sorted((runs / "figures").glob("*.[pg][ni][gf]")):
            if not path.name.startswith("dataset_"):
                copy(path, ROOT / "figures")
        for path in sorted(path for name in DECODERS for path in runs.glob(f"wetvae_{name}_seed*.pt")):
            copy(path, ROOT / "pretrained")
        for path in sorted(runs.glob("policy_*_seed*.pt")):
            experiment, seed = re.fullmatch(r"policy_(\w+)_seed(\d+)", path.stem).groups()
            if select(results("policies"), experiment=experiment, seed=seed):
                copy(path, ROOT / "pretrained")
            else:
                print(f"left out {path.name}: it has no row in policies.csv")
    for path in sorted((ROOT / "pretrained").glob("policy_ant_semi_seed*.pt")):  # a seed is one of the whole chain
        decoder = path.name.replace("policy_ant_semi", "wetvae_main")
        if not (ROOT / "pretrained" / decoder).exists():
            print(f"{path.name} is shipped without {decoder}, the decoder of its seed: --ship the folder that holds it")


def learning_curves():
    """results/learning_curves.csv and figures/learning_curves.png, from what the shipped policies hold."""
    rows = []
    figure, axes = common.plt.subplots(2, 4, figsize=(12, 4.8), sharey=True)
    for row in policy_rows(POLICIES):
        policy = common.load("pretrained", "policy", row["experiment"], int(row["seed"]))
        rows += [dict(experiment=row["experiment"], seed=row["seed"]) | point for point in policy["curve"]]
        ax = axes.flat[POLICIES.index(row["experiment"])]
        for column, colour in (("tracking_error", common.BLUE), ("tracking_error_closed", common.RED)):
            points = [(point["minutes"], point[column]) for point in policy["curve"] if column in point]
            ax.plot(*zip(*points or [(0, math.nan)]), color=colour, lw=1, label=column.replace("_", " "))
        ax.set(title=row["experiment"], xlabel="minutes of training", ylim=(0, 1.1))
    found = dict(zip(*axes[0, 0].get_legend_handles_labels()[::-1]))
    for ax in axes.flat[len(POLICIES):]:
        ax.axis("off")
    axes[-1, -1].legend(found.values(), found)
    common.update_csv(ROOT / "results" / "learning_curves.csv", rows, ())  # no column: all rows are replaced
    common.save_figure(figure, ROOT, "learning_curves")


def copy(path, folder):
    if path.stat().st_size > LARGEST:
        return print(f"left out {path}: more than {LARGEST / 1e6:g} MB")
    folder.mkdir(exist_ok=True)
    shutil.copyfile(path, folder / path.name)
    print(f"copied {path.name} to {folder.name}/")


# ---------------------------------------------------------------- numbers

def results(name):
    path = ROOT / "results" / f"{name}.csv"
    return common.read_csv(path) if path.exists() else []


def select(rows, **where):
    return [row for row in rows if all(row.get(key) == str(value) for key, value in where.items())]


def number(text, form=".2f", scale=1.0):
    """A CSV cell in a table; - if it is empty or not a number."""
    if text in ("", "nan", None):
        return "-"
    return format(scale * float(text), form)


def interval(values):
    """95 % interval of the mean. values: (n,), or (policies, trials)."""
    return stage4.interval(np.atleast_2d(values))


def by_policy(rows, column):
    """A column of planning rows: (policies, trials), as many trials as the policy with the fewest has."""
    found = {}
    for row in rows:
        found.setdefault(row["policy_seed"], []).append(float(row[column]))
    return np.array([values[:min(map(len, found.values()))] for values in found.values()])


def markdown(head, rows, what="", command=""):
    """Lines of a table; one sentence, that `what` is not measured and which command does it, if there are no rows."""
    if not rows:
        return [f"*{what} {NOT_YET}: `{command}`.*"]
    head, *rows = ("| " + " | ".join(row) + " |" for row in [head, *rows])
    return [head, "|---" * (head.count("|") - 1) + "|", *rows]


def picture(name, title):
    return ["", f"![{title}](figures/{name})"] if (ROOT / "figures" / name).exists() else []


# ---------------------------------------------------------------- the tables of README.md

def gifs():
    found = [picture(f"{maze}.gif", f"The Ant crosses {NAMES[maze]}") for maze in ("maze1", "maze2")]
    if not all(found):
        return ["*The GIFs of the Ant in both mazes are not made yet: `python 04_mpc_maze.py`.*"]
    return markdown(["Maze 1", "Maze 2"], [[found[0][1], found[1][1]]])


def planned(name, *columns, **where):
    """Planning rows by the values of columns."""
    found = {}
    for row in select(results(name), **where):
        found.setdefault(tuple(row[column] for column in columns), []).append(row)
    return found


def mazes():
    most = max((int(row["samples"]) for row in results("mazes")), default=0)
    found, rows = planned("mazes", "maze", "reward", "mode", samples=most, method="wedis"), []
    shapes = sorted({by_policy(cell, "success").shape for cell in found.values()})
    for maze, kind in PANELS if found else ():
        rows.append([NAMES[maze], kind])
        for mode in MODES:
            cell = [by_policy(found.get((maze, kind, mode), []), column) for column in ("final_distance", "success")]
            rows[-1].append(f"{cell[0].mean():.1f} m, {100 * cell[1].mean():.0f} %" if cell[0].size else "-")
    trials = " or ".join(f"{n} {'policy' if n == 1 else 'policies'} x {trials} trials" for n, trials in shapes)
    return markdown(["maze", "reward", *(NAMES[mode] for mode in MODES)], rows, "The mazes are", "python 04_mpc_maze.py") + [
        "", f"Mean distance to the goal at the end, and share of trials that end within {stage4.EPSILON:g} m of it, with N = {most:,} "
        f"samples a plan; {trials}. To the sparse reward all places within these {stage4.EPSILON:g} m are equal. "
        f"The start is {math.hypot(*stage4.GOAL):.1f} m from the goal; the shortest path that stays "
        f"1 m from the walls is {SHORTEST_PATH} m long."][:2 * len(rows)]


def scripts():
    vae = select(results("wetvae"), experiment="main", seed=0)
    policy = (select(results("policies"), experiment="ant_semi", seed=0) or [{}])[0]
    seconds = sum(float(row["train_seconds"]) for row in vae if row["factor"] == "speed")
    purity = " / ".join(number(row["purity"]) for row in vae if row["labels"] == "main")
    error, closed, minutes = (number(policy.get(key), form) for key, form in (
        ("tracking_error", ".2f"), ("tracking_error_closed", ".2f"), ("train_minutes", ".0f")))
    # The minutes of default runs on two cores are in the docstrings, by hand
    text = re.search(r"python 04_mpc_maze\.py .*?([\d.]+) (s|minutes?) on two cores", (ROOT / "04_mpc_maze.py").read_text(encoding="utf-8"))
    train = re.search(r"Takes (\d+ to \d+) minutes on two cores", (ROOT / "03_train_policy.py").read_text(encoding="utf-8"))
    ends = [by_policy(rows, "final_distance").mean() for maze in ("maze1", "maze2") if (rows := select(
        results("mazes"), maze=maze, method="wedis", mode="closed", reward="dense", policy_seed=0))]
    return markdown(["command", "minutes", "makes", "expect (seed 0)"], [
        ["`python 01_make_dataset.py`", "0.1", "100,000 trajectories, Table 1, Fig 9", "20 % of them straight, mean speed 0.50"],
        ["`python 02_train_wetvae.py`", f"{seconds / 60:.1f} (one core)" if vae else "-", "WET-VAE and trajectory VAE, Fig 4",
         f"purity {purity}" if vae else NOT_YET],
        ["`python 03_train_policy.py`", f"{train[1]}; the shipped one {minutes} ({CORES[policy['threads']]})" if policy and train else NOT_YET,
         "skill policy of the Ant, Fig 5",
         f"tracking error {error} open loop, {closed} closed loop" if policy else NOT_YET],
        ["`python 04_mpc_maze.py`", f"{float(text[1]) / (60 if text[2] == 's' else 1):.1f}" if text else NOT_YET,
         "mazes, Fig 3, 6, 8, 14, 17, GIFs", "dense, closed loop: {:.1f} and {:.1f} m from the goal".format(*ends) if len(ends) == 2 else NOT_YET]])


CLEAR = 0.8  # purity from which an axis counts as its factor


def purities(experiment, labels):
    """Purity of each axis by seed: (seeds, axes), a dead axis as 0; coverage, which is C[i, i]: the same; the factors."""
    pure, cover = {}, {}
    for row in select(results("wetvae"), experiment=experiment, labels=labels):
        pure.setdefault(row["seed"], {})[row["factor"]] = 0.0 if row["purity"] == "nan" else float(row["purity"])
        cover.setdefault(row["seed"], {})[row["factor"]] = float(re.search(rf"{row['factor']} ([\d.]+)", row["crosstalk"])[1])
    factors = list(next(iter(pure.values()), {}))
    return *(np.array([[seed[name] for name in factors] for seed in found.values()]).reshape(len(found), len(factors))
             for found in (pure, cover)), factors


def fig4():
    """The models of three factors: purity (coverage), mean of the seeds."""
    rows = []
    for experiment, labels, name in (("main", "main", "WET-VAE, the shipped ones"), ("seeds", "seeds", "WET-VAE"),
                                     ("seeds", "own_axis", "... without beta's warm-up"),
                                     ("seeds", "warm_up", "... labels read from all of z"),
                                     ("seeds", "plain", "... with neither own axes nor warm-up: Eq. 4 as printed (24 epochs)"),
                                     ("main", "none", "trajectory VAE, the shipped one"), ("seeds", "none", "trajectory VAE")):
        pure, cover, factors = purities(experiment, labels)
        if len(pure):
            rows.append([name, str(len(pure))] + [f"{p:.2f} ({100 * c:.0f} %)" if p else "-" for p, c in zip(pure.mean(0), cover.mean(0))]
                        + [f"{pure.min():.2f}"])
    return markdown(["purity (coverage)", "seeds", "speed", "direction", "curvature", "least (unused: 0)"], rows, "Fig 4 is",
                    "python 02_train_wetvae.py") + picture("fig04_latent_traversals.png", "Fig 4")


def policy_rows(names):
    rows = [row for row in results("policies") if row["experiment"] in names]
    return sorted(rows, key=lambda row: (names.index(row["experiment"]), int(row["seed"])))


COLUMNS = {  # of policies: title -> format, factor, columns of policies.csv
    "updates": (".0f", 1, "updates"), "environment steps": (".0f", 1, "env_steps"),
    "minutes": (".0f", 1, "train_minutes"), "threads": (".0f", 1, "threads"),
    "tracking error": (".2f", 1, "tracking_error", "tracking_error_closed"),
    "following error, median m": (".2f", 1, "follow_median_m_open", "follow_median_m"),
    "90 %, m": (".2f", 1, "follow_p90_m_open", "follow_p90_m"),
    "from the end of one run of the decoder (as printed), median m": (".2f", 1, "follow_decoder_m_open", "follow_decoder_m"),
    "falls, %": (".1f", 100, "fall_rate_open", "fall_rate"),
    "speed, m a step": (".3f", 1, "speed_m_per_step_open", "speed_m_per_step"),
    **{f"purity, {axis}": (".2f", 1, f"purity_{axis}_open", f"purity_{axis}") for axis in (*common.SINGLE, *common.MULTI)},
}


def policy_table(names, titles, more=None):
    """A row per policy: numbers of open loop / closed loop. more: {title: function of the row}."""
    rows, there = [], {row["experiment"] for row in results("policies")}
    rest = [f"`{name}`" for name in names if name not in there]
    for row in policy_rows(names):
        cells = []
        for form, scale, *keys in map(COLUMNS.get, titles):
            cells.append(" / ".join(number(row.get(key), form, scale) for key in keys if row.get(key)) or "-")
        rows.append([f"`{row['experiment']}`", row["seed"], *cells, *(make(row) for make in (more or {}).values())])
    return markdown(["policy", "seed", *titles, *(more or {})], rows, "The policies are",
                    f"python 03_train_policy.py --experiment {names[0]}") + (
                        ["", f"*{', '.join(rest)}: {NOT_YET}.*"] if rows and rest else [])


def fig5():
    titles = [title for title in COLUMNS if title not in ("updates", "environment steps") and "purity" not in title]
    return policy_table(POLICIES[:4], [*titles, "purity, speed"]) + picture("fig05_skills_wedis.png", "Fig 5")


def why_not(method):
    """Why comparisons with a method do not count; "" if they do. A rival must work, or it is no rival."""
    if method not in RIVALS:
        return ""
    speed, own, falls, error = (  # means over the seeds, nan if a number is not there
        np.mean([float(row.get(column) or "nan") for row in select(results("policies"), experiment=experiment)] or [math.nan])
        for experiment, column in ((RIVALS[method], "speed_m_per_step_open"), ("ant_semi", "speed_m_per_step_open"),
                                   (RIVALS[method], "fall_rate_open"), (RIVALS[method], "tracking_error")))
    if math.isnan(error if method == "sectar" else speed + own + falls):
        return NOT_YET
    if method == "sectar":
        return f"tracking error {error:.2f}, so its skills are not followed" if error >= 0.7 else ""
    if speed <= own:
        return f"no faster than WEDIS: {speed:.3f} m a step, WEDIS {own:.3f}"
    return f"{100 * falls:.0f} % of its robots turn over" if falls >= 0.1 else ""


def baselines():
    def share(row):
        """Minutes of training, as a share of WEDIS's on as many cores."""
        minutes = [float(own["train_minutes"]) for own in select(results("policies"), experiment="ant_semi", threads=row["threads"])]
        return f"{float(row['train_minutes']) / np.mean(minutes):.2f}" if minutes else "-"

    def counts(row):
        """Judged by the mean of all seeds."""
        if row["experiment"] not in RIVALS.values():
            return "-"
        return f"no: {why_not(row['method'])}" if why_not(row["method"]) else "yes"

    titles = ["minutes", "threads", "updates", "tracking error", "speed, m a step", "falls, %"]
    return policy_table(POLICIES[4:], titles, {"minutes / WEDIS's": share, "counts": counts})


def fig7():
    found, rows, rest = planned("figure7", "method", "mode", "maze", "reward", samples=1000), [], []
    for method, mode in METHODS:
        cells = [by_policy(found.get((method, mode, *panel), []), "final_distance") for panel in PANELS]
        name, some = f"{NAMES[method]}, {NAMES[mode]}", [cell for cell in cells if cell.size]
        if not some:
            rest.append(name)
            continue
        name += f" (not counted: {why_not(method)})" if why_not(method) else ""
        rows.append([name] + [f"{cell.mean():.1f} m" if cell.size else "-" for cell in cells]
                    + [f"{len(some[0])} x {some[0].shape[1]}"])
    lines = markdown(["1000 samples", *(f"{NAMES[maze]}, {kind}" for maze, kind in PANELS), "policies x trials"], rows, "Fig 7 is",
                     "python 04_mpc_maze.py --experiment figure7")
    if rows and rest:
        lines += ["", f"*{NOT_YET.capitalize()}: {'; '.join(rest)}.*"]
    return lines + picture("fig07_planning.png", "Fig 7")


def not_counted():
    """One sentence on the rivals whose comparisons do not count."""
    why = {experiment: why_not(method) for method, experiment in RIVALS.items()}
    reasons = [f"`{experiment}` ({reason})" for experiment, reason in why.items() if reason]
    return ["", f"*Not counted: {'; '.join(reasons)}.*"] if reasons else []


def over_seeds(flags, what="seeds"):
    """A verdict on a claim that is tried with at least three seeds: it holds with all, or does not with at least half of them."""
    n, k = len(flags), sum(map(bool, flags))
    word = "holds" if k == n else "does not hold" if 2 * k <= n else "undecided"
    return f"{word if n >= 3 else 'undecided'} ({k} of {n} {what})" if n else NOT_YET


def axes_text(pure):
    """Purities (seeds, axes) in words; a dead axis is -."""
    if len(pure) < 2:
        return " / ".join(f"{value:.2f}" if value else "-" for value in pure.flat) or NOT_YET
    return " / ".join(f"{value:.2f}" for value in pure.mean(0)) + f", worst {pure.min():.2f}"


def skill_claims():
    """Claims of Sec. 6.1 and App. A.3: the paper's words, a verdict, what is measured here."""
    weights = [f"b{beta}_g{gamma}" for beta, gamma in ((9, 0), (9, 1), (1, 10), (3, 10), (9, 10))]
    models = ("seeds", "seeds"), ("seeds", "plain"), ("seeds", "none"), ("speed_acc", "speed_acc"), ("speed_acc", "none"), (
        "four_factors", "four_factors"), ("polar", "polar"), ("polar", "cartesian"), ("polar", "none")
    wet, plain, none, line, line_none, four, polar, cartesian, xy = (purities(*model)[0] for model in models)
    grid = [purities("beta_gamma", labels)[0] for labels in weights]
    best = [seed[-1] > max(seed[:-1]) for seed in zip(*(pure.min(1, initial=1) for pure in grid))]
    circles = [[row for row in in_order(select(results("wetvae"), experiment=name, labels=name)) if row["largest_gap_deg"]]
               for name in ("full", "polar", "four_factors")]
    gaps = [[float(row["largest_gap_deg"]) for row in found] for found in circles]
    drawn = [360 - float(row["range_high"]) + float(row["range_low"]) for found in circles for row in found]
    gap_text = [", ".join(f"{gap:.1f}" for gap in found) or NOT_YET for found in gaps]
    gap_text.append(f"{min(drawn):.0f} to {max(drawn):.0f}" if drawn else NOT_YET)
    semi = policy_rows(["ant_semi"])
    errors = [", ".join(number(row.get(key)) for row in semi) or NOT_YET for key in ("tracking_error", "purity_speed_open")]
    least = min((float(row.get(f"purity_{factor}_open") or "nan") for row in semi for factor in ("direction", "curvature")), default=math.nan)

    def clear(*pures):
        """Of each seed whether all axes of all models are their factors."""
        return [all(pure.min() >= CLEAR for pure in seed) for seed in zip(*pures)]

    return [
        ["the three factors are suitably disentangled (Fig 4)", over_seeds(clear(wet)), axes_text(wet)],
        ["... with Eq. 4 as printed", over_seeds(clear(plain)), axes_text(plain)],
        ["without labels some factors are entangled (Fig 4)", over_seeds([seed.min() < CLEAR for seed in none]), axes_text(none)],
        ["... and one axis is unused", over_seeds([0 in seed for seed in none]), "as above"],
        ["both beta and gamma need proper choices (Fig 10)", over_seeds(best), "least purity: " + ", ".join(
            f"{labels} {pure.min(1).mean():.2f}" for labels, pure in zip(weights, grid)) if best else NOT_YET],
        ["other labels give other axes (Fig 11)", over_seeds(clear(polar, cartesian)),
         f"polar {axes_text(polar)}, Cartesian {axes_text(cartesian)}, none {axes_text(xy)}"],
        ["speed and acceleration in 1D (Fig 12)", over_seeds(clear(line)), axes_text(line)],
        ["... nothing meaningful without labels", over_seeds([seed.max() < CLEAR for seed in line_none]),
         f"{axes_text(line_none)} (our beta: 1)"],
        ["four factors in one model (Fig 13)", over_seeds(clear(four)), axes_text(four)],
        ["empty angles on the full circle (A.3.1)", over_seeds([gap > 5 for found in gaps for gap in found], what="models"),
         "largest gap, degrees (a gap: above 5), for z from -3 to 3: three factors {}; two (Fig 11) {}; four (Fig 13) {}; for z from "
         "-1.5 to 1.5, as drawn, {}".format(*gap_text)],
        ["executed skills are similar to predicted ones (Fig 5)", "no threshold",
         f"open loop: tracking error {errors[0]}; executed purity of speed {errors[1]}; of the others at least {least:.2f}"]]


def planning_claims():
    """Claims of Sec. 6.2.1, apart against rivals and against ablations: a verdict for each mode, over what counts."""
    found, rows = {}, []
    for row in results("claims"):
        found.setdefault((row["claim"], row.get("against", "-")), []).append(row)
    for (words, against), mine in found.items():
        rows.append([words, against])
        for mode in MODES[:2]:
            all_, counting = [], []
            for row in select(mine, mode=mode):
                all_.append(row["verdict"])
                counting += [] if why_not(row["better"]) or why_not(row["worse"]) else [row["verdict"]]
            rows[-1].append(judge.in_words(counting) if counting else f"not counted ({all_.count('holds')} of {len(all_)} hold)"
                            if all_ else "-")
    return rows


def claims():
    rows = planning_claims()
    return markdown(["the paper says", "verdict", "purity of each axis (-: unused), mean of the seeds, or what else is measured"],
                    skill_claims()) + [""] + markdown(
        ["the paper says (Sec. 6.2.1)", "against", *(NAMES[mode] for mode in MODES[:2])], rows,
        "The claims on planning (Sec. 6.2.1) are", "python 04_mpc_maze.py --experiment figure7")


def bench():
    rows = []
    for row in results("bench"):
        form = ".0f" if float(row["ours"]) >= 10 else ".3f"
        rows.append([row["what"], number(row["ours"], form), f"{number(row['peer'], form)}, {row['peer_name']}", number(row["ratio"]), row["unit"]])
    return markdown(["what", "ours", "peer", "ratio", "unit"], rows, "Speed is", "python tests/bench.py")


# ---------------------------------------------------------------- the map from the paper to lines of code

MAP = [  # what, places: script, text that begins a line
    ("Table 1, App. A.1.1", [("01", "SPEED_LOW:"), ("01", "def make_trajectories")]),
    ("weak labels, Fig 9", [("common", "def weak_labels"), ("01", "def draw(")]),
    ("Fig 1, App. A.1.2", [("02", "class Encoder"), ("02", "class LabelDecoders"), ("common", "class Decoder(")]),
    ("Alg. 1, first loop; Eq. 3; Eq. 4", [("02", "def train("), ("02", "def objective"), ("02", "loss = -(log_p_tau")]),
    ("Alg. 1, \"Test: check factors in z\"; Fig 4, 10 to 13", [("02", "def check_factors"), ("02", "def draw_traversals")]),
    ("Alg. 1, \"Test: find relation functions\"; Sec. 4.2.2", [("02", "def find_relation"), ("common", "def next_skill")]),
    ("Alg. 1, second loop; Eq. 5, 6", [("03", "def train_wedis"), ("03", "def reward(")]),
    ("SAC, App. A.1.3", [("03", "class Sac"), ("common", "class Actor")]),
    ("command, base frame (ours)", [("common", "def commands_of"), ("common", "def to_base_frame")]),
    ("Fig 5, 15, 16", [("03", "def draw_skills"), ("03", "def tracking("), ("03", "def following(")]),
    ("DADS, SeCTAR", [("03", "def train_dads"), ("03", "def train_sectar")]),
    ("Alg. 2; its lines 2 to 11; 12, 17, 18; 13 to 16", [
        ("04", "def plan_and_execute"), ("04", "def plan("), ("common", "def commands_of"), ("common", "def execute")]),
    ("trajectory scaling, Fig 3", [("04", "def plan("), ("04", "def draw_fig03")]),
    ("the three modes (two are ours)", [("04", "MODES:"), ("04", "def skill_pool"), ("common", "def closed_loop")]),
    ("r_d, r_s, Sec. 6.2", [("04", "def planning_reward")]),
    ("Table 2, App. A.1.4", [("04", "METHODS = {"), ("04", "EPISODE:")]),
    ("Fig 7, 8", [("04", "def draw_fig07"), ("04", "def draw_examples")]),
]
FILES = {"common": "common.py"} | {name[:2]: name for name in ("01_make_dataset.py", "02_train_wetvae.py", "03_train_policy.py", "04_mpc_maze.py")}


def line_of(file, anchor):
    """Number of the first line that begins with the anchor (behind blanks)."""
    for n, line in enumerate((ROOT / file).read_text(encoding="utf-8").splitlines(), 1):
        if line.strip().startswith(anchor):
            return n
    raise SystemExit(f"report.py: no line of {file} begins with {anchor!r}; mend MAP in tests/report.py")


def paper_map():
    rows = []
    for what, places in MAP:
        links = []
        for script, anchor in places:
            n, name = line_of(FILES[script], anchor), re.sub(r"^(def|class) |\W+$| =.*|.*\(states", "", anchor)
            links.append(f"`{name or 'loss'}` [{script}:{n}]({FILES[script]}#L{n})")
        rows.append([what, ", ".join(links)])
    return markdown(["paper", "here"], rows)


TABLES = dict(gifs=gifs, mazes=mazes, scripts=scripts, map=paper_map, fig4=fig4, fig5=fig5, fig7=fig7, claims=claims,
              baselines=baselines)


# ---------------------------------------------------------------- results/README.md: every table in full

def in_order(rows):
    """Rows of 02, by experiment, then seed; rows of a model stay together."""
    experiments = ["main", "seeds", "beta_gamma", "polar", "speed_acc", "four_factors", "full"]
    place = {name: n for n, name in enumerate(experiments)}
    return sorted(rows, key=lambda row: (place.get(row["experiment"], 99), row["experiment"], int(row["seed"])))


def full_wetvae():
    columns = "experiment labels seed beta gamma factor purity crosstalk abs_corr range_low range_high largest_gap_deg train_seconds".split()
    rows = [[number(row[column]) if column in columns[6:12] and column != "crosstalk" else row[column] for column in columns]
            for row in in_order(results("wetvae"))]
    return markdown([column.replace("_", " ") for column in columns], rows, "WET-VAEs are", "python 02_train_wetvae.py")


def full_seeds():
    rows = []
    for key in dict.fromkeys((row["experiment"], row["labels"]) for row in in_order(results("wetvae"))):
        pure, _, factors = purities(*key)
        if len(pure) > 1:
            rows.append([*key, str(len(pure)), ", ".join("{} {:.3f} ({:.3f} .. {:.3f})".format(name, own.mean(), *interval(own))
                                                         for name, own in zip(factors, pure.T)), f"{pure.min():.3f}"])
    return markdown(["experiment", "labels", "seeds", "mean purity (95 % interval)", "worst"], rows, "Ten seeds of the WET-VAE are",
                    "python 02_train_wetvae.py --experiment seeds --seed N")


def full_policies():
    return policy_table([*POLICIES, *sorted({row["experiment"] for row in results("policies")} - set(POLICIES))], COLUMNS)


def full_planning(name, each=()):
    """A row per configuration of a planning file; each: ("policy_seed",) for a row per policy."""
    rows, columns = [], ("maze", "reward", "method", "mode", "look_ahead", "samples", *each)
    for key, found in planned(name, *columns).items():
        distance, success = by_policy(found, "final_distance"), by_policy(found, "success")
        rows.append([NAMES.get(value, value) for value in key] + [
            f"{distance.mean():.2f}", "{:.2f} .. {:.2f}".format(*interval(distance)), f"{np.median(distance):.2f}",
            f"{100 * success.mean():.0f} %", f"{len(distance)} x {distance.shape[1]}"])
    return markdown([*(column.replace("_", " ") for column in columns), "mean distance, m", "95 % interval", "median", "success",
                     "policies x trials"], rows, f"{name}.csv is", f"python 04_mpc_maze.py --experiment {name}")


def full_claims():
    rows = [[*(NAMES.get(row.get(column), row.get(column)) or "-" for column in ("claim", "against", "mode", "maze", "reward", "look_ahead")),
             f"{NAMES[row['better']]} ({row['better_samples']})", f"{NAMES[row['worse']]} ({row['worse_samples']})",
             f"{number(row['difference'])} ({number(row['low'])} .. {number(row['high'])})", row["verdict"],
             f"{row['better_policies']}, {row['worse_policies']}; {row['trials']}"] for row in results("claims")]
    return markdown(["claim", "against", "mode", "maze", "reward", "look-ahead, if equal", "method (samples)", "than",
                     "ends nearer by, m (95 %)", "verdict", "policies of each; trials"], rows, "The claims of Sec. 6.2.1 are",
                    "python tests/claims.py") + (not_counted() if rows else [])


def full_table2():
    rows = [list(row.values()) for row in results("table2")]
    return markdown([*(results("table2") or [{}])[0]], rows, "Table 2 as rows is", "python tests/claims.py")


def full_ablations():
    return ablations.table(results("ablations")) or markdown([], [], "Ablations are", "python tests/ablations.py FOLDER")


def full_trainings():
    shipped = [row | dict(without={"ant_semi": "shipped", "ant_world_frame": "base_frame"}[row["experiment"]], loop="as shipped")
               for row in policy_rows(["ant_semi", "ant_world_frame"])]
    rows = [[row["without"], row["loop"], row["seed"], *(number(row[column], form, factor) for column, form, factor in (
        ("tracking_error", ".2f", 1), ("tracking_error_closed", ".2f", 1), ("follow_median_m", ".2f", 1), ("follow_p90_m", ".2f", 1),
        ("fall_rate", ".1f", 100), ("purity_speed_open", ".2f", 1)))] for row in shipped + results("full_trainings")]
    return markdown(["without", "loop", "seed", "tracking error, open loop", "closed loop", "median following error, m, closed loop", "90 %, m",
                     "falls, %", "purity of speed, open loop"], rows, "Full trainings are", "python 03_train_policy.py")


def dads_tries():
    rows = [[row["change"], f"{float(row['speed_m_per_step_open']):.3f}", f"{float(row['tracking_error']):.2f}",
             f"{100 * float(row['fall_rate_open']):.1f}", f"{float(row['train_minutes']):.0f}"] for row in results("dads")]
    return markdown(["changed", "speed, m a step", "tracking error", "falls, %", "minutes"], rows, "Variants of DADS are",
                    "python 03_train_policy.py --experiment ant_dads")


def closed_loops():
    return ablations.closed_table(results("closed_loop")) or markdown([], [], "The closed loop's parts are", "python tests/ablations.py closed")


def planners():
    return ablations.planner_table(results("planner")) or markdown([], [], "The planner's departures are", "python tests/ablations.py planner")


def pictures():
    lines = [f"![{path.stem}](../figures/{path.name})" for path in sorted((ROOT / "figures").glob("*.png"))]
    return "\n\n".join(lines).splitlines() or markdown([], [], "Figures are", "python 02_train_wetvae.py")


SECTIONS = [
    ("WET-VAE (02): wetvae.csv", "Purity of axis i: C[i, i] / sum over j of C[i, j], where cross-talk C[i, j] is the range of "
     "factor j while axis i runs over [-1.5, 1.5], over factor j's range in the data. - : an unused axis (its whole row of C is "
     "below 0.1). Abs corr: of latent and factor, over decoded draws of the prior. Range: decoded over z in "
     "[-1.5, 1.5], angles in degrees. Largest gap: empty angle of the directions that z_direction decodes to. "
     "Acceleration is a share of the speed per transition.", full_wetvae),
    ("Over seeds", "An unused axis counts as 0. Intervals: 95 %, Student's t over seeds.", full_seeds),
    ("Policies (03): policies.csv", "Tracking error: RMS(executed end - predicted end) / RMS(predicted end) over a grid of skills, "
     "100 steps from rest (SeCTAR: 25 draws, 50 steps). Following error: |end - sum of its commands| of random skills of 200 steps "
     "(Half-Cheetah: 120) from 400 noisy starts, three in a row. Falls: robots that turn over in that time. Baselines have no "
     "closed loop. Pairs of numbers are open loop / closed loop. Speed: over the prior, WEDIS over the planner's range. Purity: of "
     "executed skills.", full_policies),
    ("Without each departure: ablations.csv",
     "Policies with one thing set back to the paper's value, 50,000 updates: mean of the seeds, and in brackets, if `shipped` has two seeds, "
     "the difference to its same seeds in units of what these two differ by, a rough measure. Slowest, fastest skill: executed / predicted "
     "distance in open loop. Maze 1: dense reward, mode `commands`, N = 1000, 20 trials. An earlier loop had random corrections of commands "
     "and discount 0.98; they went after such runs (without: 0.33 / 0.26 and 0.28 / 0.16 instead of 0.25 / 0.25). rewards.csv: tracking "
     "errors of trainings with other rewards, at equal updates.",
     full_ablations),
    ("Full trainings without a departure: policies.csv, full_trainings.csv", "100,000 updates: what acts late, half a training does not show. "
     "-: not measured.", full_trainings),
    ("DADS, one thing changed at a time: dads.csv", "40,000 updates (the shipped policies have 100,000), seed 0, one core with another "
     "training beside it. As shipped: displacements in units of their running RMS, one Gaussian, 4 model updates a step, half of each "
     "batch relabelled, discount 0.995.", dads_tries),
    ("Parts of the closed loop: closed_loop.csv", "The shipped policies, executed with other laws of the closed loop (common.py, "
     "`closed_loop`), without training anew.", closed_loops),
    ("Departures of the planner: planner.csv", "Mean distance to the goal and success of the shipped policies, dense reward, closed "
     "loop, N = 10,000, 50 trials each, with one departure set back.", planners),
    ("Mazes (04): mazes.csv", "Intervals of all planning tables: 95 %, Student's t over the policies' means; with one "
     "policy over its trials, which says nothing about the next policy.", lambda: full_planning("mazes")),
    ("Mazes, each policy", "", lambda: full_planning("mazes", ("policy_seed",))),
    ("Fig 7: figure7.csv", "", lambda: full_planning("figure7")),
    ("Claims of Sec. 6.2.1: claims.csv", "A comparison holds if the whole interval of the difference is above 0, does not hold if "
     "it is below, else it is undecided. A claim holds if all its comparisons hold, does not hold if one does not.", full_claims),
    ("Equal look-ahead: matched.csv", "", lambda: full_planning("matched")),
    ("Fig 18: fig18.csv", "", lambda: full_planning("fig18")),
    ("Table 2, as planned with: table2.csv", "", full_table2),
    ("Speed: bench.csv", "", bench),
    ("All figures", "", pictures),
]


def results_readme():
    lines = ["# All results", "", "Made by `python tests/report.py` from the CSV files of this folder; do not edit. "
             "The scripts write to `runs/`; what is here is shipped by `python tests/report.py --ship runs`."]
    for title, text, table in SECTIONS:
        lines += ["", f"## {title}", ""] + ([text, ""] if text else []) + table()
    return "\n".join(lines) + "\n"


# ---------------------------------------------------------------- README.md

BLOCK = re.compile(r"(<!-- table (\w+) -->\n)(.*?)(<!-- end -->)", re.S)
WITHOUT = re.compile(r"(<!-- (without|full) (\w+) -->)(.*?)(<!-- / -->)")


def made(text):
    """README.md with each marked part made anew."""
    effect = {"without": ablations.effect, "full": ablations.full_effect}
    text = WITHOUT.sub(lambda found: found[1] + effect[found[2]](found[3], results) + found[5], text)
    return BLOCK.sub(lambda found: found[1] + "\n".join(TABLES[found[2]]()).strip() + "\n" + found[4], text)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ship", metavar="RUNS", type=Path, nargs="+", default=[], help="runs/ folders")
    folders = parser.parse_args().ship
    for runs in folders:
        if not runs.is_dir():
            parser.error(f"{runs} is no folder")
    if folders:
        ship(*folders)
        learning_curves()
        if any(row["method"] != "wedis" for row in results("figure7")):
            judge.main(stage4, ["--out", str(ROOT)])
    readme = ROOT / "README.md"
    readme.write_text(made(readme.read_text(encoding="utf-8")), encoding="utf-8")
    (ROOT / "results" / "README.md").write_text(results_readme(), encoding="utf-8")
    print(f"wrote README.md ({len(words_of(readme.read_text(encoding='utf-8')))} words of text) and results/README.md")


def words_of(text):
    """The words of a README outside of tables and code."""
    return re.sub(r"^```.*?^```[^\n]*$|^\|[^\n]*$", "", text, flags=re.M | re.S).split()


if __name__ == "__main__":
    main()
