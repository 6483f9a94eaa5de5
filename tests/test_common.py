"""Command line, artifacts and CSV of all stages. The networks and robots in common.py are tested with stage 3."""
import ast
import csv
import errno
import hashlib
import io
import multiprocessing
import os
import pickle
import runpy
import shutil
import sys

import common
import numpy as np
import pytest
import torch
from conftest import ROOT, S1, S2, S3, S4, cli, one_line, script

# ---------------------------------------------------------------- command line

FILE = '''"""A stage."""
from common import Count, Degrees, Positive, Share, Signed
EXPERIMENT: str = "plain"  # row
SEED: int = 0           # random seed
OUT: str = {out!r}      # folder
N: Count = 10_000       # how many, 50 % of all
SHARE: Share = 1.0      # a share
WEIGHT: float = 2.5     # off at 0
RATE: Positive = 0.5    # above 0
ANGLE: Degrees = 90.0   # an angle
FLAG: bool = False      # a switch
START: tuple[Signed, Signed] = (0.0, 1.5)  # x and y
MANY: tuple[Count, ...] = (10,)  # one or more
WORDS: str = "a b"      # words
EXPERIMENTS = {{"plain": {{}}, "other": dict(N=7, SHARE=0, MANY=[5, 6.0], START="1 2"), "typo": dict(SHRE=1),
               "bad": dict(N=2.5), "minus": dict(N="-1"), "one": dict(MANY=3)}}
'''
CONSTANTS = "EXPERIMENT SEED OUT N SHARE WEIGHT RATE ANGLE FLAG START MANY WORDS".split()


@pytest.fixture
def flags(tmp_path, capsys):
    """flags(*argv, N="2 * 3") -> constants of a small stage after parse_flags, what it returns; or its stderr if it ended.
    A named argument is what the file says instead."""
    path = tmp_path / "stage.py"

    def parse(*argv, **written):
        lines = FILE.format(out=str(tmp_path)).splitlines()
        for name, value in written.items():
            at, = [i for i, line in enumerate(lines) if line.startswith(name + ":")]
            lines[at] = f"{lines[at].partition(' = ')[0]} = {value}  # a comment"
        path.write_text("\n".join(lines))
        stage = runpy.run_path(str(path)) | dict(__file__=str(path))
        try:
            return stage, *common.parse_flags(stage, list(argv))
        except SystemExit as end:
            assert end.code == 2
            return capsys.readouterr().err
    return parse


def test_flags_override_rows_and_rows_override_constants(flags):
    stage, config, given = flags()
    assert (stage["N"], stage["SHARE"], stage["MANY"], given) == (10_000, 1.0, (10,), {})
    assert config == {name: stage[name] for name in CONSTANTS}
    stage, config, given = flags("--experiment", "other", "--share", "0.25", "--flag", "True", "--many", "7,8 9")
    assert (stage["N"], stage["SHARE"], stage["FLAG"], stage["START"]) == (7, 0.25, True, (1.0, 2.0))
    assert given == dict(EXPERIMENT="other", SHARE=0.25, FLAG=True, MANY=(7, 8, 9))
    assert config == {name: stage[name] for name in CONSTANTS}
    stage, config, given = flags("--experiment", "other")
    assert stage["MANY"] == (5, 6) and stage["SHARE"] == 0.0 and given == dict(EXPERIMENT="other")
    assert flags("--experiment", "one")[1]["MANY"] == (3,)


