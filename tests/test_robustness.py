"""Kill it, damage what it wrote, feed it rubbish: nothing is lost and one line says why."""
import os
import runpy
import shutil
import signal
import subprocess
import sys
import time

import common
import numpy as np
import pytest
import torch
from conftest import ROOT, Fork, cli

S1, S2, S3, S4 = "01_make_dataset", "02_train_wetvae", "03_train_policy", "04_mpc_maze"
TINY_DATA = ["--trajectories", 1500]
TINY_VAE = ["--batch", 200, "--held_out", 500, "--epochs", 36, "--checkpoint", 0, "--baseline", "false", "--hidden", 32, "--threads", 1]
TINY_POLICY = ["--updates", 128, "--reports", 8, "--warm_up", 500, "--replay", 1000, "--hidden", 32, "--coverage", 2,
               "--checkpoint", 0, "--threads", 1, "--calibrated", 0]


def versions(fork, file, number):
    """Wait until the running script has written the file anew so many times."""
    seen = set()
    fork.wait_for(lambda: seen.add(os.path.exists(file) and os.stat(file).st_mtime_ns) or len(seen) > number)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder in which stages 1 to 3 ran, their trainings uninterrupted: the reference of what follows."""
    out = tmp_path_factory.mktemp("made")
    fork = Fork(out)  # of another Python, with another hash seed, than the ones that are killed
    for name, flags in ((S1, TINY_DATA), (S2, TINY_VAE)):
        done = fork(name, "--out", out, *flags)
        assert done.returncode == 0, done.stderr
    fork.start(S3, "--out", out, *TINY_POLICY)
    fork.wait_for((out / "runs/policy_ant_semi_seed0.pt").exists)
    fork.end(signal.SIGKILL)  # to measure would take longer than this training
    fork.close()
    return out


@pytest.fixture
def copy(made, tmp_path):
    shutil.copytree(made / "runs", tmp_path / "runs")
    return tmp_path


# ---------------------------------------------------------------- kill -9

@pytest.mark.parametrize("name, kind, experiment, flags, progress, every, last, pause", [
    (S2, "wetvae", "main", TINY_VAE, "epoch", 1, 36, 0.03), (S3, "policy", "ant_semi", TINY_POLICY, "updates", 16, 128, 0.4)])
def test_training_killed_five_times_ends_with_the_same_bits(name, kind, experiment, flags, progress, every, last, pause, made, fork, copy):
    """Each kill comes a random pause after a random one of the checkpoints; two of the five while another one is being written."""
    for path in (copy / "runs").glob(f"{kind}*"):
        path.unlink()
    file = copy / "runs" / common.artifact_name(f"{kind}-checkpoint", experiment, 0)
    partial, rng, reached = f"{file}.partial", np.random.default_rng(1), [0]
    for kill, moment in enumerate(sorted(rng.integers(last // every - 2, size=5))):
        fork.start(name, "--out", copy, "--resume", "true", *flags)
        fork.wait_for(lambda: file.name in fork.streams[0].read_text())  # it says what it goes on from: now it trains
        versions(fork, file, moment - reached[-1] // every)
        time.sleep(rng.uniform(0, pause))
        if kill % 2:
            versions(fork, partial, 1)
        done = fork.end(signal.SIGKILL)
        assert done.returncode == -signal.SIGKILL, f"finished before kill {kill + 1}: make the training longer; {done.stderr}"
        if file.exists():
            reached.append(common.load(copy, f"{kind}-checkpoint", experiment, 0)[progress])  # whole, whatever the moment
    assert reached == sorted(reached) and len(set(reached)) > 3
    fork.start(name, "--out", copy, "--resume", "true", *flags)
    fork.wait_for((copy / "runs" / common.artifact_name(kind, experiment, 0)).exists)
    done = fork.end(number := 0 if kind == "wetvae" else signal.SIGKILL)
    assert done.returncode == -number and not os.path.exists(partial), done.stderr
    for part in (kind, f"{kind}-checkpoint"):
        whole, cut = (common.load(out, part, experiment, 0) for out in (made, copy))
        for content in (whole, cut):  # compare all but the clock, and the flags --out and --resume
            for row in [content, *content.get("curve", [])]:
                for entry in ("seconds", "minutes", "config", "sha256"):
                    row.pop(entry, None)
        assert [key for key in whole if common.checksum({key: whole[key]}) != common.checksum({key: cut[key]})] == []


def test_two_seeds_differ(fork, copy):
    """That the same seed gives the same bits is what the five kills show; another seed gives others."""
    assert fork(S2, "--out", copy, *TINY_VAE, "--epochs", 1, "--seed", 1).returncode == 0
    one, other = (common.load(copy, "wetvae", "main", seed)["decoder"] for seed in (0, 1))
    assert not torch.equal(one["cell.weight_ih"], other["cell.weight_ih"])


# ---------------------------------------------------------------- damage

@pytest.mark.parametrize("kind, experiment", [("dataset", "main"), ("wetvae", "main"), ("wetvae-checkpoint", "main"), ("policy", "ant_semi"),
                                              ("policy-checkpoint", "ant_semi")])
def test_damaged_bytes_are_refused_or_harmless(kind, experiment, copy, capsys):
    """60 seeded damages of each kind of artifact: flipped bits, truncations, swapped blocks."""
    path = copy / "runs" / common.artifact_name(kind, experiment, 0)
    original, whole = path.read_bytes(), common.load(copy, kind, experiment, 0)
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
        path.write_bytes(data)
        capsys.readouterr()
        try:
            content = common.load(copy, kind, experiment, 0)
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


@pytest.mark.parametrize("name, kind, flags", [(S2, "wetvae", [*TINY_VAE, "--learning_rate", 1e18]),
                                               (S3, "policy", [*TINY_POLICY, "--learning_rate", 1e30])])
def test_a_loss_that_is_not_finite_is_named_and_nothing_is_overwritten(name, kind, flags, fork, copy):
    before = {path.name: path.read_bytes() for path in (copy / "runs").iterdir()}
    done = fork(name, "--out", copy, *flags)
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert f"{kind}-checkpoint_" in done.stderr and "--resume true" in done.stderr and " is " in done.stderr
    assert before == {path.name: path.read_bytes() for path in (copy / "runs").iterdir()}


def test_a_full_disk_is_one_line_and_earlier_artifacts_stay(copy):
    before = (copy / "runs/dataset_main_seed0.npz").read_bytes()
    done = subprocess.run(["bash", "-c", f"ulimit -f 40; exec {sys.executable} {ROOT}/01_make_dataset.py --out {copy}"],
                          capture_output=True, text=True)  # no file beyond 40 KiB: the data set cannot be written
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "cannot write" in done.stderr and "--out" in done.stderr, done.stderr
    assert (copy / "runs/dataset_main_seed0.npz").read_bytes() == before and not list((copy / "runs").glob("*.partial"))


# ---------------------------------------------------------------- rubbish

FLAGS1 = ("--experiment --seed --out --trajectories --length --factors --speed_low --speed_high --direction --curvature --acceleration "
          "--straight")
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
    (S1, "--experiment nope", 2, "unknown experiment 'nope'; allowed: main full polar speed_acc four_factors"),
    (S1, "--trajectories 0", 2, "--trajectories and --length must be at least 1, --straight at most 1, --speed_low at most --speed_high"),
    (S1, "--factors direction", 2, "--factors 'direction' must name speed, and may name direction, curvature and acceleration, each once"),
    (S1, "--straight 1.5", 2, "--trajectories and --length must be at least 1, --straight at most 1, --speed_low at most --speed_high"),
    (S2, "--experiment Main", 2, "unknown experiment 'Main'; allowed: main seeds beta_gamma polar cartesian speed_acc four_factors full"),
    (S2, "--train maybe", 2, "argument --train: invalid true or false value: 'maybe'; see --help"),
    (S2, "--labels colour", 2, "no weak label 'colour'; allowed: speed direction curvature angle x y velocity acceleration"),
    (S2, "", 2, "no dataset_main_seed0.npz in runs/ or pretrained/; make it with: python 01_make_dataset.py --experiment main --seed 0"),
    (S2, "--data_seed 7", 2, "no dataset_main_seed7.npz in runs/ or pretrained/; make it with: python 01_make_dataset.py --experiment main --seed 7"),
    (S3, "--experiment ant_demi", 2, "unknown experiment 'ant_demi'; allowed: ant_semi ant_full half_cheetah ant_dads ant_sectar "
     "ant_sectar_no_explorer"),
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


def test_a_file_where_a_folder_is_needed(fork, tmp_path):
    (tmp_path / "runs").write_text("in the way")
    done = fork(S1, "--out", tmp_path, *TINY_DATA)
    assert done.returncode == 1 and done.stderr.count("\n") == 1 and "cannot write" in done.stderr and "--out" in done.stderr


@pytest.mark.parametrize("name, flags, line", [
    (S2, [*TINY_VAE, "--train", "false", "--labels", "speed"], "wetvae_main_seed0.pt was made with --labels speed direction curvature, not speed"),
    (S3, [*TINY_POLICY, "--hidden", 48, "--resume", "true"], "policy-checkpoint_ant_semi_seed0.pt was made with --hidden 32, not 48"),
    (S4, ["--policy_seed", 5], "policy_ant_semi_seed5.pt has kind 'wetvae' where 'policy' is needed")])
def test_an_artifact_made_with_other_flags_or_of_another_kind_is_refused(name, flags, line, fork, copy):
    shutil.copy(copy / "runs/wetvae_main_seed0.pt", copy / "runs/policy_ant_semi_seed5.pt")
    done = fork(name, "--out", copy, *flags)
    assert done.returncode == 2 and line in done.stderr and done.stderr.count("\n") == 1, done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_end_with_one_line(number, fork, copy):
    fork.start(S2, "--out", copy, *TINY_VAE, "--epochs", 2000)
    fork.wait_for(lambda: "\nepoch" in fork.streams[0].read_text())
    done = fork.end(number)
    assert done.returncode != 0 and "stopped by hand" in done.stderr and "--resume true" in done.stderr, done.stderr
    assert done.stderr.strip().count("\n") == 0
