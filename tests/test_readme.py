"""README.md and results/README.md are what tests/report.py makes of results/*.csv and of the scripts; sizes and links; what
is shipped agrees with itself; claims, ablations and the merging of several runs, on made-up rows."""
import hashlib
import itertools
import re
import sys
from types import SimpleNamespace

import ablations
import claims
import common
import numpy as np
import pytest
import report
from conftest import ROOT, load_policy, tiny

README = (ROOT / "README.md").read_text(encoding="utf-8")
RESULTS = sorted((ROOT / "results").glob("*.csv"))
ARTIFACTS = sorted((ROOT / "pretrained").glob("*.pt"))


def test_readme_is_as_made():
    assert report.made(README) == README, "run: python tests/report.py"


def test_results_readme_is_as_made():
    assert report.results_readme() == (ROOT / "results" / "README.md").read_text(encoding="utf-8"), "run: python tests/report.py"


def test_every_table_is_in_the_readme():
    assert sorted(name for _, name, _, _ in report.BLOCK.findall(README)) == sorted(report.TABLES)


def test_readme_is_short():
    assert len(report.words_of(README)) <= 1800
    assert report.words_of("one two\n| a | b |\n```bash\nrm x\n```\nthree\n") == ["one", "two", "three"]


@pytest.mark.parametrize("path", ["README.md", "results/README.md"])
def test_every_linked_file_and_heading_exists(path):
    text = (ROOT / path).read_text(encoding="utf-8")
    headings = {re.sub(r"[^\w -]", "", h).lower().replace(" ", "-") for h in re.findall(r"^#+ (.*)$", text, re.M)}
    for link in re.findall(r"\]\(([^)]+)\)", text):
        file, _, part = link.partition("#")
        assert not file or ((ROOT / path).parent / file).exists(), link
        assert file or part in headings, link


def test_lines_of_the_map_hold_what_they_name():
    links = re.findall(r"`(\w+)` \[\w+:(\d+)\]\((\w+\.py)#L(\d+)\)", README)
    assert len(links) >= 30
    for name, number, file, anchor in links:
        assert number == anchor
        assert re.search(rf"\b{name}\b", (ROOT / file).read_text(encoding="utf-8").splitlines()[int(number) - 1]), (name, file, number)


def test_fields_words():
    text = re.sub(r"`[^`]*`", "", README)
    assert re.findall(r"\b(?:told|tell|seen|taken|promised?|wanted|moved|walked)\b", text) == []


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.name)
def test_results_file_is_small_and_its_rows_have_keys_of_their_own(path):
    assert path.stat().st_size < report.LARGEST
    rows, key = common.read_csv(path), report.KEYS.get(path.stem, ())
    assert rows
    if key and "policy_seed" not in key:
        named = [tuple(row[column] for column in key) for row in rows]
        assert len(set(named)) == len(named)


@pytest.mark.parametrize("path", ARTIFACTS, ids=lambda path: path.name)
def test_shipped_artifact_can_be_read_and_a_policy_is_measured(path, tmp_path):
    kind, experiment, seed = re.fullmatch(r"(policy|wetvae)_(\w+)_seed(\d+)", path.stem).groups()
    assert path.stat().st_size < report.LARGEST
    content = common.load(tmp_path, kind, experiment, int(seed))
    if kind == "policy":  # the row is of this policy: on another machine its error differs a little, see below
        row = report.select(report.results("policies"), experiment=experiment, seed=seed)[0]
        assert content["updates"] == int(row["updates"])
        assert content["curve"][-1]["tracking_error"] == pytest.approx(float(row["tracking_error"]), abs=0.06)


@pytest.mark.parametrize("name", [path.stem for path in ARTIFACTS if re.match(rf"policy_(?!{'|'.join(report.RIVALS.values())})", path.stem)])
def test_a_shipped_policy_comes_with_the_decoder_of_its_seed_and_has_learnt_from_it(name, tmp_path):
    experiment, seed = re.fullmatch(r"policy_(\w+)_seed(\d+)", name).groups()
    policy = common.load(tmp_path, "policy", experiment, int(seed))
    decoder = common.load(tmp_path, "wetvae", policy["config"]["DECODER"], int(seed))["decoder"].state_dict()
    assert policy["decoder"].state_dict().keys() == decoder.keys()
    assert all(np.array_equal(part, decoder[key]) for key, part in policy["decoder"].state_dict().items())