# What a file says and what it is then: by its declared type, not by how it is written.
@pytest.mark.parametrize("name, written, value", [
    ("N", "512 / 2", 256), ("N", "2e3", 2000), ("N", "7.0", 7), ("N", "'12'", 12), ("SHARE", "0", 0.0), ("SHARE", "1", 1.0),
    ("SHARE", "1 / 4", 0.25), ("WEIGHT", "20", 20.0), ("WEIGHT", "0", 0.0), ("RATE", "3", 3.0), ("ANGLE", "180", 180.0),
    ("FLAG", "1", True), ("FLAG", "'false'", False), ("START", "(1, -2)", (1.0, -2.0)), ("START", "[1e1, 2]", (10.0, 2.0)),
    ("MANY", "5", (5,)), ("MANY", "1e2", (100,)), ("MANY", "(1, 2.0, 3e0)", (1, 2, 3)), ("MANY", "'4 5'", (4, 5)),
    ("WORDS", "'x'", "x"), ("WORDS", "''", ""), ("SEED", "20260101123456789", 20260101123456789), ("SEED", "2.0", 2)])
def test_a_file_says_a_value_in_any_notation(flags, name, written, value):
    config = flags(**{name: written})[1]
    assert config[name] == value and type(config[name]) is type(value)
    if isinstance(value, tuple):
        assert [*map(type, config[name])] == [*map(type, value)]


@pytest.mark.parametrize("name, file, flag, value", [
    ("SHARE", "0", "0.5", 0.5), ("WEIGHT", "4", "0.125", 0.125), ("RATE", "2", "1e-3", 0.001), ("ANGLE", "90", "22.5", 22.5),
    ("START", "(1, 2)", "0.5 -.5", (0.5, -0.5)), ("N", "10", "64.0", 64), ("N", "10", "1e4", 10_000), ("MANY", "1", "3 4", (3, 4))])
def test_a_flag_may_be_a_fraction_where_the_file_says_a_whole_number(flags, name, file, flag, value):
    config = flags("--" + name.lower(), flag, **{name: file})[1]
    assert config[name] == value and type(config[name]) is type(value)


def test_whole_numbers_are_exact_up_to_2_to_the_63(flags):
    for seed in (1234567890123456789, 2 ** 53 + 1, 2 ** 63 - 1):
        assert flags("--seed", str(seed))[1]["SEED"] == flags(SEED=str(seed))[1]["SEED"] == seed
    for seed in (2 ** 63, 10 ** 19, 10 ** 400):
        error = flags("--seed", str(seed))
        assert "below 2 ** 63" in error and len(error.splitlines()) == 1
        assert len(flags(N=f"10 ** {len(str(seed))}").splitlines()) == 1
    assert len(flags("--seed", "1e999999999999").splitlines()) == 1


@pytest.mark.parametrize("argv", [["--start", "-1 2"], ["--start", "-1,2"], ["--start=-1 2"], ["--start", "-1.0, 2.0"],
                                  ["--start", "(-1, 2)"], ["--start", "-1e0 2"]])
def test_negative_numbers_by_flag(flags, argv):
    assert flags(*argv)[1]["START"] == (-1.0, 2.0)
    assert flags("--start", "-.5 -3", "--n", "3")[1]["START"] == (-0.5, -3.0)


