"""The README's tables are made from results/*.csv. `PYTHONPATH=. python tests/test_readme.py` writes them; the tests hold them together."""
import re
from itertools import groupby

import common
import numpy as np
import pytest
from conftest import ROOT, script

README = ROOT / "README.md"


def num(text, form):
    return format(float(text), form)


def tables():
    """Markdown of each table, from the CSV files alone."""
    results = {path.stem: common.read_csv(path) for path in (ROOT / "results").glob("*.csv")}
    head = "| {} | axis | \\|corr\\| | purity | decoded range over z in [-1.5, 1.5] | MIG | SAP | seed |"
    wetvae, others = ([head.format(name), "|---" * 8 + "|"] for name in ("model", "experiment, labels, β, γ"))
    for r in results["wetvae"]:
        if r["experiment"] in ("seeds", "full") and r["seed"] != "0" or r["experiment"] == "seeds":
            continue
        unit = "°" if r["factor"] in ("direction", "curvature") else ""
        name = "trajectory VAE" if r["labels"] == "none" else "WET-VAE"
        if r["experiment"] != "main":
            name = f"{r['experiment']}, {r['labels']}, {num(r['beta'], 'g')}, {num(r['gamma'], 'g')}"
        (wetvae if r["experiment"] == "main" else others).append(
            f"| {name} | {r['factor']} | {num(r['abs_corr'], '.2f')} | {num(r['purity'], '.2f')} | "
            f"{num(r['range_low'], '.2f')}{unit} .. {num(r['range_high'], '.2f')}{unit} | {num(r['mig'], '.2f')} | "
            f"{num(r['sap'], '.2f')} | {r['seed']} |")
    seeds = ["| experiment, model | axis | mean purity | 95 % interval | worst (seed) | mean \\|corr\\| | largest empty angle: mean, worst "
             "| n |", "|---" * 8 + "|"]
    groups = {}
    for r in results["wetvae"]:
        if r["experiment"] in ("seeds", "full"):
            groups.setdefault((r["experiment"], r["labels"], r["factor"]), []).append(r)
    for (experiment, labels, factor), rows in groups.items():
        purity, corr, gaps = (np.array([float(r[k]) for r in rows if r[k]]) for k in ("purity", "abs_corr", "largest_gap_deg"))
        low, high = common.bootstrap_interval(purity)
        name = {"none": "trajectory VAE", "circle": "circle", "plain": "Eq. 4 as printed"}.get(labels, "WET-VAE")
        name = "Gaussian axis" if (experiment, labels) == ("full", "full") else name
        empty = f"{gaps.mean():.1f}°, {gaps.max():.1f}°" if len(gaps) else "–"
        seeds.append(f"| {experiment}, {name} | {factor} | {purity.mean():.3f} | {low:.3f} .. {high:.3f} | {purity.min():.3f} "
                     f"({rows[purity.argmin()]['seed']}) | {corr.mean():.2f} | {empty} | {len(rows)} |")
    for factor in dict.fromkeys(factor for experiment, _, factor in groups if experiment == "seeds"):
        ours, plain = ({r["seed"]: float(r["purity"]) for r in groups.get(("seeds", labels, factor), [])} for labels in ("seeds", "none"))
        gap = np.array([ours[seed] - plain[seed] for seed in ours if seed in plain])
        low, high = common.bootstrap_interval(gap)
        seeds.append(f"| seeds, WET-VAE − trajectory VAE | {factor} | {gap.mean():.3f} | {low:.3f} .. {high:.3f} | {gap.min():.3f} | – | – | "
                     f"{len(gap)} |")
    policies = ["| policy | seed | updates | minutes | tracking error, mean actions | before calibration | sampled | direction error "
                "| speed ratio slow / middle / fast | flips "
                "| executed purity speed / direction / curvature / acceleration | coverage (cells) |", "|---" * 12 + "|"]
    order = list(script("03_train_policy").EXPERIMENTS).index
    for r in sorted(results["policies"], key=lambda r: (order(r["experiment"]), r["seed"])):
        ratios = " / ".join(num(r["speed_ratio_" + speed], ".2f") for speed in ("slow", "mid", "fast"))
        purity = " / ".join(num(r[k], ".2f") if r[k] else "–" for k in r if k.startswith("purity_"))
        policies.append(f"| {r['experiment']} | {r['seed']} | {r['updates']} | {num(r['train_minutes'], '.0f')} | "
                        f"{num(r['tracking_error'], '.3f')} | {num(r['tracking_error_as_trained'], '.3f')} | "
                        f"{num(r['tracking_error_sampled'], '.3f')} | {num(r['direction_error_deg'], '.1f')}° | "
                        f"{ratios} | {r['flips']} | {purity} | {r['coverage_cells']} |")
    baselines = ["| method | seed | measure | value |", "|---|---|---|---|"] + [
        f"| {r['method']} | {r['seed']} | {r['what'].replace('_', ' ')} | {num(r['value'], '.3f')} |"
        for r in sorted(results["baselines"], key=lambda r: (r["method"], r["seed"]))]
    stage = script("04_mpc_maze")
    key = lambda r: (r["maze"], r["objective"], r["reward"], r["prediction"], r["seed"])  # noqa: E731
    results["sum"] = [r for r in results["mazes"] if r["objective"] == "sum"]
    final = [r for r in results["mazes"] if r["objective"] == "final"]
    ordered = sorted((r for r in final if (r["policy_seed"], r["options"]) == ("0", "")),
                     key=lambda r: (r["maze"], r["objective"], r["reward"], r["prediction"] == "decoder", r["seed"]))
    mazes = stage.HEADER.split("\n") + [stage.summary(list(rows)) for _, rows in groupby(ordered, key)]
    bench = ["| what | ours | peer | ratio | unit |", "|---" * 5 + "|"]
    for r in results["bench"]:
        bench.append(f"| {r['what']} | {num(r['ours'], '.0f')} | {num(r['peer'], '.0f')}, {r['peer_name']} | {num(r['ratio'], '.2f')} | "
                     f"{r['unit']} |")
    panels = [(maze, reward) for maze in ("maze1", "maze2") for reward in ("dense", "sparse")]

    def by_panel(rows, label, first):
        """A line per label of the rows, a column per panel: mean final distance, its 95 % interval and the success."""
        groups = {}
        for r in rows:
            groups.setdefault(label(r), {}).setdefault((r["maze"], r["reward"]), []).append(r)
        head = [f"| {first} | " + " | ".join(f"Maze {maze[4]}, {reward}" for maze, reward in panels) + " |", "|---" * 6 + "|"]
        return head + [
            f"| {name} | " + " | ".join("{:.1f} ({:.1f} .. {:.1f}), {:.0f} %".format(
                stage.distances(cells[panel]).mean(), *common.bootstrap_interval(stage.distances(cells[panel])),
                100 * np.mean([int(r["success"]) for r in cells[panel]])) for panel in panels) + " |" for name, cells in groups.items()]

    name = lambda r: stage.LOOK[r["method"], r["prediction"]]  # noqa: E731
    some = [r for r in results["figure7"] if r["samples"] in ("10", "100", "1000")]
    planning = by_panel(some, lambda r: f"{name(r)} | {r['samples']}", "method | N")
    matched = by_panel(results["matched"], lambda r: f"{name(r)} | {r['look_ahead']}", "method | steps ahead")
    options = by_panel(results["best"] + results["sum"], lambda r: f"{'best' if r['options'] else 'sum'}, {name(r)} | {r['samples']}", "options | N")
    walked = by_panel([r for r in final if r["prediction"] == "relation"], lambda r: f"{r['policy_seed']} | {'sampled' if r['options'] else 'mean'}",
                      "policy's seed | actions")
    fig18 = stage.HEADER.split("\n") + [stage.summary(list(rows)) for _, rows in groupby(results["fig18"], lambda r: r["maze"])]
    return dict(wetvae=wetvae, others=others, seeds=seeds, policies=policies, mazes=mazes, baselines=baselines, bench=bench, planning=planning,
                options=options, matched=matched, walked=walked, fig18=fig18, table2=stage.markdown(results["table2"]).split("\n"),
                claims=stage.markdown(stage.verdicts(results["claims"])).split("\n"))


