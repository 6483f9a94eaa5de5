"""What happens to people: Ctrl-C, kill -9, a full disk, a notebook's environment, settings that make no sense, and
every constant changed. An error is one line, and nothing that was saved is lost."""
import os
import re
import signal
import subprocess
import sys
import typing

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
    assert done.stdout.startswith("wrote ") and done.stdout.count("\n") == 1 and done.stderr == ""


@pytest.mark.parametrize("text", ["text.usetex: True", "backend: TkAgg\nfont.family: No Such Font\naxes.unicode_minus: maybe"])
def test_a_readers_matplotlibrc_does_not_matter(text, tmp_path):
    (tmp_path / "matplotlibrc").write_text(text)
    done = cli(S1, "--out", tmp_path, "--trajectories", 500, MATPLOTLIBRC=str(tmp_path / "matplotlibrc"))
    assert done.returncode == 0 and (tmp_path / "figures/fig09_dataset.png").stat().st_size > 10_000, done.stderr
    assert "Traceback" not in done.stderr and "findfont" not in done.stderr


@pytest.mark.parametrize("library", ["osmesa", "nonsense", "glfw"])
def test_a_stage_that_renders_nothing_needs_no_gl_library(library, tmp_path):
    """MUJOCO_GL may name a library that is not there: it does not count."""
    done = cli(S1, "--out", tmp_path, "--trajectories", 500, MUJOCO_GL=library)
    assert done.returncode == 0 and not done.stderr, done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere MuJoCo's own choice stays")
@pytest.mark.parametrize("found, chosen", [(None, "disable"), ("libEGL.so.1", "egl")])
def test_mujoco_renders_with_egl_or_not_at_all(found, chosen):
    code = f"import ctypes.util, os, sys; sys.path.insert(0, {str(ROOT)!r}); sys.modules['mujoco'] = None\n" \
           f"ctypes.util.find_library = dict(EGL={found!r}).get\n" \
           "try: import common\nexcept ImportError: print(os.environ['MUJOCO_GL'])"  # chosen before mujoco loads
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | dict(MUJOCO_GL="glfw"))
    assert done.stdout == chosen + "\n", done.stderr


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
        reached.append(common.load(out, "policy-checkpoint", "ant_semi", 0)["env_steps"])
    assert reached == sorted(set(reached)) and reached[-1] < 8 * 30, "finished before the last kill"
    assert same(whole, train_to_the_end())


# ---------------------------------------------------------------- what makes no sense

@pytest.mark.parametrize("flags, message", [
    ("--decoder polar", "the decoder polar has axes x y"),
    ("--decoder speed_acc", "predicts 1 coordinates"),
    ("--experiment ant_dads --decoder speed_acc", "predicts 1 coordinates"),
    ("--experiment half_cheetah --decoder main", "predicts 2 coordinates"),
    ("--experiment half_cheetah --base_frame true", "--base_frame false"),
    ("--experiment ant_dads --robot half_cheetah", "--robot ant"), ("--experiment ant_dads --z_dim 3", "--z_dim 2"),
    ("--decoder nope", "python 02_train_wetvae.py --seed 0 --experiment nope"),
    ("--experiment ant_full --seed 7", "python 02_train_wetvae.py --seed 7 --experiment full --out "),
    ("--robots 2.5", "a whole number"), ("--decoder_seed 7", "unrecognized arguments: --decoder_seed"),
    ("--experiment ant_dads --multi_run 2,5", "must be 1"), ("--robots 1e7", "lower --replay or --robots"),
    ("--replay 1e12", "lower --replay or --robots"),
    ("--method ppo", "--method is wedis, dads or sectar"), ("--robot dog", "--robot is ant or half_cheetah"),
    ("--train false", "python 03_train_policy.py --seed 0 --experiment ant_semi"),
    ("--seed 98", "python 02_train_wetvae.py --seed 98 --experiment main"),
    ("--smoothing -0.1", "a number from 0 to 1"), ("--discount 1", "below 1"), ("--relabelled 2", "a number from 0 to 1"),
    ("--step_scale 0", "a number above 0"), ("--single_run 1,2.5", "--single_run is '2.5', but must be a whole number"),
    ("--hidden 1e6", "lower --hidden"), ("--threads 1e12", "--threads is '1e12', but must be a whole"),
    ("--starts 1e10", "lower --starts"),
    ("--updates 0", "--updates"), ("--multi_run 5", "2 numbers")])