@pytest.mark.parametrize("argv, message", [
    ("--nonsense 1", "unrecognized arguments: --nonsense 1; see --help"),
    ("surplus", "unrecognized arguments: surplus; see --help"), ("-5", "unrecognized arguments: -5; see --help"),
    ("--shar 1", "unrecognized arguments: --shar 1; see --help"), ("--n many", "--n is 'many', but must be a whole number"),
    ("--n 2.5", "--n is '2.5', but must be a whole number"), ("--n", "--n: expected one argument; see --help"),
    ("--n -1", "--n is '-1', but must be a whole number of at least 1"), ("--n 0", "--n is '0', but must be a whole number of"),
    ("--n nan", "--n is 'nan', but must be a whole number"), ("--n 12_0x", "--n is '12_0x', but must be a whole number"),
    ("--seed -1", "--seed is '-1', but must be a whole number of at least 0"),
    ("--seed 0.5", "--seed is '0.5', but must be a whole number of at least 0"),
    ("--share -0.5", "--share is '-0.5', but must be a number from 0 to 1"), ("--share nan", "--share is 'nan'"),
    ("--share 1.01", "--share is '1.01', but must be a number from 0 to 1"), ("--weight inf", "--weight is 'inf'"),
    ("--weight -1e-9", "--weight is '-1e-9', but must be a number of at least 0"), ("--weight 1e301", "--weight is '1e301'"),
    ("--rate 0", "--rate is '0', but must be a number above 0"), ("--angle 181", "--angle is '181', but must be a number from 0 to 180"),
    ("--flag maybe", "--flag is 'maybe', but must be true or false"), ("--flag 2", "--flag is '2', but must be true or false"),
    ("--start 1", "--start is '1', but must be 2 numbers, as in \"1 1\""), ("--start a b", "--start is 'a', but must be a number"),
    ("--start 1 2 3", "--start is '1 2 3', but must be 2 numbers"), ("--start 1 inf", "--start is 'inf', but must be a number"),
    ("--many 5 x", "--many is 'x', but must be a whole number of at least 1"),
    ("--many 5 0", "--many is '0', but must be a whole number of at least 1"), ("--many  ", "--many"),
    ("--experiment nope", "unknown experiment 'nope'; allowed: plain other typo bad minus one"),
    ("--experiment typo", "SHRE in the row 'typo' of EXPERIMENTS is no constant"),
    ("--experiment bad", "--n is 2.5, but must be a whole number"),
    ("--experiment minus", "--n is '-1', but must be a whole number of at least 1")])
def test_what_is_wrong_on_the_command_line_is_one_line(flags, argv, message):
    error = flags(*argv.split(maxsplit=1))
    assert isinstance(error, str) and message in error and len(error.splitlines()) == 1, error


@pytest.mark.parametrize("name, written", [
    ("N", "0"), ("N", "2.5"), ("N", "None"), ("N", "[3]"), ("N", "True"), ("SHARE", "2"), ("SHARE", "'x'"), ("WEIGHT", "-3"),
    ("RATE", "0"), ("ANGLE", "1e3"), ("FLAG", "3"), ("FLAG", "None"), ("START", "3"), ("START", "(1, 2, 3)"), ("START", "()"),
    ("START", "('a', 'b')"), ("START", "None"), ("MANY", "()"), ("MANY", "(1, 0)"), ("MANY", "(1, 2.5)"), ("MANY", "{}"),
    ("SEED", "-1"), ("SEED", "float('nan')"), ("WEIGHT", "float('inf')")])
def test_what_is_wrong_in_the_file_is_one_line(flags, name, written):
    error = flags(**{name: written})
    assert isinstance(error, str) and f"--{name.lower()} is " in error and len(error.splitlines()) == 1, error


def test_help_prints_each_constant_with_its_comment(flags, capsys):
    with pytest.raises(AssertionError):  # it ends with 0
        flags("--help")
    printed = " ".join(capsys.readouterr().out.split())
    assert "--n VALUE how many, 50 % of all [10000]" in printed and "--start VALUE x and y [(0.0, 1.5)]" in printed


@pytest.mark.parametrize("name", [S1, S2, S3, S4])
def test_help_of_each_stage_prints_every_constant_and_its_comment(name, capsys):
    """Names by ast, comments by hand: every line NAME: type = value  # comment. argparse breaks lines at hyphens too."""
    source, module = (ROOT / f"{name}.py").read_text(), script(name)
    with pytest.raises(SystemExit) as end:
        common.parse_flags(vars(module), ["--help"])
    printed = "".join(capsys.readouterr().out.split())
    constants = [node for node in ast.parse(source).body if isinstance(node, ast.AnnAssign)]
    assert end.value.code == 0 and len(constants) > 10
    for node in constants:
        line = source.splitlines()[node.lineno - 1]
        assert line.count("  # ") == 1, line
        comment = "".join(line.partition("  # ")[2].split())
        assert f"--{node.target.id.lower()}VALUE{comment}[" in printed, line