def between(name):
    return re.compile(rf"(<!-- table {name} -->\n)(.*?)(<!-- end -->)", re.S)


@pytest.mark.parametrize("name", ["wetvae", "others", "seeds", "policies", "baselines", "mazes", "planning", "claims", "options", "matched",
                                  "walked", "fig18", "table2", "bench"])
def test_tables_are_those_of_the_results(name):
    assert between(name).search(README.read_text())[2].strip().split("\n") == tables()[name]


def test_every_linked_file_exists():
    for link in re.findall(r"\]\(([^)#]+)\)", README.read_text()):
        assert (ROOT / link).exists(), link


def test_every_function_named_beside_the_paper_exists():
    rows = [line for line in README.read_text().split("\n") if re.search(r"\]\((0[1-4]|common)", line)]
    assert len(rows) >= 12
    for row in rows:
        for path, names in re.findall(r"\]\((\w+\.py)\)((?: `\w+`,?)+)", row):
            source = (ROOT / path).read_text()
            for name in re.findall(r"`(\w+)`", names):
                assert re.search(rf"^(def|class) {name}\b|^{name} =", source, re.M), f"{name} in {path}"


def test_learning_curves_end_where_their_policies_are():
    rows = {(r["experiment"], r["seed"]): r for r in common.read_csv(ROOT / "results/policies.csv")}
    paths = list((ROOT / "results").glob("learning_curve_*.csv"))
    assert len(paths) >= 3
    for path in paths:
        row = rows[tuple(path.stem.removeprefix("learning_curve_").split("_seed"))]
        assert float(common.read_csv(path)[-1]["tracking_error"]) == pytest.approx(float(row["tracking_error_as_trained"]), rel=1e-4)