def test_03_ends_in_one_line_before_training(flags, message, s3, inside, out, monkeypatch):
    monkeypatch.setattr(s3, "start_robots", lambda: pytest.fail("it trains"))
    monkeypatch.setattr(s3, "Replay", lambda **_: pytest.fail("it takes memory"))
    done = inside(s3, *tiny(out), *flags.split())
    assert one_line(done, 2) and message in done.stderr, done.stderr


def test_a_checkpoint_of_another_decoder_is_one_line(s3, inside, out):
    assert inside(s3, *tiny(out)).returncode == 0
    model = common.load(out, "wetvae", "main", 0)
    common.save(out, "wetvae", "main", 0, {}, **{key: model[key] for key in ("decoder", "names", "relation", "ranges", "length")},
                abs_corr=[0.9, 0.1, 0.9])
    done = inside(s3, *tiny(out), "--resume", "true")  # the same decoder in another file: it may go on
    assert done.returncode == 0, done.stderr
    common.save(out, "wetvae", "main", 0, {}, decoder=common.Decoder(3, 2, 16), abs_corr=[0.9] * 3,
                **{key: model[key] for key in ("names", "relation", "ranges", "length")})
    for flag in ("--resume", "true"), ("--train", "false"):
        done = inside(s3, *tiny(out), *flag)
        assert one_line(done, 2) and "another decoder main" in done.stderr and "train anew" in done.stderr
    assert inside(s3, *tiny(out)).returncode == 0  # the mend that it names


@pytest.mark.parametrize("flags", ["--robots 1 --warm_up 1", "--experiment ant_sectar --z_dim 1"])
def test_the_smallest_trainings_run(flags, s3, inside, out):
    """One random step has no deviation; SeCTAR's z may be a number."""
    done = inside(s3, *tiny(out), *flags.split())
    assert done.returncode == 0 and not done.stderr, done.stderr


@pytest.mark.parametrize("experiment", ["ant_semi", "ant_dads", "ant_sectar"])
def test_a_loss_that_is_not_finite_overwrites_nothing(experiment, s3, inside, out):
    flags = tiny(out, updates=320, experiment=experiment)
    before = common.save(out, "policy", experiment, 0, {}, v=1).read_bytes()
    done = inside(s3, *flags, "--learning_rate", 1e30)
    assert one_line(done, 1) and "not finite" in done.stderr and "--resume true" in done.stderr, done.stderr
    assert (out / f"policy_{experiment}_seed0.pt").read_bytes() == before


# ---------------------------------------------------------------- every constant of every stage

STAGES = {name: script(name) for name in (S1, S2, S3, S4)}
KINDS = {name: {constant: kind for constant, kind in common.types_of(vars(module)).items()} for name, module in STAGES.items()}
CASES = [(stage, name) for stage, kinds in KINDS.items() for name in kinds]
EACH = pytest.mark.parametrize("stage, name", CASES, ids=[f"{stage[:2]} {name}" for stage, name in CASES])
SMALL = {S1: dict(TRAJECTORIES=300), S2: dict(EXPERIMENT="main", EPOCHS=1, BATCH=100, HIDDEN=8),
         S3: {key.upper(): value for key, value in TINY.items()},
         S4: dict(TRIALS=1, SAMPLES=4, HOLD=2, EPISODE=20, POOL=64, DRAW="", MAZES="maze1", THREADS=1)}
DADS, SECTAR = dict(METHOD="dads", Z_DIM=2, MULTI_RUN="1 4"), dict(METHOD="sectar", Z_DIM=4)
WITH = {  # what else is set so that a constant means something, or fits
    **{(S3, name): DADS for name in "MODEL_BATCH MODEL_UPDATES PRIOR_SAMPLES RECENT".split()},
    (S3, "Z_DIM"): SECTAR, (S3, "EPISODE"): dict(SKILL_STEPS=1), (S2, "EPOCHS"): dict(BATCH=300),
    (S1, "ACCELERATION"): dict(FACTORS="speed acceleration")}
HERE = ("OUT",)  # of the test
DATA = dict(names=np.array(["speed", "direction", "curvature"]), ranges=np.array([(0, 1), (-1.57, 1.57), (-0.5, 0.5)]))
DRAWN = np.random.default_rng(0).uniform(DATA["ranges"][:, 0], DATA["ranges"][:, 1], (300, 3))
DRAWN[::5, 2] = 0