def test_planning_rows_are_of_the_shipped_policies():
    shipped = {hashlib.sha256(path.read_bytes()[:-32]).hexdigest()[:8] for path in ARTIFACTS}
    for name in report.PLANNING:
        assert {row["policy"] for row in report.results(name)} <= shipped, name


@pytest.mark.parametrize("name", report.PLANNING)
def test_a_shipped_planning_file_holds_one_setting_of_each_configuration(name):
    assert report.results(name)
    assert claims.latest(report.results(name), claims.PLANNED) == report.results(name)


# ---------------------------------------------------------------- made-up rows

def planning_rows(mean, settings="s", seeds=(0, 1, 2), trials=20, deviation=1.0, **same):
    """Rows of one configuration: distances around mean."""
    same = dict(maze="maze1", reward="dense", method="wedis", mode="printed", look_ahead=600, samples=1000) | same
    rng = np.random.default_rng([ord(letter) for letter in repr(sorted(same.items()))])
    return [same | dict(policy_seed=seed, policy=f"p{seed}", settings=f"{settings}{seed}", trial=trial,
                        final_distance=mean + deviation * rng.normal(), success=int(mean < 5))
            for seed in seeds for trial in range(trials)]


def as_read(rows):
    return [{name: str(value) for name, value in row.items()} for row in rows]


def panels(mean, **same):
    """The rows of all four panels."""
    return [row for maze, kind in report.PANELS for row in planning_rows(mean, maze=maze, reward=kind, **same)]


def policy(experiment, seed=0, **numbers):
    return dict(experiment=experiment, seed=seed, method=experiment.split("_")[1], threads=1, train_minutes=20, updates=9,
                env_steps=9) | numbers


@pytest.fixture
def repo(tmp_path, monkeypatch):
    """An empty place that is shipped to: write(name, rows) puts a file into its results."""
    monkeypatch.setattr(report, "ROOT", tmp_path / "repo")

    def write(name, rows, folder=tmp_path / "repo"):
        common.update_csv(folder / "results" / f"{name}.csv", rows, ())
    return SimpleNamespace(write=write, path=tmp_path / "repo", read=report.results)


# ---------------------------------------------------------------- the same configuration in two files

def disagreements(files):
    """files {name: rows}. Of all configurations in two files those whose 95 % intervals do not overlap; all that were compared."""
    columns, found, wrong, compared = claims.PLANNED[:-1], {}, [], []
    for name, rows in files.items():
        for row in rows:
            found.setdefault(tuple(row[column] for column in columns), {}).setdefault(name, []).append(row)
    for key, cells in found.items():
        for one, two in itertools.combinations(cells, 2):
            compared.append((*key, one, two))
            (low, high), (low2, high2) = (report.interval(report.by_policy(cells[name], "final_distance")) for name in (one, two))
            if low > high2 or low2 > high:
                wrong.append((*key, one, two, f"{low:.2f} .. {high:.2f}, {low2:.2f} .. {high2:.2f}"))
    return wrong, compared


def test_the_same_configuration_in_two_shipped_files_agrees_within_its_intervals():
    wrong, compared = disagreements({name: report.results(name) for name in report.PLANNING})
    of_both = {key[:4] for key in compared if key[5:] == ("10000", "mazes", "figure7")}
    assert of_both == {(*panel, "wedis", mode) for panel in report.PANELS for mode in report.MODES}  # nothing is left out
    assert wrong == []


def test_configurations_that_disagree_are_found():
    one, two = ([*panels(4, mode="closed", trials=n), *panels(9, mode="printed", trials=n)] for n in (50, 20))
    wrong, compared = disagreements(dict(mazes=as_read(one), figure7=as_read(two)))
    assert wrong == [] and len(compared) == 8
    altered = [row | dict(final_distance=row["final_distance"] + 2 * ((row["maze"], row["mode"]) == ("maze2", "closed"))) for row in two]
    wrong, compared = disagreements(dict(mazes=as_read(one), figure7=as_read(altered)))
    assert len(compared) == 8
    assert [key[:4] for key in wrong] == [("maze2", "dense", "wedis", "closed"), ("maze2", "sparse", "wedis", "closed")]
    other = [row | dict(samples=10) for row in altered]
    assert disagreements(dict(mazes=as_read(one), figure7=as_read(other))) == ([], [])  # which the test above would not accept


