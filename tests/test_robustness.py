"""What happens to people: Ctrl-C, kill -9, a full disk, a notebook's environment, settings that make no sense, and
every constant changed. An error is one line, and nothing that was saved is lost."""
import signal
import subprocess
import sys

import common
import numpy as np
import pytest
from conftest import ROOT, S1, S2, S3, S4, TINY, cli, one_line, script, tiny
from test_maze import make_policy
from test_policy import outcome, same

# ---------------------------------------------------------------- where people run it

ODD = dict(LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0", MPLBACKEND="module://matplotlib_inline.backend_inline")


@pytest.mark.parametrize("name, flags", [(S1, ["--trajectories", 500]), (S4, ["--help"])])
def test_another_folder_a_c_locale_and_a_notebooks_backend(name, flags, tmp_path):
    done = cli(name, *([*flags, "--out", tmp_path / "new"] if name == S1 else flags), cwd=tmp_path, **ODD)
    assert done.returncode == 0 and not done.stderr
    if name == S1:
        assert (tmp_path / "new/figures/fig09_dataset.png").stat().st_size > 10_000
        done.stdout.encode("ascii")


def shell(command):
    return subprocess.run(["bash", "-c", command], capture_output=True, text=True)


def test_output_into_head(tmp_path):
    done = shell(f"{sys.executable} -u {ROOT}/{S1}.py --out {tmp_path} --trajectories 500 | head -n 1")
    assert done.stdout.startswith("Table 1") and done.stderr == ""


def test_a_full_disk_is_one_line_and_the_old_file_stays(tmp_path):
    (tmp_path / "dataset_main_seed0.npz").write_bytes(b"before")
    done = shell(f"ulimit -f 40; exec {sys.executable} {ROOT}/{S1}.py --out {tmp_path}")  # no file beyond 40 KiB
    assert one_line(done, 1) and "cannot write" in done.stderr and "--out" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["dataset_main_seed0.npz"]
    assert (tmp_path / "dataset_main_seed0.npz").read_bytes() == b"before"


@pytest.mark.parametrize("stage", ["s1", "s2", "s3", "s4"])
def test_a_file_where_a_folder_is_needed(stage, request, inside, tmp_path):
    (tmp_path / "file").write_text("in the way")
    done = inside(request.getfixturevalue(stage), "--out", tmp_path / "file" / "runs")
    assert one_line(done, 1) and "cannot write" in done.stderr and "--out" in done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_end_with_one_line(number, fork, out):
    fork.start(S3, *tiny(out, updates=10 ** 6, reports=10 ** 6))
    fork.wait_for(lambda: "\nupdates" in fork.streams[0].read_text())
    done = fork.end(number)
    assert one_line(done, 1) and "--resume true" in done.stderr, done.stderr


def test_killed_three_times_it_ends_with_the_same_bits(fork, out):
    """kill -9 at random moments, each after new checkpoints; the file is whole whenever it is looked at."""
    flags = [*tiny(out, updates=160, reports=160, episode=10)]
    policy, file = out / "policy_ant_semi_seed0.pt", out / "policy-checkpoint_ant_semi_seed0.pt"

    def train_to_the_end():
        fork.start(S3, *flags, "--resume", "true")
        fork.wait_for(policy.exists)
        fork.end(signal.SIGKILL)  # what comes is measured and drawn
        found = outcome(out, "ant_semi")
        policy.unlink()
        file.unlink()
        return found
    whole, reached = train_to_the_end(), []
    for _ in range(3):
        fork.start(S3, *flags, "--resume", "true")
        seen = set()
        fork.wait_for(lambda seen=seen: seen.add(file.exists() and file.stat().st_mtime_ns) or len(seen) > 4)
        assert fork.end(signal.SIGKILL).returncode == -signal.SIGKILL
        reached.append(common.load(out, "policy-checkpoint", "ant_semi", 0)["numbers"][1])
    assert reached == sorted(set(reached)) and reached[-1] < 30, "finished before the last kill"
    assert same(whole, train_to_the_end())


# ---------------------------------------------------------------- what makes no sense

@pytest.mark.parametrize("flags, message", [
    ("--decoder polar", "the decoder polar has axes x y"),
    ("--decoder speed_acc", "predicts 1 coordinates"),
    ("--experiment ant_dads --decoder speed_acc", "predicts 1 coordinates"),
    ("--experiment half_cheetah --decoder main", "predicts 2 coordinates"),
    ("--experiment half_cheetah --base_frame true", "--base_frame false"),
    ("--experiment ant_sectar --z_dim 2", "--z_dim 3 or more"),
    ("--experiment ant_dads --robot half_cheetah", "--robot ant"), ("--experiment ant_dads --z_dim 3", "--z_dim 2"),
    ("--decoder nope", "python 02_train_wetvae.py --seed 0 --experiment nope or its beginning"),
    ("--experiment ant_full --decoder_seed 7", "python 02_train_wetvae.py --seed 7 --experiment full_circle or its beginning"),
    ("--robots 2.5", "a whole number"), ("--decoder_seed 7", "python 02_train_wetvae.py --seed 7 --experiment main or its beginning"),
    ("--method ppo", "--method is wedis, dads or sectar"), ("--robot dog", "--robot is ant or half_cheetah"),
    ("--train false --seed 98", "python 03_train_policy.py --seed 98 --experiment ant_semi"),
    ("--averaged 0.0", "must be above 0"), ("--discount 1", "below 1"), ("--relabelled 2", "at most 1"),
    ("--skill_steps 7", "--skill_steps must divide --episode"),
    ("--updates 0", "--updates"), ("--multi_run 5", "2 numbers")])
def test_03_ends_in_one_line_before_training(flags, message, s3, inside, out, monkeypatch):
    monkeypatch.setattr(s3.Run, "__init__", lambda *_: pytest.fail("it trains"))
    done = inside(s3, *tiny(out), *flags.split())
    assert one_line(done, 2) and message in done.stderr, done.stderr


def test_a_checkpoint_of_another_decoder_is_one_line_and_a_weak_decoder_is_said_aloud(s3, inside, out):
    done = inside(s3, *tiny(out))
    assert done.returncode == 0 and "no latent" not in done.stdout
    model = common.load(out, "wetvae", "main", 0)
    common.save(out, "wetvae", "main", 0, {}, **{key: model[key] for key in ("decoder", "names", "relation", "ranges", "length")},
                abs_corr=[0.9, 0.1, 0.9])
    done = inside(s3, *tiny(out), "--resume", "true")
    assert one_line(done, 2) and "has DECODER_SHA256 = " in done.stderr
    assert "the decoder main has no latent that means direction" in done.stdout
    common.save(out, "wetvae", "main", 0, {}, decoder=common.Decoder(3, 2, 16), abs_corr=[0.9] * 3,
                **{key: model[key] for key in ("names", "relation", "ranges", "length")})
    done = inside(s3, *tiny(out), "--train", "false")
    assert one_line(done, 2) and "another decoder main" in done.stderr


@pytest.mark.parametrize("experiment", ["ant_semi", "ant_dads", "ant_sectar"])
def test_a_loss_that_is_not_finite_overwrites_nothing(experiment, s3, inside, out):
    flags = [*tiny(out, updates=320), "--experiment", experiment]
    before = common.save(out, "policy", experiment, 0, {}, v=1).read_bytes()
    done = inside(s3, *flags, "--learning_rate", 1e30)
    assert one_line(done, 1) and "not finite" in done.stderr and "--resume true" in done.stderr, done.stderr
    assert (out / f"policy_{experiment}_seed0.pt").read_bytes() == before


# ---------------------------------------------------------------- every constant of every stage

STAGES = {name: script(name) for name in (S1, S2, S3, S4)}
SMALL = {S1: dict(TRAJECTORIES=300), S2: dict(EPOCHS=1, BATCH=100, HIDDEN=8, THREADS=1, RESUME=False),
         S3: {key.upper(): common.convert(str(value), getattr(STAGES[S3], key.upper()), key)
              for key, value in TINY.items()},
         S4: dict(TRIALS=1, SAMPLES="4", HOLD=2, EPISODE=20, POOL=64, DRAW="", MAZES="maze1", THREADS=1)}
BASELINES = dict.fromkeys("Z_DIM RECENT EXPLORE KL_WEIGHT".split(), "ant_sectar") | dict.fromkeys(
    "MODEL_BATCH PRIOR_SAMPLES".split(), "ant_dads")
DRIVING = ("OUT", "DRIVE", "SECONDS", "PORT")  # test_drive.py
CASES = [(stage, "") for stage in STAGES]  # nothing is changed: the small stages themselves
CASES += [(stage, name) for stage, module in STAGES.items() for name, value in vars(module).items()
         if name.isupper() and isinstance(value, (bool, int, float, str, tuple)) and name not in DRIVING
         and name not in vars(common)]
DATA = dict(names=np.array(["speed", "direction", "curvature"]), ranges=np.array([(0, 1), (-1.57, 1.57), (-0.5, 0.5)]))
DRAWN = np.random.default_rng(0).uniform(DATA["ranges"][:, 0], DATA["ranges"][:, 1], (300, 3))
DRAWN[::5, 2] = 0
DATA |= dict(factors=DRAWN.astype(np.float32), trajectories=STAGES[S1].make_trajectories(*DRAWN.T).astype(np.float32))


def changes(value):
    """What a reader might write in the file instead of a value."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, str):
        return ["nonsense"]
    if isinstance(value, tuple):
        return [tuple(2 * part for part in value), (0, 0), (-1, 3), (1.5, 2.5)]
    return [2 * value, 0, -3]


@pytest.mark.parametrize("stage, name", CASES, ids=[f"{stage[:2]} {name}" for stage, name in CASES])
def test_every_constant_can_be_changed_in_the_file(stage, name, inside, out, monkeypatch):
    """It works, or ends in one line: never a traceback."""
    module = STAGES[stage]
    experiment = BASELINES.get(name, module.EXPERIMENT)
    for key, value in (SMALL[stage] | dict(OUT=str(out), EXPERIMENT=experiment)).items():
        monkeypatch.setattr(module, key, value)
    row = {}
    if stage == S2:
        common.save(out, "dataset", "main", 0, {}, **DATA)
    if stage == S3:
        method = dict(ant_dads="dads", ant_sectar="sectar").get(experiment, "wedis")
        row = dict(METHOD=method, Z_DIM=4 if method == "sectar" else 2)
        if name not in ("FIGURE", "SINGLE_RUN", "MULTI_RUN"):
            monkeypatch.setattr(module, "draw_skills", lambda policy: None)
    if stage == S4:
        make_policy(out, "ant_semi")
        module.load_once.cache_clear()
    monkeypatch.setitem(module.EXPERIMENTS, experiment, {key: value for key, value in row.items() if key != name})
    if not name:
        assert inside(module).returncode == 0
    for value in changes(getattr(module, name)) if name else ():
        monkeypatch.setattr(module, name, value)
        done = inside(module)
        assert done.returncode == 0 and not done.stderr or one_line(done), f"{name} = {value}: {done.stderr}"