@pytest.fixture
def small(inside, out, monkeypatch):
    """small(stage, name="", value=None, *flags) -> a small run of a stage in whose file a constant is set to a value."""
    def run(stage, name="", value=None, *flags):
        module, many = STAGES[stage], 7 if (stage, name, value) == (S2, "BATCH", 2048) else 1
        if stage == S2:
            drawn = np.tile(DRAWN, (many, 1))
            common.save(out, "dataset", "main", 0, {}, **DATA, factors=drawn.astype(np.float32),
                        trajectories=STAGES[S1].make_trajectories(*drawn.T).astype(np.float32))
            if name not in ("", "Z_RANGE"):  # it takes longer than the training
                monkeypatch.setattr(module, "find_relation", lambda *_: {})
        if stage == S3 and name not in ("", "FIGURE", "SINGLE_RUN", "MULTI_RUN"):
            monkeypatch.setattr(module, "draw_skills", lambda policy: None)
        if stage == S4 and not (out / "policy_ant_semi_seed0.pt").exists():
            make_policy(out, "ant_semi")
        changed = SMALL[stage] | dict(OUT=str(out)) | WITH.get((stage, name), {})
        for key, written in (changed | {name: value} if name else changed).items():
            monkeypatch.setattr(module, key, written)
        return inside(module, *flags)
    return run


@pytest.mark.parametrize("stage", STAGES)
def test_a_small_stage_runs_and_each_constant_may_be_written_in_another_notation(stage, small, monkeypatch):
    """512 / 2, 1e4 and 256.0 for whole numbers, 9 for 9.0, a list or text for a tuple, all at once; and from end to end."""
    assert small(stage).returncode == 0
    module, config = STAGES[stage], {}

    def parsed(stage, flags=()):
        config.update(common.parse_flags(stage, list(flags))[0])
        return config.copy()
    before, values = parsed(vars(module)), {name: getattr(module, name) for name in KINDS[stage]}
    other = {}
    for name in KINDS[stage]:
        value = values[name] = before[name]
        if isinstance(value, tuple):
            other[name] = [float(part) for part in value] if name < "P" else " ".join(map(str, value))
        elif isinstance(value, int) and not isinstance(value, bool):
            other[name] = float(value)
        elif isinstance(value, float) and value % 1 == 0:
            other[name] = int(value)
    assert len(other) > 3
    for name, value in other.items():
        monkeypatch.setattr(module, name, value)
        assert type(getattr(module, name)) is not type(values[name])
    after = parsed(vars(module))
    assert after == before and [*map(type, after.values())] == [*map(type, before.values())]
    for name, value in other.items():
        monkeypatch.setattr(module, name, value)  # parse_flags has set them
    done = small(stage)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("stage", STAGES)
def test_a_stage_runs_whose_constants_have_lost_their_types(stage, small, tmp_path, monkeypatch, capsys):
    """`BETA = 4` for `BETA: float = 9.0`, everywhere but in pairs that are then set to text; and a fraction by flag over it."""
    text = (ROOT / f"{stage}.py").read_text()
    bare = re.sub(r"^(?!EXPERIMENT|SAMPLES|SINGLE_RUN|MULTI_RUN)([A-Z_]+): [^=\n]+ = ", r"\1 = ", text, flags=re.M)
    (tmp_path / f"{stage}.py").write_text(bare)
    module = script(tmp_path / stage)
    assert len(module.__annotations__) < 5 and list(common.types_of(vars(module))) == list(KINDS[stage])
    if stage == S3:  # what a policy, or a checkpoint, must share with the run that uses it
        assert module.made_with() == STAGES[S3].made_with() and "DISCOUNT" in module.made_with()
    monkeypatch.setitem(STAGES, stage, module)
    done = small(stage)
    assert done.returncode == 0, done.stderr
    for name, kind in KINDS[stage].items():
        if kind in (float, common.Share, common.Positive, common.Degrees, common.Signed):
            setattr(module, name, 1)
            assert common.parse_flags(vars(module), [f"--{name.lower()}", "0.375", "--out", str(tmp_path)])[0][name] == 0.375


@EACH
def test_a_fraction_by_flag_over_a_whole_number_in_the_file_and_nonsense(stage, name, tmp_path, monkeypatch, capsys):
    module, kind = STAGES[stage], KINDS[stage][name]

    def refused(nonsense):
        with pytest.raises(SystemExit) as end:
            common.convert(nonsense, kind, f"--{name.lower()}")
        error = capsys.readouterr().err
        return end.value.code == 2 and len(error.splitlines()) == 1 and f"--{name.lower()} is " in error
    if kind in (float, common.Share, common.Positive, common.Degrees, common.Signed):
        for key in KINDS[stage]:
            monkeypatch.setattr(module, key, getattr(module, key))  # to be put back
        monkeypatch.setattr(module, "OUT", str(tmp_path))
        setattr(module, name, 1)
        assert common.parse_flags(vars(module), [f"--{name.lower()}", "0.375"])[0][name] == 0.375 == getattr(module, name)
        assert common.convert("3e-1", kind, name) == 0.3 and type(common.convert(1, kind, name)) is float
    if kind in (int, common.Count, common.Threads):
        assert [common.convert(value, kind, name) for value in (512 / 2, "256.0", "2.56e2")] == [256] * 3
        assert type(common.convert(1e3, kind, name)) is int
        assert all(map(refused, (2.5, "1/2", 2 ** 63, "1e20", *([0] if kind is not int else []))))
    if kind is not str:
        assert all(map(refused, ("many", None, float("nan"), [], {}, "1 2 3 x", "", 1e400)))
    if kind not in (str, common.Signed):
        assert refused(-7)