def test_learning_curves_are_those_of_the_policies():
    curves = report.results("learning_curves")
    for row in report.policy_rows(report.POLICIES):
        own = report.select(curves, experiment=row["experiment"], seed=row["seed"])
        assert own[-1]["updates"] == row["updates"]
        # on the machine of the training they are equal; contacts are chaotic, and another one measures another error
        assert float(own[-1]["tracking_error"]) == pytest.approx(float(row["tracking_error"]), abs=0.06)


def test_intervals_of_seeds_have_the_width_that_theory_gives():
    values = np.random.default_rng(1).normal(size=400)
    low, high = report.interval(values)
    assert (high - low) / 2 == pytest.approx(1.96 * values.std() / 20, rel=0.01)
    assert report.interval(values.reshape(1, -1)) == pytest.approx((low, high))
    apart = np.repeat([[0.0], [10.0]], 200, axis=1)  # two policies that differ, trials that do not
    assert report.interval(apart) == pytest.approx((5 - 12.71 * 5, 5 + 12.71 * 5))


# ---------------------------------------------------------------- shipping

def test_two_folders_are_merged(repo, tmp_path, capsys):
    """Of two machines, over what is shipped already: each row once, a configuration with one setting, the later folder's."""
    a, b = tmp_path / "a", tmp_path / "b"

    def weak(purity, seeds, settings):
        return [dict(experiment="main", seed=seed, labels="main", factor="speed", purity=purity, settings=settings) for seed in seeds]
    repo.write("wetvae", weak(0.1, (1, 4), "old"))
    repo.write("wetvae", weak(0.5, (1, 2), "new"), a)
    repo.write("wetvae", weak(0.8, (2,), "old") + weak(0.9, (2, 3), "new"), b)  # b was run twice
    repo.write("mazes", planning_rows(9, "old", seeds=(0, 1), trials=3) + planning_rows(9, mode="closed", seeds=(0,), trials=3))
    repo.write("mazes", planning_rows(4, "new", seeds=(0,), trials=2), a)
    repo.write("mazes", planning_rows(5, "new", seeds=(1, 2), trials=2), b)
    repo.write("policies", [policy("ant_semi")], a)
    repo.write("policies", [policy("ant_semi", 1), policy("ant_semi", 2)], b)
    repo.write("claims", [dict(claim="of a part", settings="")], a)
    for folder, names in ((a, "policy_ant_semi_seed0 wetvae_main_seed0 wetvae_polar_seed0 policy-checkpoint_ant_semi_seed0"),
                          (b, "policy_ant_semi_seed1 policy_ant_semi_seed2 policy_other_seed0 wetvae_main_seed1 wetvae_full_seed3")):
        for name in names.split():
            (folder / f"{name}.pt").write_bytes(b"x")
    (a / "figures").mkdir()
    for name in ("fig05.png", "maze1.gif", "dataset_full.png"):
        (a / "figures" / name).write_bytes(b"x")
    report.ship(a, b)
    without = [line for line in capsys.readouterr().out.splitlines() if "is shipped without" in line]
    assert len(without) == 1 and without[0].startswith("policy_ant_semi_seed2.pt is shipped without wetvae_main_seed2.pt")
    assert {row["seed"]: row["purity"] for row in repo.read("wetvae")} == {"1": "0.5", "2": "0.9", "3": "0.9", "4": "0.1"}
    assert len(repo.read("wetvae")) == 4
    found = report.planned("mazes", "mode", "policy_seed", "settings")
    assert {key: len(rows) for key, rows in found.items()} == {
        ("closed", "0", "s0"): 3, ("printed", "0", "new0"): 2, ("printed", "1", "new1"): 2, ("printed", "2", "new2"): 2}
    assert [row["seed"] for row in report.policy_rows(["ant_semi"])] == ["0", "1", "2"]
    shipped = {path.name for folder in ("figures", "pretrained", "results") for path in (repo.path / folder).iterdir()}
    assert shipped == {
        "fig05.png", "maze1.gif", *(f"policy_ant_semi_seed{seed}.pt" for seed in (0, 1, 2)), "wetvae_main_seed0.pt",
        "wetvae_main_seed1.pt", "wetvae_full_seed3.pt", "wetvae.csv", "mazes.csv", "policies.csv"}  # claims are made from the merged rows


# ---------------------------------------------------------------- tables