# ---------------------------------------------------------------- a stage that somebody has edited

@pytest.fixture
def edited(tmp_path, inside):
    """edited(old, new, ..)(*flags) -> runs a copy of stage 1 with its text edited."""
    def edit(*changes):
        text = (ROOT / f"{S1}.py").read_text().replace('= "speed direction curvature"', '= "speed direction"')  # no figure
        for old, new in zip(changes[::2], changes[1::2]):
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        (tmp_path / f"{S1}.py").write_text(text)
        return lambda *flags: inside(script(tmp_path / S1), "--out", tmp_path / "out", *flags)
    return edit


@pytest.mark.parametrize("line", ["TRAJECTORIES: Count = 300", "TRAJECTORIES:Count=300", "TRAJECTORIES=300",
                                  "TRAJECTORIES = 7\nTRAJECTORIES = 300", "TRAJECTORIES: Count = 7\nTRAJECTORIES: Count = 300",
                                  "TRAJECTORIES :  Count  =  300#many"])
def test_a_constant_may_be_written_without_a_type_without_blanks_and_twice(edited, tmp_path, line):
    run = edited("TRAJECTORIES: Count = 100_000", line, "EXPERIMENTS = {", 'EXPERIMENTS={\n    "ten": dict(TRAJECTORIES=10),')
    done = run()
    assert done.returncode == 0, done.stderr
    for flags, n in (((), 300), (("--trajectories", "40"), 40), (("--experiment", "ten"), 10)):
        if flags:
            done = run(*flags)
            assert done.returncode == 0, done.stderr
        assert f"{n} trajectories of T" in done.stdout
    help_of = run("--help")
    assert not help_of.returncode and "--trajectories VALUE" in help_of.stdout


@pytest.mark.parametrize("changes, flags, message", [
    (('"main": dict(', '"main": dict(TRAJECTORYS=5, '), (), "TRAJECTORYS in the row 'main' of EXPERIMENTS is no constant"),
    (("STRAIGHT: Share = 0.2", "STRAIGHT: Share = 20"), (), "--straight is 20, but must be a number from 0 to 1"),
    (("LENGTH: Count = 5", "LENGTH: Count = None"), (), "--length is None, but must be a whole number of at least 1"),
    (("SPEED_LOW: Signed = 0.0", "SPEED_LOW: Signed = '0,1'"), (), "--speed_low is '0,1', but must be a number"),
    ((), ("--trajectories", "1e12"), "lower --trajectories or --length"), ((), ("--length", "1e9"), "lower --trajectories"),
    ((), ("--seed", "1e20"), "--seed is '1e20', but must be a whole number of at least 0, below 2 ** 63")])
def test_an_edit_that_makes_no_sense_is_one_line(edited, changes, flags, message):
    done = edited(*changes)(*flags)
    assert one_line(done, 2) and message in done.stderr, done.stderr


def test_constants_of_common_are_checked_too(tmp_path):
    text = (ROOT / "common.py").read_text()
    shutil.copy(ROOT / f"{S1}.py", tmp_path)
    shutil.copytree(ROOT / "robots", tmp_path / "robots")
    for old, new, message in (("FRAME_SKIP: Count = 5 ", "FRAME_SKIP: Count = 2.5 ", "FRAME_SKIP in common.py is 2.5, but must be a whole"),
                              ("FEEDBACK: Share = 0.2 ", "FEEDBACK: Share = -1 ", "FEEDBACK in common.py is -1, but must be a number from")):
        assert text.count(old) == 1
        (tmp_path / "common.py").write_text(text.replace(old, new))
        done = cli(tmp_path / S1, "--out", tmp_path / "out")
        assert one_line(done, 2) and message in done.stderr, done.stderr


# ---------------------------------------------------------------- artifacts