def papers_values():
    """{(stage, name): the paper's value} of each constant whose comment says "(the paper: X)"."""
    found = {}
    for stage, module in STAGES.items():
        for line in (ROOT / f"{stage}.py").read_text().splitlines():
            name, text = line.partition(":")[0], re.search(r"\(the paper: ([^)]*)", line.partition("  # ")[2])
            if name in KINDS[stage] and text:
                number = re.search(r"\d+(,\d{3})*(\.\d+)?(e-?\d+)?", text[1])
                value = getattr(module, name)
                if isinstance(value, bool):
                    found[stage, name] = False if text[1] in ("no", "false") else not value
                else:
                    found[stage, name] = float(number[0].replace(",", "")) if number else text[1]
    return found


PAPER = papers_values()
TOO_LONG = {(S3, "UPDATES"): 1_920_000}  # a day
NO_NUMBER = {(S4, "POOL"): "no pool"}
ONE_LINE = {  # values that are in range and rightly end in one line; of a learning rate also: with code 1
    (S1, "LENGTH"): [1], (S1, "DIRECTION"): [0], (S1, "CURVATURE"): [0], (S1, "SPEED_LOW"): [-1, 1], (S1, "STRAIGHT"): [1],
    (S1, "ACCELERATION"): [0], (S3, "DISCOUNT"): [1], (S4, "EPISODE"): [1],
    (S2, "SEED"): [1]}  # there is no such data set
OFF = {  # constants that 0 switches off, whatever their declared types
    S1: "SPEED_LOW STRAIGHT", S2: "GAMMA BETA BETA_WARM_UP",
    S3: "RELABELLED DECAY_FROM AVERAGED DISCOUNT SMOOTHING REWARD_SCALE TEMPERATURE FLOOR_START FLOOR_END",
    S4: "PENALTY REWARD_WEIGHT EPSILON RADIUS Z_RANGE"}
MAY_DIVERGE = [(S2, "LEARNING_RATE"), (S3, "LEARNING_RATE")]


def runs(stage, name):
    """The values with which a small stage must run: 1 of a count; 0, 1 and its own value as a whole number of others, if in
    range; the paper's."""
    kind, value = KINDS[stage][name], getattr(STAGES[stage], name)
    whole = int(value) if isinstance(value, float) and value % 1 == 0 else 1
    found = {common.Count: [1], common.Threads: [1], int: [0, 1], float: [0, 1, whole], common.Share: [0, 1], common.Positive: [1, whole],
             common.Degrees: [0, 1, 180, whole], common.Signed: [-1, 0, 1]}.get(kind, [])
    if typing.get_origin(kind) is tuple:
        first = typing.get_args(kind)[0]
        found = [1, (1, 2), [1.0]] if typing.get_args(kind)[1] is Ellipsis else [(1, 1), "1 2"]
        if first is common.Signed:
            found += [(-3, 0.5), "-3 4"]
        if name == "POLICY_SEEDS":
            found = [0]
    if name in OFF[stage].split():
        found = [0, *found]
    if (stage, name) in PAPER and (stage, name) not in TOO_LONG and (stage, name) not in NO_NUMBER:
        found = [*found, PAPER[stage, name]]
    return list(dict.fromkeys(tuple(one) if isinstance(one, list) else one for one in found))


def test_the_papers_values_are_found():
    assert len(PAPER) > 14 and PAPER[S3, "HIDDEN"] == 512 and PAPER[S2, "OWN_AXIS"] is False and PAPER[S3, "FLOOR_END"] == 0
    for found in (TOO_LONG, NO_NUMBER):
        assert all(PAPER[key] == value for key, value in found.items())
    assert all(isinstance(value, (int, float)) for key, value in PAPER.items() if key not in NO_NUMBER)