@pytest.mark.parametrize("name", report.TABLES | {title: None for title, _, _ in report.SECTIONS})
def test_a_table_without_rows_is_one_sentence(name, monkeypatch):
    monkeypatch.setattr(report, "results", lambda name: [])
    make = report.TABLES.get(name) or next(table for title, _, table in report.SECTIONS if title == name)
    lines = [line for line in make() if line and not line.startswith("![")]
    if name not in ("map", "scripts", "claims", "gifs", "All figures"):
        line, = lines
        assert report.NOT_YET in line


def test_tables_with_some_of_the_rows(repo):
    repo.write("mazes", panels(0.8, mode="closed", samples=10_000, trials=4) + planning_rows(9, trials=4, samples=10_000)
               + planning_rows(7, samples=1000))
    lines = report.mazes()
    cells = [line.strip("| ").split(" | ") for line in lines[2:6]]
    assert cells[0][2].endswith(" m, 0 %") and cells[0][3] == "-" and cells[0][4].endswith(" m, 100 %")
    assert [row[2] for row in cells[1:]] == ["-"] * 3
    assert "N = 10,000" in lines[-1] and "3 policies x 4 trials" in lines[-1]
    assert "26.8 m from the goal" in lines[-1] and "36.4 m long" in lines[-1]
    repo.write("figure7", panels(9) + panels(4, mode="commands") + planning_rows(20, method="dads", look_ahead=240))
    lines = report.fig7()
    assert [line.split(",")[0] for line in lines[2:5]] == ["| WEDIS", "| WEDIS", "| DADS"]
    assert lines[4].count("| - ") == 3 and "(not counted: not measured yet)" in lines[4]
    assert any(line.startswith("*Not measured yet: WEDIS, closed loop; WEDIS-S, as printed; WEDIS-S, commands;") for line in lines)
    for title, _, make in report.SECTIONS:
        assert make(), title
    repo.write("policies", [policy("ant_semi", 0, tracking_error=0.15), policy("ant_dads", 0)])  # columns of older rows
    for make in (report.fig5, report.baselines, report.full_policies, report.claims):
        assert make()


def test_a_policy_has_open_and_closed_loop_side_by_side(repo):
    repo.write("policies", [
        policy("ant_semi", tracking_error=0.154, tracking_error_closed=0.036, fall_rate_open=0.011, fall_rate=0.004,
               follow_decoder_m_open=1.2, speed_m_per_step_open=0.0651, speed_m_per_step=0.066, purity_speed_open=0.7,
               purity_speed=0.9), policy("ant_dads", tracking_error=0.3, train_minutes=21)])
    head, row = (report.fig5()[line].split(" | ") for line in (0, 2))
    found = dict(zip(head, row))
    assert found["tracking error"] == "0.15 / 0.04" and found["falls, %"] == "1.1 / 0.4"
    assert found["from the end of one run of the decoder (as printed), median m"] == "1.20" and found["speed, m a step"] == "0.065 / 0.066"
    assert found["purity, speed |"] == "0.70 / 0.90 |"
    assert dict(zip(*(report.baselines()[line].split(" | ") for line in (0, 2))))["minutes / WEDIS's"] == "1.05"


@pytest.mark.parametrize("numbers, why", [
    (dict(speed_m_per_step_open=0.1, fall_rate_open=0.05), ""), (dict(speed_m_per_step_open=0.06, fall_rate_open=0.0), "no faster"),
    (dict(speed_m_per_step_open=0.1, fall_rate_open=0.1), "turn over"), (dict(fall_rate_open=0.0), report.NOT_YET)])
def test_dads_counts_if_it_moves_and_stands(repo, numbers, why):
    repo.write("policies", [policy("ant_semi", speed_m_per_step_open=0.065), policy("ant_dads", tracking_error=0.3, **numbers)])
    assert (why in report.why_not("dads")) and (why == "") == (report.why_not("dads") == "")
    assert report.why_not("wedis_s") == ""
    assert ("| yes |" in report.baselines()[2]) == (why == "")


def test_sectar_counts_if_it_is_followed(repo):
    repo.write("policies", [policy("ant_sectar", seed, tracking_error=error) for seed, error in enumerate((0.9, 0.4))])
    assert report.why_not("sectar") == ""
    repo.write("policies", [policy("ant_sectar", seed, tracking_error=error) for seed, error in enumerate((0.9, 0.6))])
    assert "0.75" in report.why_not("sectar") and "0.75" in report.baselines()[2]


