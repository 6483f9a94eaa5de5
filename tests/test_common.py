"""Command line, artifacts and CSV of all stages. The networks and robots in common.py are tested with stage 3."""
import multiprocessing
import os
import pickle
import runpy

import common
import numpy as np
import pytest
import torch
from conftest import ROOT, S1, S2, S3, S4

# ---------------------------------------------------------------- the five scripts

@pytest.mark.parametrize("name", [S1, S2, S3, S4, "common"])
def test_scripts_are_ascii_in_lines_of_at_most_110(name):
    text = (ROOT / f"{name}.py").read_bytes()
    text.decode("ascii")  # or Python in a C locale would have to guess
    assert [n for n, line in enumerate(text.splitlines(), 1) if len(line) > 110] == []


# ---------------------------------------------------------------- command line

FILE = '''"""A stage."""
EXPERIMENT = "plain"  # row
SEED = 0              # random seed
OUT = {out!r}         # folder
N = 1e4               # how many, 50 % of all
SHARE = 1.0           # a share
FLAG = False          # a switch
START = (0.0, 1.5)    # x and y
WORDS = "a b"         # words
EXPERIMENTS = {{"plain": {{}}, "other": dict(N=7, SHARE=2), "typo": dict(SHRE=1), "bad": dict(N=2.5),
               "minus": dict(N="-1")}}
'''


@pytest.fixture
def flags(tmp_path, capsys):
    """flags(*argv) -> constants of a small stage after parse_flags, what it returns, stderr if it ended."""
    path = tmp_path / "stage.py"
    path.write_text(FILE.format(out=str(tmp_path)))

    def parse(*argv):
        stage = runpy.run_path(str(path)) | dict(__file__=str(path))
        try:
            return stage, *common.parse_flags(stage, list(argv))
        except SystemExit as end:
            assert end.code == 2
            return capsys.readouterr().err
    return parse


def test_a_tuple_in_a_row_may_be_a_list_and_have_no_points():
    assert common.convert([5, 40], (1, 100), "--run") == (5, 40) and common.convert((24, 12), (1.0, 2.0), "x") == (24, 12)
    assert common.convert("-5 3.5", (24, 12), "--goal") == (-5, 3.5)


def test_a_tuple_of_words_is_one_line_without_a_bound(capsys):
    with pytest.raises(SystemExit):
        common.convert("a b", (1, 100), "--run")
    assert capsys.readouterr().err.endswith("--run is 'a', but must be a whole number, like 1 in the file\n")


def test_flags_override_rows_and_rows_override_constants(flags):
    stage, config, given = flags()
    assert (stage["N"], type(stage["N"]), stage["SHARE"], given) == (10_000, int, 1.0, {})  # 1e4 means ten thousand
    stage, config, given = flags("--experiment", "other", "--share", "3", "--flag", "True", "--start", "-1 2")
    assert (stage["N"], stage["SHARE"], stage["FLAG"], stage["START"]) == (7, 3.0, True, (-1.0, 2.0))
    assert given == dict(EXPERIMENT="other", SHARE=3.0, FLAG=True, START=(-1.0, 2.0))
    assert config == {name: stage[name] for name in "EXPERIMENT SEED OUT N SHARE FLAG START WORDS".split()}


@pytest.mark.parametrize("text, value", [("512 / 2", 256), ("2e3", 2000), ("7", 7), ("2.0", 2.0), ("1 / 4", 0.25)])
def test_whole_numbers_written_without_a_point_are_whole(tmp_path, text, value):
    path = tmp_path / "stage.py"
    path.write_text(FILE.format(out=str(tmp_path)).replace("N = 1e4 ", f"N = {text} "))
    stage = runpy.run_path(str(path)) | dict(__file__=str(path))
    common.parse_flags(stage, [])
    assert stage["N"] == value and type(stage["N"]) is type(value)