@EACH
def test_values_that_must_run(stage, name, small):
    """Exit 0: 0 switches off, 1 of each count, the paper's value, whole numbers for fractions. Others that are in range, and
    make no sense, are listed and end in one line."""
    for value in runs(stage, name) if name not in HERE else ():
        done = small(stage, name, value)
        if value in ONE_LINE.get((stage, name), []):
            assert one_line(done, 2), (value, done.stderr)
        elif (stage, name) in MAY_DIVERGE and done.returncode:
            assert one_line(done, 1) and "not finite" in done.stderr, (value, done.stderr)
        else:
            assert done.returncode == 0 and not done.stderr, (value, done.stderr)


@pytest.mark.parametrize("stage", [S3, S4])
@pytest.mark.parametrize("name", "FEEDBACK CORRECTION".split())
def test_what_is_switched_off_in_common_runs(stage, name, small, out, monkeypatch):
    monkeypatch.setattr(common, name, 0)
    done = small(stage, "FIGURE" if stage == S3 else "", "x")
    assert done.returncode == 0 and not done.stderr and "unstable" not in done.stdout, (done.stdout, done.stderr)
    rows = common.read_csv(out / f"results/{'policies' if stage == S3 else 'mazes'}.csv")
    distance = [float(row["tracking_error_closed" if stage == S3 else "final_distance"]) for row in rows]
    assert np.isfinite(distance).all()
    assert common.load(out, "policy", "ant_semi", 0)["config"][name] == 0


@pytest.mark.parametrize("flags", [["--goal", "3 -4"], ["--goal", "-3,4"], ["--goal", "-.5 -3e0"], ["--samples", "3,5"],
                                   ["--samples", "3 5"], ["--penalty", "0", "--radius", "0"], ["--goal=-3 4"]])
def test_numbers_by_flag_in_the_mazes(flags, small, out):
    done = small(S4, "", None, *flags)
    assert done.returncode == 0 and not done.stderr, done.stderr
    rows = common.read_csv(out / "results/mazes.csv")
    assert {row["samples"] for row in rows} == ({"3", "5"} if "--samples" in flags else {"4"})


@pytest.mark.parametrize("flags, message", [
    (["--goal", "3"], "--goal is '3', but must be 2 numbers"), (["--goal", "3 4 5"], "--goal"), (["--samples", "3,x"], "--samples is 'x'"),
    (["--penalty", "-1e2"], "--penalty is '-1e2', but must be a number of at least 0"), (["--trials", "1e9"], "--trials"),
    (["--samples", "1e12"], "lower --samples"), (["--goal", "12, 15.5", "--mazes", "maze2", "--radius", "-1"], "--radius is '-1'")])
def test_numbers_that_do_not_fit_the_mazes(flags, message, small):
    done = small(S4, "", None, *flags)
    assert one_line(done, 2) and message in done.stderr, done.stderr


@pytest.mark.parametrize("what", ["FRAME_SKIP", "ant.xml", "half_cheetah.xml", "CLASSES", "FEEDBACK"])
def test_mazes_are_for_policies_that_learnt_with_the_same_physics(what, small, out, tree, monkeypatch):
    assert small(S4).returncode == 0
    if what.endswith("xml"):
        file = tree / "robots" / what
        file.write_text(file.read_text().replace("<!--", "<!-- edited ", 1) + "<!-- edited -->")
    else:
        monkeypatch.setattr(common, what, dict(FRAME_SKIP=4, CLASSES=common.CLASSES | dict(x=5), FEEDBACK=0.5)[what])
    done = small(S4)
    if what in ("FRAME_SKIP", "ant.xml"):
        assert one_line(done, 2) and f"made with {what} = " in done.stderr, done.stderr
        return
    assert done.returncode == 0, done.stderr
    settings = [row["settings"] for row in common.read_csv(out / "results/mazes.csv")]
    assert len(settings) == 12 if what == "FEEDBACK" else len(settings) in (6, 12)  # a row of other settings stays
    assert small(S4).returncode == 0 and len(common.read_csv(out / "results/mazes.csv")) == len(settings)


@EACH
def test_every_constant_can_be_changed_in_the_file(stage, name, small):
    """It works, or ends in one line: never a traceback."""
    value = getattr(STAGES[stage], name)
    if name in HERE:
        return
    if isinstance(value, bool):
        changes = [not value]
    elif isinstance(value, str):
        changes = ["nonsense", ""]
    elif isinstance(value, tuple):
        changes = [(3, 5), (0, 0), (2,), (1, 2, 3)]
    else:
        changes = [2 * SMALL[stage].get(name, value), 1.5]
    for changed in changes:
        done = small(stage, name, changed)
        assert done.returncode == 0 and not done.stderr or one_line(done), f"{name} = {changed}: {done.stderr}"
