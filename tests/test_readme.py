"""README.md and results/README.md are what tests/report.py makes of results/*.csv and of the scripts; sizes and links."""
import hashlib
import re

import common
import numpy as np
import pytest
import report
from conftest import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
LINES = {"01_make_dataset.py": 130, "02_train_wetvae.py": 380, "03_train_policy.py": 650, "04_mpc_maze.py": 480, "common.py": 450}
RESULTS = sorted((ROOT / "results").glob("*.csv"))
ARTIFACTS = sorted((ROOT / "pretrained").glob("*.pt"))


def test_readme_is_as_made():
    assert report.made(README) == README, "run: python tests/report.py"


def test_results_readme_is_as_made():
    assert report.results_readme() == (ROOT / "results" / "README.md").read_text(encoding="utf-8"), "run: python tests/report.py"


def test_every_table_is_in_the_readme():
    assert sorted(name for _, name, _, _ in report.BLOCK.findall(README)) == sorted(report.TABLES)


def test_readme_is_short():
    assert len(README.encode()) <= 16_000


@pytest.mark.parametrize("file", LINES)
def test_script_is_short(file):
    assert len((ROOT / file).read_text(encoding="utf-8").splitlines()) <= LINES[file]


@pytest.mark.parametrize("file", LINES)
def test_no_line_is_wide(file):
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    assert [n for n, line in enumerate(lines, 1) if len(line) > 110] == []


def test_scripts_together_are_short():
    assert sum((ROOT / file).stat().st_size for file in LINES) <= 115_000


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
    assert kind == "wetvae" or content["updates"] == int(
        report.select(report.results("policies"), experiment=experiment, seed=seed)[0]["updates"])


def test_planning_rows_are_of_the_shipped_policies():
    shipped = {hashlib.sha256(path.read_bytes()[:-32]).hexdigest()[:8] for path in ARTIFACTS}
    for name in ("mazes", "figure7", "fig18", "matched"):
        assert {row["policy"] for row in report.results(name)} <= shipped, name


def test_learning_curves_are_those_of_the_policies():
    curves = report.results("learning_curves")
    for row in report.policy_rows(report.POLICIES):
        own = report.select(curves, experiment=row["experiment"], seed=row["seed"])
        assert own[-1]["updates"] == row["updates"]
        assert float(own[-1]["tracking_error"]) == pytest.approx(float(row["tracking_error"]), rel=1e-4)


def test_bootstrap_interval_has_the_width_that_theory_gives():
    values = np.random.default_rng(1).normal(size=400)
    low, high = report.interval(values)
    assert (high - low) / 2 == pytest.approx(1.96 * values.std() / 20, rel=0.05)
    one_policy = report.interval(values.reshape(1, -1))
    assert one_policy == pytest.approx((low, high), abs=0.02)
    apart = np.repeat([[0.0], [10.0]], 200, axis=1)  # two policies that differ, trials that do not
    assert report.interval(apart) == pytest.approx((0, 10))


def test_shipping_merges_rows_by_their_keys(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "ROOT", tmp_path / "repo")
    runs = tmp_path / "runs"
    for folder, purity in ((tmp_path / "repo", "0.1"), (runs, "0.9")):
        rows = [dict(experiment="main", seed=seed, labels="main", factor="speed", purity=purity)
                for seed in ((0, 1) if folder == runs else (1, 2))]
        common.update_csv(folder / "results" / "wetvae.csv", rows, report.KEYS["wetvae"])
    for name in ("policy_a_seed0", "policy-checkpoint_a_seed0", "wetvae_main_seed0", "wetvae_polar_seed0"):
        (runs / f"{name}.pt").write_bytes(b"x")
    (runs / "figures").mkdir()
    for name in ("fig05.png", "maze1.gif", "dataset_full.png"):
        (runs / "figures" / name).write_bytes(b"x")
    report.ship(runs)
    assert {row["seed"]: row["purity"] for row in report.results("wetvae")} == {"0": "0.9", "1": "0.9", "2": "0.1"}
    shipped = {path.name for folder in ("figures", "pretrained") for path in (tmp_path / "repo" / folder).iterdir()}
    assert shipped == {"fig05.png", "maze1.gif", "wetvae_main_seed0.pt"}  # the policy has no row yet


@pytest.mark.parametrize("name", report.TABLES | {title: None for title, _, _ in report.SECTIONS})
def test_a_table_without_rows_is_one_sentence(name, monkeypatch):
    monkeypatch.setattr(report, "results", lambda name: [])
    make = report.TABLES.get(name) or next(table for title, _, table in report.SECTIONS if title == name)
    lines = [line for line in make() if line]
    if name not in ("map", "scripts", "claims", "gifs", "All figures"):
        line, = lines
        assert report.NOT_YET in line