def test_artifacts_come_back_as_they_went_and_own_ones_before_shipped_ones(tmp_path, monkeypatch, capsys):
    shutil.copytree(ROOT / "robots", tmp_path / "repo/robots")
    monkeypatch.setattr(common, "HERE", tmp_path / "repo")
    common.save(tmp_path / "repo/pretrained", "policy", "x", 3, dict(A=1), w=torch.arange(4.0), curve=[dict(a=1.5)])
    common.save(tmp_path / "runs", "dataset", "x", 3, dict(A=1), t=np.eye(2), names=np.array(["speed"]))
    policy, dataset = (common.load(tmp_path / "runs", kind, "x", 3) for kind in ("policy", "dataset"))
    assert torch.equal(policy["w"], torch.arange(4.0)) and policy["curve"] == [dict(a=1.5)]
    assert policy["config"]["A"] == 1 and policy["config"] == common.made_by(dict(A=1))
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
    assert "back, or" not in error  # a seed, a kind or a format cannot be set back


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


def test_rows_of_other_settings_stay_and_of_the_same_settings_are_replaced(tmp_path):
    path, key = tmp_path / "t.csv", ("seed", "settings")
    for settings, v in (("aa", 1), ("bb", 2), ("aa", 3)):
        common.update_csv(path, [dict(seed=s, settings=settings, v=v + s) for s in (0, 1)], key)
    common.update_csv(path, [dict(seed=0, settings="bb", v=9, new="x, y")], key)
    rows = [(row["seed"], row["settings"], row["v"], row["new"]) for row in common.read_csv(path)]
    assert rows == [("1", "bb", "3", ""), ("0", "aa", "3", ""), ("1", "aa", "4", ""), ("0", "bb", "9", "x, y")]
    path.write_text("seed,v\n0,5\n1,6\n")  # from before there were settings
    common.update_csv(path, [dict(seed=0, settings="aa", v=7)], key)
    assert [row["v"] for row in common.read_csv(path)] == ["5", "6", "7"]


ROWS = [dict(a="x", n="1", v="0.5"), dict(a="y, z", n="2", v="")]


def table(separator=",", end="\n"):
    text = io.StringIO()
    writer = csv.DictWriter(text, ROWS[0], delimiter=separator, lineterminator=end)
    writer.writeheader()
    writer.writerows(ROWS)
    return text.getvalue()


@pytest.mark.parametrize("data", [table().encode(), table().encode("utf-8-sig"), table(end="\r\n").encode("utf-8-sig"),
                                  table().rstrip().encode()])
def test_a_table_saved_by_a_spreadsheet_is_read(tmp_path, data):
    path = tmp_path / "t.csv"
    path.write_bytes(data)
    assert common.read_csv(path) == ROWS
    common.update_csv(path, [dict(a="x", n=1, v=2.0)], ("a", "n"))  # not a second time because of the mark
    assert common.read_csv(path) == [ROWS[1], dict(a="x", n="1", v="2")]


@pytest.mark.parametrize("data", [table(";").encode(), table("\t").encode("utf-8-sig"), b"a;n\nx;1\n", table().encode("utf-16"),
                                  table().replace("x", "\xe9").encode("latin-1"), b"\x00\xff" * 50, b"a,n,v\nx,1\n",
                                  b"a,n,v\nx,1,2,3\n"])