def test_a_claim_about_the_model_is_judged_over_its_seeds(repo):
    assert report.over_seeds([]) == report.NOT_YET
    assert report.over_seeds([1] * 10) == "holds (10 of 10 seeds)"
    assert report.over_seeds([1] * 8 + [0] * 2) == "undecided (8 of 10 seeds)"
    assert report.over_seeds([1] * 2 + [0] * 8) == "does not hold (2 of 10 seeds)"
    assert report.over_seeds([1]) == "undecided (1 of 1 seeds)"
    repo.write("wetvae", [dict(experiment="seeds", seed=seed, labels=labels, factor=factor, largest_gap_deg="", settings="s",
                               purity="nan" if (labels, seed, factor) == ("none", 3, "direction") else 0.5 if labels == "none" else 0.9,
                               crosstalk="speed 0.7, direction 0.7")
                          for labels in ("seeds", "none") for seed in range(10) for factor in ("speed", "direction")])
    found = {claim: (verdict, text) for claim, verdict, text in report.skill_claims()}
    assert found["the three factors are suitably disentangled (Fig 4)"][0] == "holds (10 of 10 seeds)"
    assert found["... and one axis is unused"][0] == "does not hold (1 of 10 seeds)"
    assert found["... with Eq. 4 as printed"] == (report.NOT_YET, report.NOT_YET)
    assert "| WEDIS" not in report.fig4()[2] and "0.90 (70 %)" in report.fig4()[2]


@pytest.mark.parametrize("found, verdict, text", [
    ((28.4, 30.5), "undecided (3 of 4 models)", "three factors 28.4, 30.5; two (Fig 11) 13.5; four (Fig 13) 0.3"),
    ((0.2, 4.9, 6), "does not hold (2 of 5 models)", "three factors 0.2, 4.9, 6.0; two (Fig 11) 13.5; four (Fig 13) 0.3")])
def test_empty_angles_are_those_of_all_models_on_the_full_circle(repo, found, verdict, text):
    same = dict(factor="direction", purity=0.9, crosstalk="direction 0.7", settings="s", range_low=-150, range_high=130)
    repo.write("wetvae", [dict(experiment=name, labels=labels, seed=seed, largest_gap_deg=gap) | same for name, labels, gaps in (
        ("polar", "polar", [13.5]), ("polar", "none", [99]), ("full", "full", found), ("four_factors", "four_factors", [0.3]))
        for seed, gap in enumerate(gaps)])
    (_, word, said), = [row for row in report.skill_claims() if row[0] == "empty angles on the full circle (A.3.1)"]
    assert word == verdict and said == (f"largest gap, degrees (a gap: above 5), for z from -3 to 3: {text}; for z "
                                        "from -1.5 to 1.5, as drawn, 80 to 80")


# ---------------------------------------------------------------- claims

def test_claims_are_judged_by_the_interval_of_the_difference(s4):
    rows = as_read(planning_rows(3) + planning_rows(6, method="wedis_s", look_ahead=160) + planning_rows(3.1, method="wedis_nts", deviation=4)
                   + planning_rows(1, method="dads", look_ahead=240) + planning_rows(3.5, mode="commands")
                   + planning_rows(6.5, mode="commands", method="wedis_s", look_ahead=160)
                   + planning_rows(20, method="nothing"))
    found = {(row["claim"], row["mode"], row["better"], row["worse"]): row for row in claims.comparisons(rows, s4)}
    best, s_dads = "WEDIS shows the outstanding results for all the cases", "WEDIS-S outperforms DADS"
    verdicts = {key: (row["verdict"], row["against"]) for key, row in found.items() if key[0] in (best, s_dads)}
    assert verdicts == {
        (best, "printed", "wedis", "wedis_s"): ("holds", "ablations"), (best, "printed", "wedis", "wedis_nts"): ("undecided", "ablations"),
        (best, "printed", "wedis", "dads"): ("does not hold", "rivals"), (best, "commands", "wedis", "wedis_s"): ("holds", "ablations"),
        (best, "commands", "wedis", "dads"): ("does not hold", "rivals"),  # a rival has one mode
        (s_dads, "printed", "wedis_s", "dads"): ("does not hold", "rivals"),
        (s_dads, "commands", "wedis_s", "dads"): ("does not hold", "rivals")}
    row = found[best, "printed", "wedis", "wedis_s"]
    assert row["difference"] == pytest.approx(3, abs=0.5) and row["low"] < row["difference"] < row["high"]
    few = as_read(planning_rows(3, seeds=(0,), trials=50) + planning_rows(6, method="wedis_s"))  # one policy beside three
    (row,) = claims.comparisons(few, s4, {best: claims.CLAIMS[best]})
    assert row["verdict"] == "holds" and (row["better_policies"], row["worse_policies"]) == (1, 3)
    again = claims.comparisons(as_read(planning_rows(99, "older")) + rows, s4)
    assert [row["difference"] for row in again] == [row["difference"] for row in found.values()]  # the settings written last
    assert claims.in_words(["holds"] * 3) == "holds (3 of 3 hold)"
    assert claims.in_words(["holds", "undecided"]) == "undecided (1 of 2 hold)"
    assert claims.in_words(["holds", "undecided", "does not hold"]) == "does not hold (1 of 3 hold, 1 do not)"