def test_pretrained_policy_still_tracks_as_its_row_says(s3, tmp_path):
    """The committed weights, run again, give the committed number (contacts make single roll-outs chaotic across machines)."""
    policy = common.load(tmp_path, "policy", "ant_semi", 0)
    row, = [r for r in common.read_csv(ROOT / "results/policies.csv") if r["experiment"] == "ant_semi" and r["seed"] == "0"]
    executed, commanded, flipped = s3.grid_run(common.load_actor(policy), common.load_decoder(policy))
    error, degrees, _ = s3.tracking(executed, commanded)
    assert abs(error - float(row["tracking_error"])) < 0.03 and flipped.sum() == int(row["flips"])
    assert abs(degrees[2:].mean() - float(row["direction_error_deg"])) < 2


def test_pretrained_decoder_has_the_purity_its_row_says(s2, tmp_path):
    content = common.load(tmp_path, "wetvae", "main", 0)
    decoder, names = common.load_decoder(content), content["names"]
    curves = [common.factors_of(s2.traverse(decoder, i, np.linspace(-1.5, 1.5, 61), 5)) for i in range(3)]
    _, purity = common.cross_talk(curves, names, content["ranges"])
    rows = {r["factor"]: float(r["purity"]) for r in common.read_csv(ROOT / "results/wetvae.csv")
            if (r["experiment"], r["seed"]) == ("main", "0") and r["labels"] != "none"}
    np.testing.assert_allclose(purity, [rows[name] for name in names], atol=1e-3)


if __name__ == "__main__":
    text = README.read_text()
    for name, lines in tables().items():
        text = between(name).sub(lambda m, lines=lines: m[1] + "\n".join(lines) + "\n" + m[3], text)
    README.write_text(text)