def test_a_table_in_another_form_is_one_line_and_stays(tmp_path, data, capsys):
    path = tmp_path / "t.csv"
    path.write_bytes(data)
    for use in (lambda: common.read_csv(path), lambda: common.update_csv(path, [dict(a="x", n=1, v=2.0)], ("a", "n"))):
        with pytest.raises(SystemExit) as end:
            use()
        error = capsys.readouterr().err
        assert end.value.code == 2 and len(error.splitlines()) == 1 and str(path) in error and path.read_bytes() == data


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no fcntl")
@pytest.mark.parametrize("code", ["ENOLCK", "ENOTSUP", "EIO", None])
def test_a_table_that_cannot_be_locked_is_said_in_one_line_and_written(tmp_path, monkeypatch, capsys, code):
    """A file system without locks, or (None) a Python without fcntl."""
    import fcntl

    def fail(*_):
        raise OSError(getattr(errno, code), os.strerror(getattr(errno, code)))
    if code:
        monkeypatch.setattr(fcntl, "flock", fail)
    else:
        monkeypatch.setitem(sys.modules, "fcntl", None)
    common.update_csv(tmp_path / "t.csv", [dict(a="x", n=1)], ("a",))
    printed = capsys.readouterr()
    assert printed.out.count("\n") == 1 and f"{tmp_path / 't.csv'} is not locked (" in printed.out and not printed.err
    assert (os.strerror(getattr(errno, code)) if code else "fcntl") in printed.out
    assert common.read_csv(tmp_path / "t.csv") == [dict(a="x", n="1")]


def test_a_table_that_cannot_be_written_is_one_line(tmp_path, capsys):
    (tmp_path / "results").write_text("a file is in the way")
    with pytest.raises(SystemExit) as end:
        common.update_csv(tmp_path / "results" / "t.csv", [dict(a="x", n=1)], ("a",))
    error = capsys.readouterr().err
    assert end.value.code == 1 and len(error.splitlines()) == 1 and "cannot write" in error and "--out" in error


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
    assert rows == {(name, i) for name in "ab" for i in range(40)}
    assert {path.name for path in tmp_path.iterdir()} == {"t.csv", "dataset_x_seed0.npz"}  # no part, no lock is left


@pytest.mark.parametrize("end", [SystemExit(1), OSError(28, "No space left on device")])
def test_a_write_that_is_stopped_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, end):
    def fail(descriptor):
        raise end
    path = common.write_whole(tmp_path / "a.npz", b"old")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(SystemExit):
        common.write_whole(path, b"new")
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"] and path.read_bytes() == b"old"


# ---------------------------------------------------------------- a result knows what made it

def test_an_artifact_knows_the_constants_of_common_and_the_robots_files(tmp_path, monkeypatch, capsys):
    common.save(tmp_path, "policy", "x", 0, dict(A=1), v=1)
    config = common.load(tmp_path, "policy", "x", 0)["config"]
    for name in "FRAME_SKIP FEEDBACK CORRECTION CLASSES".split():
        assert config[name] == getattr(common, name), name
    for name in ("ant.xml", "half_cheetah.xml"):
        assert config[name] == hashlib.sha256((ROOT / "robots" / name).read_bytes()).hexdigest()[:16]
    before = common.digest(config)
    assert common.digest(dict(reversed(config.items()))) == before == common.digest(common.made_by(dict(A=1)))
    assert len({before, *(common.digest(config | change) for change in (dict(A=2), dict(FRAME_SKIP=6), dict(B=1)))}) == 4
    for name, value in dict(FRAME_SKIP=4, CORRECTION=0.0, FEEDBACK=0.0, CLASSES=common.CLASSES | dict(x=9)).items():
        monkeypatch.setattr(common, name, value)
        made = common.made_by(dict(A=1))
        assert common.digest(made) != before
        with pytest.raises(SystemExit):
            common.load(tmp_path, "policy", "x", 0, **made)
        error = capsys.readouterr().err
        assert len(error.splitlines()) == 1 and f"made with {name} = " in error and f"set {name} back" in error
        monkeypatch.undo()
    common.load(tmp_path, "policy", "x", 0, **common.made_by(dict(A=1)))


# ---------------------------------------------------------------- memory

def test_what_needs_more_memory_than_there_is_is_one_line(capsys):
    common.need_memory(10 ** 6, "--n")
    with pytest.raises(SystemExit) as end:
        common.need_memory(10 ** 15, "--n or --m")
    assert end.value.code == 2 and capsys.readouterr().err.endswith(
        "this needs 1e+06 GB of memory, more than this machine has: lower --n or --m\n")