def test_equal_look_ahead_compares_what_looks_equally_far(s4):
    rows = as_read([row for method, near, far in (("wedis", 9, 3), ("wedis_s", 9.1, 6)) for ahead, mean in ((200, near), (600, far))
                    for row in planning_rows(mean, method=method, look_ahead=ahead)] + planning_rows(20, method="wedis_nts", look_ahead=80))
    found = claims.comparisons(rows, s4, claims.EQUAL, equal=True)
    assert [(row["look_ahead"], row["worse"], row["verdict"]) for row in found] == [
        ("200", "wedis_s", "undecided"), ("600", "wedis_s", "holds")]


def test_claims_and_table_2_are_written_and_read(s4, repo, tmp_path, monkeypatch):
    monkeypatch.setattr(s4.common, "HERE", tmp_path)  # no policy is needed
    with pytest.raises(SystemExit):
        claims.main(s4, ["--out", str(repo.path)])
    repo.write("figure7", panels(3) + panels(6, method="wedis_s") + panels(9, method="dads") + panels(12, method="sectar"))
    repo.write("policies", [policy("ant_semi", speed_m_per_step_open=0.065), policy("ant_sectar", tracking_error=0.9),
                            policy("ant_dads", speed_m_per_step_open=0.1, fall_rate_open=0.01)])
    repo.write("claims", [dict(claim="an old one", verdict="holds")])
    claims.main(s4, ["--out", str(repo.path)])
    rows = {tuple(row[:2]): row[2:] for row in report.planning_claims()}
    best = "WEDIS shows the outstanding results for all the cases"
    assert rows[best, "rivals"] == ["holds (4 of 4 hold)", "-"] and rows[best, "ablations"] == ["holds (4 of 4 hold)", "-"]
    assert rows["SeCTAR has poor performance", "rivals"] == ["not counted (12 of 12 hold)", "-"]
    assert "an old one" not in str(rows)
    assert "Not counted: `ant_sectar` (tracking error 0.90" in "".join(report.full_claims())
    assert len(report.full_claims()) == 2 + len(repo.read("claims")) + 2
    table = {row["method"]: row for row in repo.read("table2")}
    assert (table["wedis"]["skills_dense"], table["wedis"]["skills_sparse"]) == ("3", "3")
    assert (table["wedis_s"]["skills_dense"], table["wedis_s"]["skills_sparse"]) == ("4", "15")
    assert (table["wedis_s"]["slowest_speed"], table["sectar"]["slowest_speed"]) == ("0", "-1.5")


# ---------------------------------------------------------------- ablations

