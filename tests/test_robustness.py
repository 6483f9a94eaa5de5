"""Kill it, damage what it wrote, feed it rubbish: nothing is lost and one line says why."""
import shutil
import signal
import subprocess
import sys
import time

import common
import numpy as np
import pytest
import torch
from conftest import ROOT, cli

TINY_VAE = ["--batch", 200, "--held_out", 500, "--epochs", 36, "--checkpoint", 0, "--baseline", "false", "--threads", 1]
TINY_POLICY = ["--updates", 120, "--polish", 40, "--reports", 8, "--warm_up", 500, "--replay", 2000, "--hidden", 32, "--coverage", 5,
               "--checkpoint", 0, "--threads", 1]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder in which stages 1 to 3 ran through, uninterrupted: the reference of what follows."""
    out = tmp_path_factory.mktemp("made")
    for name, flags in (("01_make_dataset", ["--trajectories", 3000]), ("02_train_wetvae", TINY_VAE), ("03_train_policy", TINY_POLICY)):
        done = cli(name, "--out", out, *flags)
        assert done.returncode == 0, done.stderr
    return out


# ---------------------------------------------------------------- kill -9

@pytest.mark.parametrize("name, kind, experiment, flags", [("02_train_wetvae", "wetvae", "main", TINY_VAE),
                                                           ("03_train_policy", "policy", "ant_semi", TINY_POLICY)])
def test_training_killed_three_times_ends_with_the_same_bits(name, kind, experiment, flags, made, tmp_path):
    (tmp_path / "runs").mkdir()
    for needed in ("dataset_main_seed0.npz", "wetvae_main_seed0.pt")[:1 if kind == "wetvae" else 2]:
        shutil.copy(made / "runs" / needed, tmp_path / "runs")
    rng, resumed_at = np.random.default_rng(0), []
    checkpoint = tmp_path / "runs" / common.artifact_name(f"{kind}-checkpoint", experiment, 0)
    for kill in range(3):
        process = subprocess.Popen([sys.executable, str(ROOT / f"{name}.py"), "--out", str(tmp_path), "--resume", "true", *map(str, flags)],
                                   stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        while not process.stdout.readline().startswith(("epoch", "     ")) and process.poll() is None:  # until it trains
            pass
        time.sleep(rng.uniform(0, 0.3))
        assert process.poll() is None, f"finished before kill {kill + 1}: make the training longer"
        process.send_signal(signal.SIGKILL)
        process.communicate()
        state = common.load(tmp_path, f"{kind}-checkpoint", experiment, 0)  # whole, whatever the moment
        resumed_at.append(state["epoch"] if kind == "wetvae" else state["updates"])
    assert sorted(resumed_at) == resumed_at and resumed_at[0] < resumed_at[-1] < (36 if kind == "wetvae" else 160)
    done = cli(name, "--out", tmp_path, "--resume", "true", *flags)
    assert done.returncode == 0 and checkpoint.exists(), done.stderr
    whole, cut = (common.load(out, kind, experiment, 0) for out in (made, tmp_path))
    for key in ("actor", "decoder", "encoder"):
        for weight in whole.get(key, {}):
            assert torch.equal(whole[key][weight], cut[key][weight]), (key, weight)
    assert whole.get("env_steps") == cut.get("env_steps")
    clean = lambda rows: [{k: v for k, v in row.items() if k != "minutes"} for row in rows]  # noqa: E731
    assert clean(whole.get("curve", [])) == clean(cut.get("curve", []))


def test_two_seeds_differ(made, tmp_path):
    """That the same seed gives the same bits is what the three kills show; another seed gives others."""
    (tmp_path / "runs").mkdir()
    shutil.copy(made / "runs/dataset_main_seed0.npz", tmp_path / "runs")
    assert cli("02_train_wetvae", "--out", tmp_path, *TINY_VAE, "--epochs", 1, "--seed", 1).returncode == 0
    one, other = (common.load(out, "wetvae", "main", seed)["decoder"] for out, seed in ((made, 0), (tmp_path, 1)))
    assert not torch.equal(one["cell.weight_ih"], other["cell.weight_ih"])


# ---------------------------------------------------------------- damage

@pytest.mark.parametrize("kind, experiment", [("dataset", "main"), ("wetvae", "main"), ("wetvae-checkpoint", "main"), ("policy", "ant_semi"),
                                              ("policy-checkpoint", "ant_semi")])
def test_damaged_bytes_are_refused_or_harmless(kind, experiment, made, tmp_path, capsys):
    """60 seeded damages of each kind of artifact: flipped bits, truncations, swapped blocks."""
    source = made / "runs" / common.artifact_name(kind, experiment, 0)
    original, whole = source.read_bytes(), common.load(made, kind, experiment, 0)
    (tmp_path / "runs").mkdir()
    rng, harmless = np.random.default_rng(0), 0
    for case in range(60):
        data = bytearray(original)
        at = int(rng.integers(len(data)) if case % 2 else rng.integers(min(4000, len(data))))  # half of them in the first headers
        if case % 3 == 0:
            data[at] ^= 1 << int(rng.integers(8))
        elif case % 3 == 1:
            data = data[:at]
        else:
            other, size = int(rng.integers(len(data) - 64)), int(rng.integers(1, 64))
            at = min(at, len(data) - 64)
            data[at:at + size], data[other:other + size] = data[other:other + size], data[at:at + size]
        (tmp_path / "runs" / source.name).write_bytes(data)
        capsys.readouterr()
        try:
            content = common.load(tmp_path, kind, experiment, 0)
        except SystemExit as end:
            error = capsys.readouterr().err
            assert end.code == 2 and error.count("\n") == 1 and "make it with: python 0" in error, error
        else:
            harmless += 1
            assert common.checksum(content) == common.checksum(whole) == whole["sha256"]
    assert harmless < 40


def test_numbers_that_are_not_finite_are_refused(tmp_path, capsys):
    common.save(tmp_path, "policy", "ant_semi", 0, {}, actor=dict(w=torch.tensor([1.0, float("nan")])))
    with pytest.raises(SystemExit) as end:
        common.load(tmp_path, "policy", "ant_semi", 0)
    assert end.value.code == 2 and "not finite" in capsys.readouterr().err


@pytest.mark.parametrize("name, kind, flags", [("02_train_wetvae", "wetvae", [*TINY_VAE, "--learning_rate", 1e18]),
                                               ("03_train_policy", "policy", [*TINY_POLICY, "--learning_rate", 1e30])])
def test_a_loss_that_is_not_finite_is_named_and_nothing_is_overwritten(name, kind, flags, made, tmp_path):
    shutil.copytree(made / "runs", tmp_path / "runs")
    before = {path.name: path.read_bytes() for path in (tmp_path / "runs").iterdir()}
    done = cli(name, "--out", tmp_path, *flags)
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert f"{kind}-checkpoint_" in done.stderr and "--resume true" in done.stderr and " is " in done.stderr
    assert before == {path.name: path.read_bytes() for path in (tmp_path / "runs").iterdir()}


def test_a_full_disk_is_one_line_and_earlier_artifacts_stay(made, tmp_path):
    shutil.copytree(made / "runs", tmp_path / "runs")
    before = (tmp_path / "runs/dataset_main_seed0.npz").read_bytes()
    done = subprocess.run(["bash", "-c", f"ulimit -f 40; exec {sys.executable} {ROOT}/01_make_dataset.py --out {tmp_path}"],
                          capture_output=True, text=True)  # no file beyond 40 KiB: the data set cannot be written
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "cannot write" in done.stderr and "--out" in done.stderr, done.stderr
    assert (tmp_path / "runs/dataset_main_seed0.npz").read_bytes() == before and not list((tmp_path / "runs").glob("*.partial"))


# ---------------------------------------------------------------- rubbish

S1, S2, S3, S4 = "01_make_dataset", "02_train_wetvae", "03_train_policy", "04_mpc_maze"
FLAGS1 = "--experiment --seed --out --trajectories --length --speed_low --speed_high --direction --curvature --straight"
RUBBISH = [  # script, flags, exit code, the line without the script's name; OUT stands for the folder given with --out
    (S1, "--nonsense 1", 2, f"unknown flag --nonsense; allowed: {FLAGS1}"),
    (S1, "surplus", 2, f"unknown flag surplus; allowed: {FLAGS1}"),
    (S1, "--seed=1 --trajectory 5", 2, f"unknown flag --trajectory; allowed: {FLAGS1}"),
    (S1, "--trajectories many", 2, "argument --trajectories: invalid whole number, 0 or more value: 'many'; see --help"),
    (S1, "--trajectories 2.5", 2, "argument --trajectories: invalid whole number, 0 or more value: '2.5'; see --help"),
    (S1, "--seed -1", 2, "argument --seed: invalid whole number, 0 or more value: '-1'; see --help"),
    (S1, "--direction nan", 2, "argument --direction: invalid number, 0 or more value: 'nan'; see --help"),
    (S1, "--straight inf", 2, "argument --straight: invalid number, 0 or more value: 'inf'; see --help"),
    (S1, "--length", 2, "argument --length: expected one argument; see --help"),
    (S1, "--experiment nope", 2, "unknown experiment 'nope'; allowed: main"),
    (S1, "--trajectories 0", 2, "--trajectories and --length must be at least 1, --straight at most 1, --speed_low at most --speed_high"),
    (S1, "--straight 1.5", 2, "--trajectories and --length must be at least 1, --straight at most 1, --speed_low at most --speed_high"),
    (S2, "--experiment Main", 2, "unknown experiment 'Main'; allowed: main seeds"),
    (S2, "--train maybe", 2, "argument --train: invalid true or false value: 'maybe'; see --help"),
    (S2, "--labels colour", 2, "no weak label 'colour'; allowed: speed direction curvature"),
    (S2, "", 2, "no dataset_main_seed0.npz in runs/ or pretrained/; make it with: python 01_make_dataset.py --experiment main --seed 0"),
    (S2, "--data_seed 7", 2, "no dataset_main_seed7.npz in runs/ or pretrained/; make it with: python 01_make_dataset.py --experiment main --seed 7"),
    (S3, "--experiment ant_demi", 2, "unknown experiment 'ant_demi'; allowed: ant_semi"),
    (S3, "--decoder nope", 2, "no wetvae_nope_seed0.pt in runs/ or pretrained/; make it with: python 02_train_wetvae.py --experiment nope --seed 0"),
    (S3, "--train false --seed 98", 2,
     "no policy_ant_semi_seed98.pt in runs/ or pretrained/; make it with: python 03_train_policy.py --experiment ant_semi --seed 98"),
    (S3, "--warm_up 5", 2, "--updates must be at least 1 and --warm_up 5 must lie between --batch 256 and --replay 1000000"),
    (S3, "--updates 0", 2, "--updates must be at least 1 and --warm_up 10000 must lie between --batch 256 and --replay 1000000"),
    (S4, "--mazes maze3", 2, "unknown maze 'maze3'; allowed: maze1 maze2"),
    (S4, "--rewards shaped", 2, "unknown reward 'shaped'; allowed: dense sparse"),
    (S4, "--predictions oracle", 2, "unknown prediction 'oracle'; allowed: relation decoder"),
    (S4, "--objectives best", 2, "unknown objective 'best'; allowed: final sum"),
    (S4, "--trials 0", 2, "--trials, --samples, --hold and --length must be at least 1, and --episode at least hold x length"),
    (S4, "--episode 100", 2, "--trials, --samples, --hold and --length must be at least 1, and --episode at least hold x length"),
    (S4, "--policy_seed 99", 2,
     "no policy_ant_semi_seed99.pt in runs/ or pretrained/; make it with: python 03_train_policy.py --experiment ant_semi --seed 99"),
]


@pytest.mark.parametrize("name, flags, code, line", RUBBISH, ids=[f"{row[0][:2]} {row[1]}" for row in RUBBISH])
def test_rubbish_gets_its_one_line(name, flags, code, line, tmp_path, capsys, monkeypatch):
    """Each runs the script's own main part, in this process: starting Python thirty times would take a minute."""
    import runpy
    out = [] if flags.startswith("surplus") else ["--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [str(ROOT / f"{name}.py"), *out, *flags.split()])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(ROOT / f"{name}.py"), run_name="__main__")
    captured = capsys.readouterr()
    assert (end.value.code, captured.err) == (code, f"{name}.py: {line}\n")
    assert not list(tmp_path.rglob("*.p*"))  # nothing was written


def test_rubbish_from_a_real_shell(tmp_path):
    done = cli(S4, "--out", tmp_path, "--samples", "three")
    assert done.returncode == 2 and done.stdout == "" and done.stderr.count("\n") == 1


def test_a_file_where_a_folder_is_needed(tmp_path):
    (tmp_path / "runs").write_text("in the way")
    done = cli(S1, "--out", tmp_path, "--trajectories", 100)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "cannot write" in done.stderr and "--out" in done.stderr


def test_a_checkpoint_of_other_flags_is_refused(made):
    done = cli(S3, "--out", made, *TINY_POLICY, "--hidden", 48, "--resume", "true")
    assert done.returncode == 2 and "policy-checkpoint_ant_semi_seed0.pt was made with --hidden 32, not 48" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_end_with_one_line(number, made, tmp_path):
    (tmp_path / "runs").mkdir()
    shutil.copy(made / "runs/dataset_main_seed0.npz", tmp_path / "runs")
    process = subprocess.Popen([sys.executable, "-u", str(ROOT / f"{S2}.py"), "--out", str(tmp_path), *map(str, TINY_VAE), "--epochs", "2000"],
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))  # a background job ignores Ctrl-C
    while not process.stdout.readline().startswith("epoch") and process.poll() is None:
        pass
    process.send_signal(number)
    error = process.communicate(timeout=60)[1]
    assert process.returncode != 0 and error.strip().count("\n") == 0 and "stopped by hand" in error and "--resume true" in error, error


def test_an_artifact_of_other_labels_is_refused(made):
    done = cli(S2, "--out", made, *TINY_VAE, "--train", "false", "--labels", "speed")
    assert done.returncode == 2 and "was made with --labels speed direction curvature, not speed" in done.stderr, done.stderr
    assert done.stderr.count("\n") == 1


def test_an_artifact_of_another_experiment_is_refused(made, tmp_path):
    (tmp_path / "runs").mkdir()
    shutil.copy(made / "runs/wetvae_main_seed0.pt", tmp_path / "runs/policy_ant_semi_seed0.pt")
    done = cli(S4, "--out", tmp_path)
    assert done.returncode == 2 and "has kind 'wetvae' where 'policy' is needed" in done.stderr and done.stderr.count("\n") == 1
