"""The claims of Sec. 6.2.1 and Table 2, from the rows of 04: python tests/claims.py [--out FOLDER]

Reads <OUT>/results/figure7.csv and matched.csv, as made by 04_mpc_maze.py --experiment figure7 and
--experiment matched --planned 99 --samples 1000 (sparse plans of WEDIS-S and WEDIS-NTS look equally far already), and writes claims.csv
and table2.csv beside them. `--out .` judges what is shipped; tests/report.py --ship does the same.
"""
import importlib
import sys
from itertools import product
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))
import common  # noqa: E402

PLANNED = ("maze", "reward", "method", "mode", "look_ahead", "samples", "policy_seed")  # names a run's rows of 04
RIVALS = ("dads", "dads_speed", "sectar")  # planned as printed alone
ABLATIONS = ("wedis_s", "wedis_nts")
OTHERS = (*ABLATIONS, *RIVALS[:2])  # SeCTAR is compared in the last claim alone: it counts once
CLAIMS = {  # words -> (better, its N, worse, its N)
    "WEDIS shows the outstanding results for all the cases": [("wedis", 1000, m, 1000) for m in OTHERS],
    "... even with less planning samples": [("wedis", 100, m, 1000) for m in OTHERS],
    "WEDIS-S and DADS are superior than WEDIS-NTS": [(m, 1000, "wedis_nts", 1000) for m in ("wedis_s", *RIVALS[:2])],
    "WEDIS-S outperforms DADS": [("wedis_s", 1000, m, 1000) for m in RIVALS[:2]],
    "SeCTAR has poor performance": [(m, 1000, "sectar", 1000) for m in ["wedis", *OTHERS]],
}
EQUAL = {"(ours) WEDIS ends nearer at equal look-ahead": [("wedis", 1000, m, 1000) for m in ABLATIONS]}  # matched.csv too
VERDICTS = ("holds", "undecided", "does not hold")


def latest(rows, key):
    """Of rows that agree on key those with the settings that were written last: a table holds one setting."""
    last = {tuple(row[k] for k in key): row.get("settings") for row in rows}
    return [row for row in rows if row.get("settings") == last[tuple(row[k] for k in key)]]


def verdict_of(low, high):
    """Of a comparison, by the 95 % interval of how much nearer the better method ends."""
    return "holds" if low > 0 else "does not hold" if high < 0 else "undecided"


def comparisons(rows, stage, claims=CLAIMS, equal=False):
    """Every comparison of each claim in each panel of Fig 7, as rows: by how many metres the better method ends nearer,
    with its 95 % interval over policies (pairs of one seed, which share starts). Both methods are in the same mode where both have it: rivals are
    as printed. equal: only runs that look equally far ahead are compared."""
    found, rows = [], latest(rows, PLANNED)
    panels = dict.fromkeys((row["maze"], row["reward"], *([row["look_ahead"]] if equal else [])) for row in rows)
    for words, mode, panel in product(claims, ("printed", "commands"), panels):
        where = dict(zip(("maze", "reward", "look_ahead"), panel))
        for better, n_better, worse, n_worse in claims[words]:
            if mode != "printed" and {better, worse} <= set(RIVALS):
                continue  # the same comparison as in printed
            a, b = (stage.values_of(rows, "final_distance", method=method, samples=n, **where,
                                    mode="printed" if method in RIVALS else mode)
                    for method, n in ((better, n_better), (worse, n_worse)))
            if not (a.size and b.size):
                continue
            policies, trials = map(min, a.shape, b.shape)  # SeCTAR has one policy, the others three
            gain = b[:policies, :trials] - a[:policies, :trials]
            low, high = stage.interval(gain)
            found.append(dict(claim=words, against="rivals" if {better, worse} & set(RIVALS) else "ablations", mode=mode)
                         | dict(look_ahead="") | where | dict(
                better=better, better_samples=n_better, worse=worse, worse_samples=n_worse, difference=gain.mean(),
                low=low, high=high, verdict=verdict_of(low, high), better_policies=len(a), worse_policies=len(b),
                trials=a.shape[1]))
    return found


def in_words(verdicts):
    """The verdict of a claim about all its cases, with how many comparisons hold and how many do not."""
    hold, undecided, not_hold = map(verdicts.count, VERDICTS)
    word = "does not hold" if not_hold else "undecided" if undecided or not hold else "holds"
    return f"{word} ({hold} of {len(verdicts)} hold" + (f", {not_hold} do not" if not_hold else "") + ")"


def table2(stage, config):
    """Table 2, as rows, from the constants that the planner uses."""
    rows = []
    for method, row in stage.METHODS.items():
        c = {c.reward: c for c in stage.configurations_of(method, "maze1", config | row)}
        dense = c["dense"]
        rows.append(dict(method=method, episode_steps=dense.episode, hold=dense.hold, length=dense.length,
                         steps_per_skill=dense.hold * dense.length, skills_dense=dense.planned,
                         skills_sparse=c["sparse"].planned, z_range=dense.z_range,
                         slowest_speed=-dense.z_range if method in RIVALS else 0.0))
    return rows


def main(stage, argv):
    config, _ = common.parse_flags(vars(stage), ["--experiment", "figure7", *argv])
    folder = Path(stage.OUT) / "results"
    figure7, matched = (common.read_csv(path) if path.exists() else [] for path in
                        (folder / "figure7.csv", folder / "matched.csv"))
    found = comparisons(figure7, stage) + comparisons(figure7 + matched, stage, EQUAL, equal=True)
    if not found:
        common.stop(f"{folder}/figure7.csv holds nothing to compare: python 04_mpc_maze.py --experiment figure7")
    common.update_csv(folder / "claims.csv", found, ())  # no column: all rows are replaced
    common.update_csv(folder / "table2.csv", table2(stage, config), ())
    for claim in dict.fromkeys((row["claim"], row["against"], row["mode"]) for row in found):
        print(*claim, in_words([row["verdict"] for row in found if (row["claim"], row["against"], row["mode"]) == claim]),
              sep=" | ")


if __name__ == "__main__":
    main(importlib.import_module("04_mpc_maze"), sys.argv[1:])