def test_departures_of_the_planner(tmp_path, monkeypatch, s4):
    """As shipped is what 04 does; each edit finds its text once, and changes what is planned."""
    source = (ROOT / "04_mpc_maze.py").read_text(encoding="utf-8")
    assert all(source.count(old) == 1 for _, edits in ablations.PLANNERS.values() for old, _ in edits)
    monkeypatch.setattr(ablations, "ROOT", tmp_path)
    monkeypatch.setitem(ablations.PLANNERS, "pool", ("--pool 64", []))  # quicker
    (tmp_path / "04_mpc_maze.py").write_text(source, encoding="utf-8")
    flags = "--policy_seeds 0 --mazes maze1 --rewards dense --modes closed --draw fig06 --samples 10 --trials 3 --threads 1"
    ablations.planners(ROOT / "pretrained", flags + " --episode 150 --hold 10")
    found = {row["planner"]: float(row["distance_m"]) for row in common.read_csv(tmp_path / "results/planner.csv")}
    c, policy, _ = s4.check(*common.parse_flags(vars(s4), ["--out", str(tmp_path), *flags.split(), "--episode", "150", "--hold", "10"]))[0]
    poses, _ = s4.plan_and_execute(c, policy)
    assert found["as_shipped"] == pytest.approx(np.linalg.norm(poses[-1, :, :2] - c.goal, axis=1).mean(), rel=1e-4)
    assert len(set(found.values())) == len(ablations.PLANNERS)
    rows = common.read_csv(tmp_path / "results/planner.csv")
    assert ablations.planner_table(rows)[2].startswith("| as_shipped | - | ") and len(ablations.planner_table(rows)) == 7
    assert ablations.planner_effect("radius", rows) == ablations.NOT_YET  # Maze 2 is not there
    rows += [row | dict(maze="maze2", distance_m="7.04") for row in rows]
    assert ablations.effect("radius", lambda name: rows) == f"{found['radius']:.1f} and 7.0 m"


def ablation(name, seed, **numbers):
    return {"without": name, "seed": seed} | dict.fromkeys(ablations.MEASURES, 0.5) | numbers


def test_the_effect_of_a_departure_is_four_measures_of_its_seeds(repo):
    assert ablations.effect("discount", report.results) == ablations.NOT_YET
    repo.write("ablations", [ablation("discount", 7)])
    assert "missing" in ablations.table(repo.read("ablations"))[2]  # there is nothing to compare it with
    repo.write("ablations", [ablation("shipped", 0, tracking_error=0.14), ablation("shipped", 1, tracking_error=0.18),
                             ablation("discount", 0, tracking_error=0.4, fall_rate=0.501, maze1_distance_m=7),
                             ablation("discount", 1, tracking_error=0.5, maze1_distance_m=8), ablation("rate", 1, tracking_error=0.19)])
    same = ablation("shipped", 0)
    closed, falls, away = same["tracking_error_closed"], 100 * same["fall_rate"], same["maze1_distance_m"]
    text = f"0.45 / {closed:.2f}, {(50.1 + falls) / 2:.0f} %, 7.5 m"
    assert ablations.effect("discount", report.results) == text
    rest = f"/ {closed:.2f}, {falls:.0f} %, {away:.1f} m"
    assert ablations.effect("rate", report.results) == f"seed 1: 0.19 {rest}"
    assert ablations.effect("shipped", report.results) == f"seed 0: 0.14 {rest}; seed 1: 0.18 {rest}"
    assert ablations.effect("unheard", report.results) == ablations.NOT_YET
    lines = ablations.table(repo.read("ablations"))
    assert len({line.count("|") for line in lines}) == 1 and lines[2].startswith("| `shipped` | - | 2 | 0.16 |")
    assert "| 0.45 (+7.3) |" in lines[3] and "| 0.19 (+0.3) |" in lines[4]  # beside the same seed of shipped
    made = report.made("| discount | <!-- without discount -->old<!-- / --> | 0.99 |")
    assert made == f"| discount | <!-- without discount -->{text}<!-- / --> | 0.99 |"


def test_each_ablation_says_with_which_flags_and_edits_it_is_trained(s3, tmp_path):
    names = {row["without"] for row in common.read_csv(ROOT / "results" / "ablations.csv")}
    source = (ROOT / "03_train_policy.py").read_text(encoding="utf-8")
    assert names == set(ablations.SET_BACK)
    for name, flags in ablations.SET_BACK.items():
        assert flags or ablations.EDITS.get(name) or name == "shipped"
        assert all(source.count(old) == 1 for old, _ in ablations.EDITS.get(name, []))
        before = {key: value for key, value in vars(s3).items() if key.isupper()}
        config, given = common.parse_flags(vars(s3), [*flags.split(), "--out", str(tmp_path)])
        assert all(config[key] == vars(s3)[key] != before[key] for key in given)
        vars(s3).update(before)