@pytest.mark.parametrize("argv, message", [
    ("--nonsense 1", "unrecognized arguments: --nonsense 1; see --help"),
    ("surplus", "unrecognized arguments: surplus; see --help"),
    ("--shar 1", "unrecognized arguments: --shar 1; see --help"), ("--n many", "--n is 'many', but must be a whole number"),
    ("--n 2.5", "--n is '2.5', but must be a whole number"),
    ("--n -1", "--n is '-1', but must be a whole number of at least 1"), ("--n 0", "--n is '0', but must be a whole number of"),
    ("--seed -1", "--seed is '-1', but must be a whole number of at least 0"),
    ("--share -0.5", "--share is '-0.5', but must be a number of at least 0"), ("--share nan", "--share is 'nan'"),
    ("--share inf", "--share is 'inf'"), ("--flag maybe", "--flag is 'maybe', but must be true or false"),
    ("--start 1", "--start is '1', but must be 2 numbers"), ("--start a b", "--start is 'a', but must be a number"),
    ("--n", "--n: expected one argument; see --help"),
    ("--experiment nope", "unknown experiment 'nope'; allowed: plain other typo bad minus"),
    ("--experiment typo", "SHRE in the row 'typo' of EXPERIMENTS is no constant"),
    ("--experiment bad", "--n is 2.5, but must be a whole number"),
    ("--experiment minus", "--n is '-1', but must be a whole number of at least 1")])
def test_what_is_wrong_on_the_command_line_is_one_line(flags, argv, message):
    error = flags(*argv.split(maxsplit=1))
    assert message in error and len(error.splitlines()) == 1


def test_help_prints_each_constant_with_its_comment(flags, capsys):
    with pytest.raises(AssertionError):  # it ends with 0
        flags("--help")
    assert "--n int how many, 50 % of all [10000]" in " ".join(capsys.readouterr().out.split())


# ---------------------------------------------------------------- artifacts

