"""A maintainer's command: ships the results of a run, and makes every table and line number of both READMEs.

python tests/report.py --ship runs   copies policies, decoders, CSV rows and figures of runs/ into pretrained/, results/ and
                                     figures/ (rows replace those with the same keys), then does what follows
python tests/report.py               writes results/README.md, and in README.md each part between <!-- table NAME --> and
                                     <!-- end -->, the line numbers of the paper's map among them

A table whose rows are not there is one sentence instead. tests/test_readme.py holds text and CSVs together.
"""
import argparse
import re
import shutil
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
import common  # noqa: E402

KEYS = {  # of each results file: the columns that name a row, or a group of rows that is replaced as a whole
    "wetvae": ("experiment", "seed", "labels", "factor"),
    "policies": ("experiment", "seed"),
    "claims": ("claim", "mode", "maze", "reward", "better", "better_samples", "worse", "worse_samples"),
    "table2": ("method",),
    "bench": ("what", "peer_name"),
} | dict.fromkeys(("mazes", "figure7", "fig18", "matched"), ("maze", "method", "mode", "seed", "policy_seed"))
DECODERS = ("main", "main_none", "full_circle", "speed_acc")  # that policies and Fig 4 need
CORES = {"1": "one core, another training beside it", "2": "two cores"}
LARGEST = 2_000_000  # bytes of a shipped file
NOT_YET = "not measured yet"
PANELS = [(maze, kind) for maze in ("maze1", "maze2") for kind in ("dense", "sparse")]
METHODS = [("wedis", "printed"), ("wedis", "closed"), ("wedis_s", "printed"), ("wedis_nts", "printed"),
           ("dads", "printed"), ("sectar", "printed")]
NAMES = dict(wedis="WEDIS", wedis_s="WEDIS-S", wedis_nts="WEDIS-NTS", dads="DADS", sectar="SeCTAR",
             maze1="Maze 1", maze2="Maze 2", s_maze="S-maze", obstacles="obstacles",
             printed="as printed", closed="closed loop")
POLICIES = ["ant_semi", "ant_full", "half_cheetah", "ant_world_frame", "ant_dads", "ant_sectar", "ant_sectar_no_explorer"]


# ---------------------------------------------------------------- shipping

def ship(runs):
    """Copy what a runs/ folder holds into the shipped folders; never checkpoints, data sets or unmeasured policies."""
    for path in sorted((runs / "results").glob("*.csv")):
        rows = common.read_csv(path)
        if path.stem in KEYS and rows:
            common.update_csv(ROOT / "results" / path.name, rows, KEYS[path.stem])
            (ROOT / "results" / f"{path.name}.lock").unlink(missing_ok=True)
            print(f"merged {len(rows)} rows into results/{path.name}")
    for path in sorted((runs / "figures").glob("*.[pg][ni][gf]")):
        if not path.name.startswith("dataset_"):
            copy(path, ROOT / "figures")
    for name in DECODERS:
        path = runs / common.artifact_name("wetvae", name, 0)
        if path.exists():
            copy(path, ROOT / "pretrained")
    for path in sorted(runs.glob("policy_*_seed*.pt")):
        experiment, seed = re.fullmatch(r"policy_(\w+)_seed(\d+)", path.stem).groups()
        if any((row["experiment"], row["seed"]) == (experiment, seed) for row in results("policies")):
            copy(path, ROOT / "pretrained")
        else:
            print(f"left out {path.name}: it has no row in policies.csv")