def test_the_effect_of_a_full_training_is_compared_with_the_same_seeds(repo):
    assert ablations.full_effect("rate", report.results) == ablations.NOT_YET
    row = dict(tracking_error=0.2, tracking_error_closed=0.1, fall_rate=0.02)
    repo.write("full_trainings", [dict(without="rate", loop="as shipped", seed=1) | row, dict(without="rate", loop="an earlier one", seed=2) | row]
               + [dict(without="floor", loop="as shipped", seed=seed) | row | dict(fall_rate=falls) for seed, falls in ((0, 0), (1, 0.06))])
    assert ablations.full_effect("rate", report.results) == ablations.NOT_YET  # nothing to compare it with
    policies = [dict(experiment="ant_semi", seed=seed) | row | dict(tracking_error=error) for seed, error in ((0, 0.6), (1, 0.05))]
    repo.write("policies", [*policies, dict(experiment="ant_world_frame", seed=0) | row | dict(tracking_error=0.3)])
    assert ablations.full_effect("rate", report.results) == "0.20 / 0.10, 2.0 % instead of 0.05 / 0.10, 2.0 %"
    assert ablations.full_effect("floor", report.results).startswith("0.20 / 0.10, 3.0 % instead of ")  # the mean of its seeds
    assert ablations.full_effect("base_frame", report.results) == "0.30 / 0.10, 2.0 % instead of 0.60 / 0.10, 2.0 %"
    assert report.made("<!-- full rate -->old<!-- / -->") == "<!-- full rate -->0.20 / 0.10, 2.0 % instead of 0.05 / 0.10, 2.0 %<!-- / -->"


def test_the_effect_of_a_departure_of_the_model_is_its_worst_seed(repo):
    rows = [dict(experiment="seeds", labels=labels, seed=seed, factor="speed", purity=purity) for labels, purity in (
        ("seeds", 0.9), ("warm_up", 0.5)) for seed in range(10)]
    repo.write("wetvae", rows)
    assert ablations.effect("own_axis", report.results) == "worst purity of 10 seeds: 0.50 instead of 0.90"
    assert ablations.effect("beta_warm_up", report.results) == ablations.NOT_YET


def test_ablations_are_measured_once(out, tmp_path, monkeypatch, capsys, s3, s4, inside):
    """Of a tiny policy: a row with all measures; a second run measures nothing."""
    folder = tmp_path / "abl" / "discount_s0"
    folder.mkdir(parents=True)
    (folder / "wetvae_main_seed0.pt").write_bytes((out / "wetvae_main_seed0.pt").read_bytes())
    assert inside(s3, *tiny(folder)).returncode == 0
    monkeypatch.setattr(ablations, "ROOT", tmp_path)
    monkeypatch.setitem(sys.modules, "03_train_policy", s3)
    monkeypatch.setitem(sys.modules, "04_mpc_maze", s4)
    monkeypatch.setattr(s3, "STARTS", 4)
    monkeypatch.setattr(s4, "POOL", 64)
    ablations.main(tmp_path / "abl")
    row, = common.read_csv(tmp_path / "results" / "ablations.csv")
    assert (row["without"], row["seed"]) == ("discount", "0") and set(ablations.MEASURES) <= set(row)
    assert all(np.isfinite(float(row[name])) for name in ablations.MEASURES)
    capsys.readouterr()
    ablations.main(tmp_path / "abl")
    assert "already" in capsys.readouterr().out
    assert common.read_csv(tmp_path / "results" / "ablations.csv") == [row]


def test_parts_of_the_closed_loop(out, tmp_path, monkeypatch, s3, inside):
    """Without feedback it is the open loop; as shipped, what 03 measures; what was changed is put back."""
    assert inside(s3, *tiny(out, hidden=64)).returncode == 0
    law = common.closed_loop
    monkeypatch.setattr(ablations, "ROOT", tmp_path)
    monkeypatch.setattr(common, "FEEDBACK", 1.0)  # four steps are few: with less no limit is reached
    vars(s3).update(STARTS=4, NOISY=2, TRAVERSAL=3, SINGLE_RUN=(1, 4), MULTI_RUN=(2, 2))
    ablations.closed_loops(s3, out, [0])
    rows = {row["loop"]: row for row in common.read_csv(tmp_path / "results/closed_loop.csv")}
    policy, error = load_policy(out, "ant_semi", 0), "tracking_error_closed"
    assert float(rows["no feedback"][error]) == pytest.approx(s3.tracking(policy, False), rel=1e-4)
    assert float(rows["as shipped"][error]) == pytest.approx(s3.tracking(policy, True), rel=1e-4)
    assert len({row[error] for row in rows.values()}) > 3 and common.closed_loop is law
    assert ablations.closed_table(list(rows.values()))[2].startswith("| as shipped | ")
