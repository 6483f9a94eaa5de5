"""The claims of Sec. 6.2.1 and Table 2, from the rows of figure 7: python tests/claims.py [flags of 04_mpc_maze.py].

Reads <OUT>/results/figure7.csv, as made by 04_mpc_maze.py --experiment figure7 with the same flags, and writes
claims.csv and table2.csv beside it. Rows made with other settings are left out.
"""
import importlib
import sys
from itertools import product
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))
import common  # noqa: E402
import numpy as np  # noqa: E402

OTHERS = ["wedis_s", "wedis_nts", "dads"]  # SeCTAR is compared in the last claim alone: it counts once
CLAIMS = {  # words -> (better, its N, worse, its N)
    "WEDIS shows the outstanding results for all the cases": [("wedis", 1000, m, 1000) for m in OTHERS],
    "... even with less planning samples": [("wedis", 100, m, 1000) for m in OTHERS],
    "WEDIS-S and DADS are superior than WEDIS-NTS": [(m, 1000, "wedis_nts", 1000) for m in ("wedis_s", "dads")],
    "WEDIS-S outperforms DADS": [("wedis_s", 1000, "dads", 1000)],
    "SeCTAR has poor performance": [(m, 1000, "sectar", 1000) for m in ["wedis", *OTHERS]],
}
VERDICTS = ("holds", "undecided", "does not hold")


def comparisons(rows, stage):
    """Every comparison of each claim in each panel of Fig 7, as rows: by how many metres the better method ends nearer,
    with its 95 % interval over policies and trials. It holds if all of that is above 0, does not hold if all is below.
    mode is that of the better method; the worse one is as printed."""
    rng, found = np.random.default_rng(0), []
    panels = dict.fromkeys((row["maze"], row["reward"]) for row in rows)
    for words, mode, (maze, kind) in product(CLAIMS, ("printed", "closed"), panels):
        for better, n_better, worse, n_worse in CLAIMS[words]:
            panel = dict(column="final_distance", maze=maze, reward=kind)
            a = stage.values_of(rows, method=better, samples=n_better, mode=mode, **panel)
            b = stage.values_of(rows, method=worse, samples=n_worse, mode="printed", **panel)
            if not (a.size and b.size):
                continue
            gain = stage.resampled_means(b, rng) - stage.resampled_means(a, rng)
            low, high = np.quantile(gain, [0.025, 0.975])
            verdict = "undecided"
            if low > 0:
                verdict = "holds"
            elif high < 0:
                verdict = "does not hold"
            found.append(dict(claim=words, mode=mode, maze=maze, reward=kind, better=better, better_samples=n_better,
                              worse=worse, worse_samples=n_worse, difference=b.mean() - a.mean(), low=low, high=high,
                              verdict=verdict, better_policies=len(a), worse_policies=len(b), trials=a.shape[1]))
    return found


def counts(found):
    """Per claim and mode: how many comparisons hold, are undecided, do not hold."""
    lines = []
    for words, mode in dict.fromkeys((row["claim"], row["mode"]) for row in found):
        mine = [row["verdict"] for row in found if (row["claim"], row["mode"]) == (words, mode)]
        lines.append(dict(claim=words, mode=mode) | {verdict: mine.count(verdict) for verdict in VERDICTS})
    return lines


def table2(units):
    """Table 2, as rows, from the settings that the planner uses."""
    return [dict(method=u.method, episode_steps=u.episode, hold=u.hold, length=u.length,
                 steps_per_skill=u.hold * u.length, skills_dense=u.planned,
                 skills_sparse=u.episode // (u.hold * u.length),  # to the end of the episode
                 z_range=u.z_range, slowest_speed=0.0 if "wedis" in u.method else -u.z_range)
            for u in {u.method: u for u in units}.values()]


def main(stage):
    units = stage.units_of(*common.parse_flags(vars(stage), ["--experiment", "figure7", *sys.argv[1:]]))
    folder, present = Path(stage.OUT) / "results", {u.settings for u in units}
    path = folder / f"{stage.EXPERIMENT}.csv"
    if not path.exists():
        common.stop(f"no {path}; make it with: python 04_mpc_maze.py --experiment figure7")
    found = comparisons([row for row in common.read_csv(path) if row.get("settings") in present], stage)
    if not found:
        common.stop(f"{path} holds nothing to compare with the present settings")
    common.update_csv(folder / "claims.csv", found, tuple(found[0])[:8])
    common.update_csv(folder / "table2.csv", table2(units), ("method",))
    for line in counts(found):
        print(" | ".join(map(str, line.values())))


if __name__ == "__main__":
    main(importlib.import_module("04_mpc_maze"))