def learning_curves():
    """results/learning_curves.csv and figures/learning_curves.png, from what the shipped policies hold."""
    rows = []
    for row in policy_rows(POLICIES):
        policy = common.load("pretrained", "policy", row["experiment"], int(row["seed"]))
        rows += [dict(experiment=row["experiment"], seed=row["seed"]) | point for point in policy["curve"]]
    (ROOT / "results" / "learning_curves.csv").unlink(missing_ok=True)
    common.update_csv(ROOT / "results" / "learning_curves.csv", rows, ())
    (ROOT / "results" / "learning_curves.csv.lock").unlink(missing_ok=True)
    names = [name for name in POLICIES if select(rows, experiment=name)]
    wide = min(4, len(names))
    high = -(-len(names) // wide)
    figure, axes = common.plt.subplots(high, wide, figsize=(3 * wide, 2.4 * high), sharey=True, squeeze=False)
    for ax, name in zip(axes.flat, names):
        for seed in dict.fromkeys(row["seed"] for row in select(rows, experiment=name)):
            own = select(rows, experiment=name, seed=seed)
            for column, colour in (("tracking_error", common.BLUE), ("tracking_error_closed", common.RED)):
                points = [(row["minutes"], row[column]) for row in own if column in row]
                if points:
                    ax.plot(*zip(*points), color=colour, lw=1, label=column.replace("_", " "))
        ax.set(title=name, xlabel="minutes of training", ylim=(0, 1.1))
    for ax in axes.flat[len(names):]:
        ax.axis("off")
    found = dict(zip(*axes[0, 0].get_legend_handles_labels()[::-1]))
    figure.legend(found.values(), found, loc="outside lower center", ncols=2)
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


def interval(values, draws=10_000):
    """95 % bootstrap interval of the mean. values (n,): seeds are drawn anew; (policies, trials): policies and trials
    of each (the hierarchical bootstrap), for trials of one policy alone say nothing about the next policy."""
    rng = np.random.default_rng(0)
    if values.ndim == 1:
        means = values[rng.integers(len(values), size=(draws, len(values)))].mean(1)
    else:
        policies, trials = values.shape
        drawn = rng.integers(policies, size=(draws, policies, 1))
        means = values[drawn, rng.integers(trials, size=(draws, policies, trials))].mean((1, 2))
    return tuple(np.quantile(means, [0.025, 0.975]))


def by_policy(rows, column):
    """A column of planning rows: (policies, trials)."""
    found = {}
    for row in rows:
        found.setdefault(row["policy_seed"], []).append(float(row[column]))
    return np.array(list(found.values()))


def counted(n, one, many=None):
    return f"{n} {one if n == 1 else many or one + 's'}"


def markdown(head, rows):
    head, *rows = ("| " + " | ".join(row) + " |" for row in [head, *rows])
    return [head, "|---" * (head.count("|") - 1) + "|", *rows]


def missing(what, command):
    return [f"*{what} {NOT_YET}: `{command}`.*"]


def picture(name, title, folder=""):
    path = f"figures/{name}"
    return [f"![{title}]({folder}{path})"] if (ROOT / path).exists() else []


# ---------------------------------------------------------------- the tables of README.md

def gifs():
    found = [picture(f"{maze}.gif", f"The Ant crosses {NAMES[maze]}") for maze in ("maze1", "maze2")]
    if not all(found):
        return ["*The GIFs of the Ant in both mazes are not made yet: `python 04_mpc_maze.py`.*"]
    return markdown(["Maze 1", "Maze 2"], [[found[0][0], found[1][0]]])


def planned(name, **where):
    """Planning rows by (maze, reward, method, mode)."""
    found = {}
    for row in select(results(name), **where):
        found.setdefault((row["maze"], row["reward"], row["method"], row["mode"]), []).append(row)
    return found


def mazes():
    found = planned("mazes", samples=1000, method="wedis")
    if any((*panel, "wedis", mode) not in found for panel in PANELS for mode in ("printed", "closed")):
        return missing("The mazes are", "python 04_mpc_maze.py")
    rows = []
    for maze, kind in PANELS:
        rows.append([NAMES[maze], kind])
        for mode in ("printed", "closed"):
            cell = found[maze, kind, "wedis", mode]
            distance, success = by_policy(cell, "final_distance"), by_policy(cell, "success")
            rows[-1].append(f"{distance.mean():.1f} m, {100 * success.mean():.0f} %")
    policies, trials = distance.shape
    return markdown(["maze", "reward", "as printed", "closed loop"], rows) + [
        "", f"Distance to the goal at the end (26.8 m at the start), and share of trials that end within 5 m of it; "
        f"{counted(policies, 'policy', 'policies')}, {trials} trials each."]


def minutes_of_04():
    """The default run's time, from the docstring of 04, where it is written by hand."""
    text = re.search(r"python 04_mpc_maze\.py .*?(\S+) (s|minutes?) on two cores", (ROOT / "04_mpc_maze.py").read_text(encoding="utf-8"))
    if not text or not text[1].replace(".", "").isdigit():
        return NOT_YET
    return f"{float(text[1]) / (60 if text[2] == 's' else 1):.1f}"


def scripts():
    vae = select(results("wetvae"), experiment="main", seed=0)
    policy = select(results("policies"), experiment="ant_semi", seed=0)
    seconds = sum(float(row["train_seconds"]) for row in vae if row["factor"] == "speed")
    purity = " / ".join(number(row["purity"]) for row in vae if row["labels"] == "main")
    rows = [["`python 01_make_dataset.py`", "0.1", "100,000 trajectories, Table 1, Fig 9",
             "20 % of them straight, mean speed 0.50"],
            ["`python 02_train_wetvae.py`", f"{seconds / 60:.1f} (one core)" if vae else "-",
             "WET-VAE and trajectory VAE, Fig 4", f"purity {purity}" if vae else NOT_YET]]
    expect, minutes = NOT_YET, NOT_YET
    if policy:
        error, closed = (number(policy[0][key]) for key in ("tracking_error", "tracking_error_closed"))
        minutes = f"{number(policy[0]['train_minutes'], '.0f')} ({CORES[policy[0]['threads']]})"
        expect = f"tracking error {error} open loop, {closed} closed loop"
    rows.append(["`python 03_train_policy.py`", minutes, "skill policy of the Ant, Fig 5", expect])
    rows.append(["`python 04_mpc_maze.py`", minutes_of_04(), "mazes, Fig 3, 6, 8, 14, 17, GIFs", "the table above"])
    return markdown(["command", "minutes", "makes", "expect (seed 0)"], rows)


def fig4():
    rows = select(results("wetvae"), experiment="main", seed=0)
    lines = []
    for labels, name in (("main", "WET-VAE"), ("none", "trajectory VAE")):
        lines.append([name] + [number(row["purity"]) for row in select(rows, labels=labels)])
    if min(map(len, lines)) < 4:
        return missing("Fig 4 is", "python 02_train_wetvae.py")
    return markdown(["purity, seed 0", "speed", "direction", "curvature"], lines) + [
        "", *picture("fig04_latent_traversals.png", "Fig 4")]


def policy_rows(names):
    rows = [row for row in results("policies") if row["experiment"] in names]
    return sorted(rows, key=lambda row: (names.index(row["experiment"]), int(row["seed"])))


def absent(names):
    """One sentence on the policies that have no row."""
    there = {row["experiment"] for row in results("policies")}
    rest = [f"`{name}`" for name in names if name not in there]
    return ["", f"*{', '.join(rest)}: {NOT_YET}.*"] if rest else []


def fig5():
    rows = []
    for row in policy_rows(POLICIES[:4]):
        rows.append([f"`{row['experiment']}`", row["seed"], number(row["train_minutes"], ".0f"), row["threads"],
                     number(row["tracking_error"]), number(row["tracking_error_closed"]),
                     number(row["follow_median_m"]) + " m", number(row["follow_p90_m"]) + " m",
                     number(row["fall_rate"], ".1f", 100) + " %"])
    if not rows:
        return missing("Policies are", "python 03_train_policy.py")
    return markdown(["policy", "seed", "minutes", "threads", "tracking error, open", "closed", "following error, median", "90 %",
                     "falls"], rows) + absent(POLICIES[:4]) + ["", *picture("fig05_skills_wedis.png", "Fig 5")]


def baselines():
    rows = []
    for row in policy_rows(POLICIES[4:]):
        rows.append([f"`{row['experiment']}`", row["seed"], number(row["train_minutes"], ".0f"), row["updates"],
                     number(row["tracking_error"])])
    if not rows:
        return missing("The baselines are", "python 03_train_policy.py --experiment ant_dads")
    return markdown(["policy", "seed", "minutes", "updates", "tracking error, open"], rows) + absent(POLICIES[4:])


def fig7():
    found, rows = planned("figure7", samples=1000), []
    for method, mode in METHODS:
        if all((*panel, method, mode) in found for panel in PANELS):
            cells = [by_policy(found[*panel, method, mode], "final_distance") for panel in PANELS]
            rows.append([f"{NAMES[method]}, {NAMES[mode]}"] + [f"{cell.mean():.1f} m" for cell in cells]
                        + [f"{len(cells[0])} x {cells[0].shape[1]}"])
    if not rows:
        return missing("Fig 7 is", "python 04_mpc_maze.py --experiment figure7")
    rest = [f"{NAMES[method]}, {NAMES[mode]}" for method, mode in METHODS
            if not any(row[0] == f"{NAMES[method]}, {NAMES[mode]}" for row in rows)]
    return markdown(["1000 samples", *(f"{NAMES[maze]}, {kind}" for maze, kind in PANELS), "policies x trials"], rows) + (
        ["", f"*{NOT_YET.capitalize()}: {'; '.join(rest)}.*"] if rest else []) + [
        "", *picture("fig07_planning.png", "Fig 7")]


CLEAR = 0.8  # purity from which an axis counts as its factor


def skill_claims():
    """Claims of Sec. 6.1 and App. A.3, each with a verdict and what is measured here, seed 0."""
    vae = results("wetvae")

    def purities(experiment, labels):
        """As text, and the least of them, an unused axis as 0 (-1 if there is no row)."""
        cells = [row["purity"] for row in select(vae, experiment=experiment, seed=0, labels=labels)]
        least = min([0.0 if cell == "nan" else float(cell) for cell in cells], default=-1.0)
        return " / ".join(number(cell) for cell in cells) or NOT_YET, least

    def gaps(experiment, labels):
        found = [row["largest_gap_deg"] for row in in_order(select(vae, experiment=experiment, labels=labels))
                 if row["largest_gap_deg"]]
        return ", ".join(number(gap, ".1f") for gap in found) or NOT_YET, min(map(float, found), default=-1.0)

    def row(claim, holds, text):
        return [claim, text if NOT_YET in text else ("holds: " if holds else "does not hold: ") + text]

    main, none = purities("main", "main"), purities("main", "none")
    grid = {(b, g): purities("beta_gamma", f"b{b}_g{g}") for b, g in ((9, 0), (9, 1), (1, 10), (3, 10), (9, 10))}
    polar, cartesian, xy = (purities("polar", labels) for labels in ("polar", "cartesian", "none"))
    line, line_none = purities("speed_acc", "speed_acc"), purities("speed_acc", "none")
    four, circle = purities("four_factors", "four_factors"), purities("four_factors", "circle")
    gap, gap_circle, gap_polar, gap_four = (gaps(*model) for model in (
        ("full", "full"), ("full", "circle"), ("polar", "polar"), ("four_factors", "four_factors")))
    errors = [number(policy["tracking_error"]) for policy in policy_rows(["ant_semi"])]
    return [
        row("the three factors are suitably disentangled (Fig 4)", main[1] >= CLEAR, main[0]),
        row("without labels they are entangled, one axis is unused", none[1] == 0, none[0]),
        row("both beta and gamma need proper choices (Fig 10)", grid[9, 10][1] > max(grid[key][1] for key in grid if key != (9, 10)),
            NOT_YET if min(least for _, least in grid.values()) < 0 else "least purity at beta, gamma " + ", ".join(
                f"({b}, {g}): {least:.2f}" for (b, g), (_, least) in grid.items())),
        row("other labels give other axes (Fig 11)", min(polar[1], cartesian[1]) >= CLEAR,
            f"polar {polar[0]}, Cartesian {cartesian[0]}, none {xy[0]}"),
        row("speed and acceleration in 1D (Fig 12)", line[1] >= CLEAR, line[0]),
        row("... nothing meaningful without labels", not any(float(r["purity"]) >= CLEAR for r in select(
            vae, experiment="speed_acc", labels="none", seed=0)), f"{line_none[0]}; speed has an axis"),
        row("four factors in one model (Fig 13)", four[1] >= CLEAR, f"{four[0]}; with `CIRCLE` {circle[0]}"),
        row("empty angles on the full circle (A.3.1)", gap[1] > 5,
            f"largest one, degrees: {gap[0]} (two factors: {gap_polar[0]}, four: {gap_four[0]}); `CIRCLE` {gap_circle[0]}"),
        ["executed skills are similar to predicted ones (Fig 5)",
         f"tracking error, open loop: {', '.join(errors)}" if errors else NOT_YET]]


def planning_claims():
    found, rows = {}, []
    for row in results("claims"):
        found.setdefault(row["claim"], {}).setdefault(row["mode"], []).append(row["verdict"])
    for words, modes in found.items():
        cells = [f"{NAMES[mode]} " + " / ".join(str(verdicts.count(verdict))
                                          for verdict in ("holds", "undecided", "does not hold"))
                 for mode, verdicts in modes.items()]
        rows.append([words, ", ".join(cells)])
    return rows


def ten_seeds():
    purity = {}
    for row in select(results("wetvae"), experiment="seeds", labels="seeds"):
        purity.setdefault(row["factor"], []).append(0.0 if row["purity"] == "nan" else float(row["purity"]))
    if not purity or min(map(len, purity.values())) < 10:
        return ["", *missing("Ten seeds of the WET-VAE are", "python 02_train_wetvae.py --experiment seeds --seed N")]
    unused = {row["seed"] for row in select(results("wetvae"), experiment="seeds", labels="none") if row["purity"] == "nan"}
    return ["", "Ten seeds of the WET-VAE, mean purity (worst): " + ", ".join(
        f"{name} {np.mean(values):.3f} ({min(values):.3f})" for name, values in purity.items())
        + f". Without labels an axis is unused with {len(unused)} of them."]


def claims():
    rows, seeds = planning_claims(), ten_seeds()
    if NOT_YET in "".join(seeds):
        seeds = []  # results/README.md says it
    return markdown(["the paper says", "here: purity of each axis (-: unused), or comparisons: hold / undecided / do not hold"],
                    skill_claims() + rows) + seeds + ([] if rows else ["", *missing(
                        "The claims on planning (Sec. 6.2.1) are", "python 04_mpc_maze.py --experiment figure7")])


def bench():
    form = {row["what"]: ".0f" if float(row["ours"]) >= 10 else ".3f" for row in results("bench")}
    rows = [[row["what"], number(row["ours"], form[row["what"]]), f"{number(row['peer'], form[row['what']])}, {row['peer_name']}",
             number(row["ratio"]), row["unit"]] for row in results("bench")]
    return markdown(["what", "ours", "peer", "ratio", "unit"], rows) if rows else missing("Speed is", "python tests/bench.py")


# ---------------------------------------------------------------- the map from the paper to lines of code

MAP = [  # what, places: script, text to look for
    ("Table 1, App. A.1.1", [("01", "SPEED_LOW ="), ("01", "def make_trajectories")]),
    ("weak labels, Fig 9", [("common", "def weak_labels"), ("01", "def draw(")]),
    ("Fig 1, App. A.1.2", [("02", "class Encoder"), ("02", "class LabelDecoders"), ("common", "class Decoder(")]),
    ("Eq. 3", [("02", "def objective")]),
    ("Eq. 4", [("02", "loss = -(states")]),
    ("Alg. 1, first loop", [("02", "def train(")]),
    ("Alg. 1, \"Test: check factors in z\"", [("02", "def check_factors")]),
    ("Fig 4, 10 to 13", [("02", "def draw_traversals")]),
    ("Alg. 1, \"Test: find relation functions\"", [("02", "def find_relation")]),
    ("relation functions, Sec. 4.2.2", [("common", "def next_skill")]),
    ("Alg. 1, second loop", [("03", "def train_wedis")]),
    ("Eq. 5, 6", [("03", "def reward(")]),
    ("SAC, App. A.1.3", [("03", "class Sac"), ("common", "class Actor")]),
    ("command, base frame (ours)", [("common", "def commands_of"), ("common", "def to_base_frame")]),
    ("Fig 5, 15, 16", [("03", "def draw_skills"), ("03", "def tracking("), ("03", "def following(")]),
    ("DADS, SeCTAR", [("03", "def train_dads"), ("03", "def train_sectar")]),
    ("Alg. 2, lines 2 to 12", [("04", "def plan(")]),
    ("trajectory scaling, Fig 3", [("04", "def scaled_path"), ("04", "def draw_fig03")]),
    ("Alg. 2, lines 13 to 20", [("common", "def execute"), ("04", "def run(")]),
    ("closed loop (ours)", [("common", "def closed_loop")]),
    ("r_d, r_s, Sec. 6.2", [("04", "def reward(")]),
    ("Table 2, App. A.1.4", [("04", "METHODS = {"), ("04", "EPISODE =")]),
    ("Fig 7, 8", [("04", "def draw_fig07"), ("04", "def draw_examples")]),
]
FILES = {"01": "01_make_dataset.py", "02": "02_train_wetvae.py", "03": "03_train_policy.py", "04": "04_mpc_maze.py",
         "common": "common.py"}


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
    rows = []
    for row in in_order(results("wetvae")):
        unit = " deg" if row["factor"] in ("direction", "curvature") else ""
        rows.append([row["experiment"], row["labels"], row["seed"], row["beta"], row["gamma"], row["factor"],
                     number(row["purity"]), row["crosstalk"], number(row["abs_corr"]),
                     f"{number(row['range_low'])} .. {number(row['range_high'])}{unit}",
                     number(row["largest_gap_deg"], ".1f"), row["train_seconds"]])
    return markdown(["experiment", "labels", "seed", "beta", "gamma", "factor", "purity", "cross-talk", "abs corr",
                     "decoded over z in [-1.5, 1.5]", "largest empty angle, deg", "seconds"], rows) if rows else missing(
                         "WET-VAEs are", "python 02_train_wetvae.py")


def full_seeds():
    groups, rows = {}, []
    for row in in_order(results("wetvae")):
        groups.setdefault((row["settings"], row["experiment"], row["labels"], row["factor"]), []).append(row["purity"])
    for (_, experiment, labels, factor), cells in groups.items():
        values = np.array([float(cell) for cell in cells if cell != "nan"])
        if len(cells) > 1 and len(values):
            around = "{:.3f} .. {:.3f}".format(*interval(values)) if len(values) > 2 else "-"
            rows.append([experiment, labels, factor, f"{values.mean():.3f}", around, f"{values.min():.3f}",
                         f"{len(values)} of {len(cells)}"])
    lines = markdown(["experiment", "labels", "factor", "mean purity", "95 % interval", "worst", "n (of which not unused)"],
                     rows) if rows else []
    return lines + ten_seeds()


def full_policies():
    found = policy_rows(POLICIES) + [row for row in results("policies") if row["experiment"] not in POLICIES]
    if not found:
        return missing("Policies are", "python 03_train_policy.py")
    first, second = [], []
    for row in found:
        name = [row["experiment"], row["seed"]]
        first.append([*name, row["updates"], row["env_steps"], number(row["train_minutes"], ".1f"),
                      number(row["tracking_error"], ".3f"), number(row["tracking_error_closed"], ".3f"),
                      *(number(row[f"{key}{end}"], form, scale) for key, form, scale in (
                          ("follow_median_m", ".2f", 1), ("follow_p90_m", ".2f", 1), ("fall_rate", ".2f", 100))
                        for end in ("_open", ""))])
        if row["method"] == "wedis":
            second.append([*name, *(f"{number(row.get(f'purity_{axis}_open'))}, {number(row.get(f'purity_{axis}'))}"
                                    for axis in (*common.SINGLE, *common.MULTI))])
    return markdown(["policy", "seed", "updates", "environment steps", "minutes", "tracking error, open", "closed",
                     "following error, median m, open", "closed", "90 % m, open", "closed", "falls %, open", "closed"],
                    first) + [
        "", "Executed purity, open loop and closed loop (- : not an axis, or unused):", ""] + markdown(
        ["policy", "seed", "speed", "direction", "curvature", "acceleration"], second) + absent(POLICIES)


def full_planning(name, what, command):
    rows, cells = [], {}
    for row in results(name):
        key = (row["maze"], row["reward"], row["method"], row["mode"], int(row["look_ahead"]), int(row["samples"]))
        cells.setdefault(key, []).append(row)
    for (maze, kind, method, mode, ahead, samples), found in cells.items():
        distance, success = by_policy(found, "final_distance"), by_policy(found, "success")
        low, high = interval(distance)
        rows.append([NAMES.get(maze, maze), kind, NAMES.get(method, method), NAMES[mode], str(ahead), str(samples),
                     f"{distance.mean():.2f}", f"{low:.2f} .. {high:.2f}", f"{np.median(distance):.2f}",
                     f"{100 * success.mean():.0f} %", number(by_policy(found, "planning_ms").mean(), ".1f"),
                     f"{len(distance)} x {distance.shape[1]}"])
    return markdown(["maze", "reward", "method", "mode", "look-ahead, steps", "samples", "mean distance, m",
                     "95 % interval", "median", "success", "ms a plan", "policies x trials"], rows) if rows else missing(what, command)


def per_policy():
    rows, cells = [], {}
    for row in results("mazes"):
        cells.setdefault((row["maze"], row["reward"], row["method"], row["mode"], row["policy_seed"]), []).append(row)
    for (maze, kind, method, mode, seed), found in cells.items():
        distance = np.array([float(row["final_distance"]) for row in found])
        success = np.mean([float(row["success"]) for row in found])
        rows.append([NAMES.get(maze, maze), kind, NAMES.get(method, method), NAMES[mode], seed,
                     f"{distance.mean():.2f}", f"{np.median(distance):.2f}", f"{100 * success:.0f} %"])
    return markdown(["maze", "reward", "method", "mode", "policy seed", "mean distance, m", "median", "success"], rows) if rows else []


def full_claims():
    rows = [[row["claim"], NAMES.get(row["mode"], row["mode"]), NAMES[row["maze"]], row["reward"],
             f"{NAMES[row['better']]} ({row['better_samples']})", f"{NAMES[row['worse']]} ({row['worse_samples']})",
             f"{number(row['difference'])} ({number(row['low'])} .. {number(row['high'])})", row["verdict"],
             f"{row['better_policies']}, {row['worse_policies']}; {row['trials']}"] for row in results("claims")]
    return markdown(["claim", "mode", "maze", "reward", "method (samples)", "against", "ends nearer by, m (95 %)", "verdict",
                     "policies of each; trials"], rows) if rows else missing(
                         "The claims of Sec. 6.2.1 are", "python tests/claims.py")


def full_table2():
    rows = results("table2")
    return markdown(list(rows[0]), [list(row.values()) for row in rows]) if rows else missing(
        "Table 2 as rows is", "python tests/claims.py")


def pictures():
    lines = []
    for path in sorted((ROOT / "figures").glob("*.png")):
        lines += [f"![{path.stem}](../figures/{path.name})", ""]
    return lines[:-1] or missing("Figures are", "python 02_train_wetvae.py")


SECTIONS = [
    ("WET-VAE (02): wetvae.csv", "Purity of axis i: C[i, i] / sum over j of C[i, j], where cross-talk C[i, j] is the range of "
     "factor j while axis i runs over [-1.5, 1.5], over factor j's range in the data. - : an unused axis (its whole row of C is "
     "below 0.1). Abs corr: of latent and factor, over decoded draws of the prior. Largest empty angle: of the directions "
     "that z_direction decodes to. Acceleration is a share of the speed per transition.", full_wetvae),
    ("Over seeds", "Rows of wetvae.csv with the same settings. Intervals: 95 % bootstrap of the mean over seeds (of three or more).", full_seeds),
    ("Policies (03): policies.csv", "Tracking error: RMS(executed end - predicted end) / RMS(predicted end) over a grid of skills, "
     "100 steps from rest (SeCTAR: 25 draws, 50 steps). Following error: |end - sum of its commands| of random skills of 200 steps "
     "(Half-Cheetah: 120) from 400 noisy starts, three in a row. Falls: robots that turn over in that time. Baselines have no "
     "closed loop.", full_policies),
    ("Mazes (04): mazes.csv", "Intervals of all planning tables: 95 % bootstrap over policies and trials of each; with one "
     "policy they say nothing about the next one.",
     lambda: full_planning("mazes", "The mazes are", "python 04_mpc_maze.py")),
    ("Mazes, each policy", "", lambda: per_policy() or missing("The mazes are", "python 04_mpc_maze.py")),
    ("Fig 7: figure7.csv", "", lambda: full_planning("figure7", "Fig 7 is", "python 04_mpc_maze.py --experiment figure7")),
    ("Claims of Sec. 6.2.1: claims.csv", "A comparison holds if the whole interval of the difference is above 0, does not hold if "
     "it is below, else it is undecided.", full_claims),
    ("Equal look-ahead: matched.csv", "", lambda: full_planning(
        "matched", "Equal look-ahead is", "python 04_mpc_maze.py --experiment matched")),
    ("Fig 18: fig18.csv", "", lambda: full_planning("fig18", "Fig 18 is", "python 04_mpc_maze.py --experiment fig18")),
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


def made(text):
    """README.md with each marked part made anew."""
    return BLOCK.sub(lambda found: found[1] + "\n".join(TABLES[found[2]]()).strip() + "\n" + found[4], text)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ship", metavar="RUNS", type=Path, help="a runs/ folder")
    runs = parser.parse_args().ship
    if runs:
        if not runs.is_dir():
            parser.error(f"{runs} is no folder")
        ship(runs)
        learning_curves()
    readme = ROOT / "README.md"
    readme.write_text(made(readme.read_text(encoding="utf-8")), encoding="utf-8")
    (ROOT / "results" / "README.md").write_text(results_readme(), encoding="utf-8")
    print(f"wrote README.md ({readme.stat().st_size} bytes) and results/README.md")


if __name__ == "__main__":
    main()