def test_artifacts_come_back_as_they_went_and_own_ones_before_shipped_ones(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(common, "HERE", tmp_path / "repo")
    common.save(tmp_path / "repo/pretrained", "policy", "x", 3, dict(A=1), w=torch.arange(4.0), curve=[dict(a=1.5)])
    common.save(tmp_path / "runs", "dataset", "x", 3, dict(A=1), t=np.eye(2), names=np.array(["speed"]))
    policy, dataset = (common.load(tmp_path / "runs", kind, "x", 3) for kind in ("policy", "dataset"))
    assert torch.equal(policy["w"], torch.arange(4.0)) and policy["curve"] == [dict(a=1.5)]
    assert policy["config"] == dict(A=1)
    assert np.array_equal(dataset["t"], np.eye(2)) and dataset["versions"]["numpy"] == np.__version__
    assert "using pretrained/policy_x_seed3.pt" in capsys.readouterr().out.replace(os.sep, "/")
    common.save(tmp_path / "runs", "policy", "x", 3, {}, v=2)
    assert common.load(tmp_path / "runs", "policy", "x", 3)["v"] == 2
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == ["dataset_x_seed3.npz", "policy_x_seed3.pt"]


@pytest.mark.parametrize("kind", ["dataset", "policy"])
@pytest.mark.parametrize("damage", ["missing", "cut", "byte", "foreign", "foreign archive", "empty", "seed", "kind",
                                    "format", "nan"])
def test_damaged_artifacts_are_refused_in_one_line(kind, damage, tmp_path, capsys, monkeypatch):
    make = np.ones if kind == "dataset" else torch.ones
    if damage == "format":
        monkeypatch.setattr(common, "FORMAT", 0)
    other = dict(dataset="dataset", policy="wetvae")[kind] if damage == "kind" else kind
    values = make(50) * (float("nan") if damage == "nan" else 1)
    path = common.save(tmp_path, other, "y" if damage == "kind" else "x", 5 if damage == "seed" else 0, {}, v=values)
    monkeypatch.undo()
    path = path.rename(path.with_name(common.artifact_name(kind, "x", 0)))
    data = bytearray(path.read_bytes())
    if damage == "byte":
        data[len(data) // 2] ^= 1
    elif damage == "foreign archive":  # a sound file of numpy or torch that is none of ours
        with open(path, "wb") as file:
            np.savez(file, v=np.ones(3)) if kind == "dataset" else torch.save(dict(v=1), file)
        data = path.read_bytes()
    path.write_bytes(dict(cut=data[:len(data) // 2], foreign=b"not an archive", empty=b"").get(damage, data))
    if damage == "missing":
        path.unlink()
    with pytest.raises(SystemExit) as end:
        common.load(tmp_path, kind, "x", 0)
    error = capsys.readouterr().err
    assert end.value.code == 2 and len(error.splitlines()) == 1 and path.name in error
    assert f"make it with: python {common.SCRIPT[kind]} --seed 0 --experiment x" in error


def test_every_damage_is_found(tmp_path, capsys):
    """100 seeded damages: a flipped bit, a truncation or bytes in exchange, at any place."""
    path = common.save(tmp_path, "policy", "x", 0, {}, v=torch.randn(50), rows=[dict(a=1.5)])
    original, rng = path.read_bytes(), np.random.default_rng(0)
    for case in range(100):
        data, at, other = bytearray(original), *map(int, rng.integers(len(original) - 1, size=2))
        if case % 3 == 0:
            data[at] ^= 1 << int(rng.integers(8))
        elif case % 3 == 1:
            data = data[:at]
        else:
            data[at], data[other] = data[other], data[at] ^ 1
        path.write_bytes(data)
        with pytest.raises(SystemExit) as end:
            common.load(tmp_path, "policy", "x", 0)
        assert end.value.code == 2 and len(capsys.readouterr().err.splitlines()) == 1


def test_a_pickle_in_disguise_is_not_executed(tmp_path):
    class Evil:
        def __reduce__(self):
            return exec, (f"open({str(tmp_path / 'owned')!r}, 'w')",)
    torch.save(Evil(), tmp_path / "policy_x_seed0.pt")
    (tmp_path / "dataset_x_seed0.npz").write_bytes(pickle.dumps(Evil()))
    for kind in ("policy", "dataset"):
        data = (tmp_path / common.artifact_name(kind, "x", 0)).read_bytes()
        (tmp_path / common.artifact_name(kind, "x", 0)).write_bytes(data + common.hashlib.sha256(data).digest())
        with pytest.raises((SystemExit, pickle.UnpicklingError, ValueError)):
            common.load(tmp_path, kind, "x", 0)
    assert not (tmp_path / "owned").exists()


def test_a_write_that_fails_is_one_line_and_leaves_the_old_artifact(tmp_path, monkeypatch, capsys):
    common.save(tmp_path, "policy", "x", 0, {}, v=1)

    def full(*_):
        raise OSError(28, "No space left on device")
    monkeypatch.setattr(common.os, "fsync", full)
    with pytest.raises(SystemExit) as end:
        common.save(tmp_path, "policy", "x", 0, {}, v=2)
    assert end.value.code == 1 and capsys.readouterr().err.count("\n") == 1
    assert common.load(tmp_path, "policy", "x", 0)["v"] == 1
    assert [path.name for path in tmp_path.iterdir()] == ["policy_x_seed0.pt"]


SHIPPED = sorted((ROOT / "pretrained").glob("*.pt"))


@pytest.mark.parametrize("path", SHIPPED, ids=[path.stem for path in SHIPPED])
def test_every_shipped_artifact_loads(path, tmp_path):
    kind, _, rest = path.stem.partition("_")
    experiment, _, seed = rest.rpartition("_seed")
    content = common.load(tmp_path, kind, experiment, int(seed))
    assert isinstance(content["decoder"], common.Decoder) and (kind == "wetvae" or isinstance(content["actor"], common.Actor))


# ---------------------------------------------------------------- CSV, and many processes

def test_csv_rows_are_replaced_by_key(tmp_path):
    path = tmp_path / "results" / "t.csv"
    common.update_csv(path, [dict(a="x", n=1, v=0.5), dict(a="y", n=1, v=0.25)], ("a", "n"))
    common.update_csv(path, [dict(a="x", n=1, v=2.0)], ("a", "n"))
    assert path.read_text() == "a,n,v\ny,1,0.25\nx,1,2\n"


def write_often(folder, name):
    for i in range(40):
        common.update_csv(folder / "t.csv", [dict(a=name, n=i)], ("a", "n"))
        common.save(folder, "dataset", "x", 0, {}, v=np.full(1000, i))


def test_two_processes_write_the_same_files_at_once(tmp_path):
    fork = multiprocessing.get_context("fork")
    writers = [fork.Process(target=write_often, args=(tmp_path, name)) for name in "ab"]
    for writer in writers:
        writer.start()
    while any(writer.is_alive() for writer in writers):
        if (tmp_path / "dataset_x_seed0.npz").exists():
            assert np.ptp(common.load(tmp_path, "dataset", "x", 0)["v"]) == 0  # whole, whenever it is read
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0]
    rows = {(row["a"], int(row["n"])) for row in common.read_csv(tmp_path / "t.csv")}
    assert rows == {(name, i) for name in "ab" for i in range(40)} and not list(tmp_path.glob("*.partial"))


@pytest.mark.parametrize("end", [SystemExit(1), OSError(28, "No space left on device")])
def test_a_write_that_is_stopped_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, end):
    def fail(descriptor):
        raise end
    path = common.write_whole(tmp_path / "a.npz", b"old")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(SystemExit):
        common.write_whole(path, b"new")
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"] and path.read_bytes() == b"old"
