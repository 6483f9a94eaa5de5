"""Stage 4: geometry against dense sampling, Algorithm 2 against plain loops, rewards counted by hand, Table 2 and the
claims, rows and flags, results that are resumed or not, the command line. All policies here are tiny and untrained."""
from types import SimpleNamespace

import claims
import common
import numpy as np
import pytest
import torch
from conftest import cli, load_policy

COLUMNS = ("maze reward method mode look_ahead samples trial seed final_distance success planning_ms "
           "policy_seed policy settings").split()


def make_policy(folder, experiment, seed=0, decoder=None, **changed):
    """Save a tiny policy artifact and return it as stage 4 loads it."""
    torch.manual_seed(seed)
    decoder = decoder or common.Decoder(3, 2, 16)
    content = dict(actor=common.Actor(27, 2, 8, 8, True), decoder=decoder, method="wedis", robot="ant",
                   names=["speed", "direction", "curvature"], relation=dict(curvature=0.3), scale=0.1)
    common.save(folder, "policy", experiment, seed, {}, **content | changed)
    return load_policy(folder, experiment, seed)


@pytest.fixture(scope="session")
def policies(tmp_path_factory):
    """A folder with three policies of WEDIS, two of each baseline, and one of another robot."""
    folder = tmp_path_factory.mktemp("policies")
    for seed in (0, 1, 2):
        make_policy(folder, "ant_semi", seed)
    baseline = dict(names=[], relation={})
    for seed in (0, 1):
        make_policy(folder, "ant_dads", seed, decoder=common.Decoder(2, 2, 8), method="dads", **baseline)
        make_policy(folder, "ant_sectar", seed, decoder=common.Decoder(2, 2, 8), method="sectar", **baseline)
    make_policy(folder, "half_cheetah", decoder=common.Decoder(2, 1, 8), robot="half_cheetah")
    return folder


@pytest.fixture
def out(policies, tmp_path):
    for path in policies.glob("*.pt"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


@pytest.fixture
def stage(s4, out, monkeypatch, capsys):
    """Runs stage 4 in this process, small unless flags say else: stage(*flags) -> exit code, rows, stdout, stderr."""
    (out / "nothing").mkdir()
    for robot in ("ant.xml", "half_cheetah.xml"):
        (out / "nothing" / robot).write_bytes((common.HERE / robot).read_bytes())
    monkeypatch.setattr(s4.common, "HERE", out / "nothing")  # what is shipped must not matter
    small = dict(out=out, trials=2, samples=4, episode=200, pool=64, threads=1, draw="fig06")

    def run(*flags, **changed):
        given = {name: value for name, value in (small | changed).items() if value is not None}
        monkeypatch.setattr("sys.argv", ["04_mpc_maze.py", *(
            text for name, value in given.items() for text in ("--" + name, str(value))), *flags])
        fresh = {name: value for name, value in vars(s4).items() if isinstance(value, (bool, int, float, str, tuple))}
        s4.load_once.cache_clear()
        code = 0
        try:
            s4.main()
        except SystemExit as end:
            code = end.code
        experiment = s4.EXPERIMENT
        vars(s4).update(fresh)
        path = out / "results" / f"{experiment}.csv"
        printed = capsys.readouterr()
        rows = common.read_csv(path) if path.exists() else []
        return SimpleNamespace(code=code, rows=rows, out=printed.out, err=printed.err)
    return run


def unit(s4, out, method="wedis", maze="maze1", **changed):
    """A unit as run() gets it, in the mode `printed`, with the tiny policy of seed 0."""
    config, _ = common.parse_flags(vars(s4), ["--out", str(out)])
    u = s4.settings(method, maze, config, {})
    return SimpleNamespace(**vars(u) | dict(mode="printed", policy_seed=0, settings="x", pool=256) | changed)


# ---------------------------------------------------------------- geometry

def test_distances_are_the_papers(s4):
    assert np.hypot(*s4.GOAL) == pytest.approx(26.8, abs=0.05)  # the start is (0, 0)
    assert sum(s4.GOAL) == 36  # App. A.1.4: the effective distance


@pytest.mark.parametrize("maze, step, n, length", [("maze1", 30, 400, 2), ("s_maze", 30, 400, 2),
                                                   ("obstacles", 0.3, 400, 2), ("maze2", 2, 40, 45)])
def test_collisions_agree_with_dense_sampling(s4, maze, step, n, length):
    rng = np.random.default_rng(0)
    path = np.pad(np.cumsum(rng.uniform(-step, step, (n, length, 2)), 1), ((0, 0), (1, 0), (0, 0)))
    path += rng.uniform([-8, -8], [33, 20], (n, 1, 2))
    found = s4.collides(torch.from_numpy(path.astype(np.float32)), s4.MAZE[maze]["WALLS"], 1.0).numpy()
    points = path[:, :-1, None] + np.linspace(0, 1, 1501)[:, None] * np.diff(path, axis=1)[:, :, None]
    hit = np.zeros((n, length), bool)
    for x0, x1, y0, y1 in s4.MAZE[maze]["WALLS"]:
        hit |= ((points >= (x0 - 1, y0 - 1)) & (points <= (x1 + 1, y1 + 1))).all(3).any(2)
    assert (hit != found).sum() <= 2  # sampling misses a corner cut shorter than its step
    assert 0.05 < found.mean() < 0.95


def test_a_transition_that_stands_still_collides_where_it_stands(s4):
    still = torch.tensor([[[7.0, 0.0]] * 2, [[9.4, 0.0]] * 2, [[10.6, 0.0]] * 2])
    assert s4.collides(still, [(9, 10, -1, 1)], 0.5).flatten().tolist() == [False, True, False]


def test_no_straight_line_but_some_path_solves_each_maze(s4, out):
    ways = dict(maze1=[(0, 0), (19.5, 2), (24, 12)], maze2=[(0, 0), (6, 1), (10, 2), (15.2, 9.5), (19, 10), (24, 12)],
                s_maze=[(0, 0), (9.5, 4), (28.5, -4), (38, 0)], obstacles=[(0, 0), (4, 5), (8, 7), (17, 8)])
    assert set(ways) == set(s4.MAZE) - {"open"}
    for maze, way in ways.items():
        u = unit(s4, out, maze=maze)
        assert (way[0], way[-1]) == ((0, 0), u.goal)
        straight, bent = (torch.tensor([w], dtype=torch.float32) for w in ([way[0], way[-1]], way))
        assert s4.collides(straight, u.walls, s4.RADIUS).any(), maze
        assert not s4.collides(bent, u.walls, s4.RADIUS).any(), maze


def test_walls_stop_the_ant(s4):
    robots = common.Robots(s4.maze_spec(SimpleNamespace(walls=[(1.2, 2.2, -5, 5)], goal=(3.0, 0.0))), 2, 1)
    robots.qpos[1, 0] = -20
    for _ in range(60):
        robots.qvel[:, 0] = 1  # pushed along x
        robots.step(np.zeros((2, 8)))
    assert robots.qpos[0, 0] < 1.2 and robots.qpos[1, 0] > -20 + 2


# ---------------------------------------------------------------- Algorithm 2

@pytest.fixture
def lively(policies):
    """A decoder whose paths differ."""
    torch.manual_seed(0)
    decoder = common.Decoder(3, 2, 16).requires_grad_(False)
    decoder.head[2].weight *= 20
    return SimpleNamespace(decoder=decoder, names=["speed", "direction", "curvature"], relation=dict(curvature=0.3),
                           method="wedis", scale=0.1, sha256="0" * 64)


def test_skills_are_those_of_app_a14(s4, out, lively):
    """U(-1.5, 1.5), of the speed U(0, 1.5)."""
    z, _ = s4.skill_pool(unit(s4, out, policy=lively, pool=4096))
    assert z.shape == (4096, 3) and z.abs().max() <= 1.5
    assert z[:, 0].min() >= 0 and z[:, 1:].min(0).values.max() < -1.49
    assert z.mean(0).tolist() == pytest.approx([0.75, 0, 0], abs=0.06)
    lively.names = []  # of DADS and SeCTAR: all axes alike
    z, _ = s4.skill_pool(unit(s4, out, policy=lively, pool=4096))
    assert z.min(0).values.max() < -1.49


def test_printed_predicts_by_the_decoder_that_reads_its_own_mean(s4, out, lively):
    z, delta = s4.skill_pool(unit(s4, out, policy=lively))
    mean, state = torch.zeros(256, 2), None
    for t in range(5):
        state = lively.decoder.cell(torch.cat([mean, z], 1), state)
        mean = lively.decoder.head(state[0])[:, :2]
        torch.testing.assert_close(delta[:, t], mean)
    assert delta.std() > 0.02


def test_closed_loop_predicts_by_first_steps_and_the_relation_function(s4, out, policies):
    policy = load_policy(policies, "ant_semi", 0)
    z, delta = s4.skill_pool(unit(s4, out, policy=policy, mode="closed"))
    for t in range(5):
        single = torch.stack([z[:, 0], z[:, 1] + 0.3 * t * z[:, 2], torch.zeros(256)], 1)  # f_dir, t times
        torch.testing.assert_close(delta[:, t], policy.decoder(single, 1)[0][:, 0], atol=1e-6, rtol=1e-4)


def test_a_scaled_arc_has_its_closed_form(s4):
    """Steps of length d that turn by a each end at d (1 - e^{iaK}) / (1 - e^{ia}); scaling stretches that by H_z."""
    angle = 0.2 * torch.arange(12)
    delta = torch.stack([torch.cos(angle), torch.sin(angle)], 1)[None]
    for scale in (0.1, 4.0):
        path = s4.scaled_path(torch.tensor([[[3.0, 4.0]]]), delta, scale)
        end = 3 + 4j + scale * (1 - np.exp(12j * 0.2)) / (1 - np.exp(0.2j))
        assert path.shape == (1, 12, 2) and path[0, -1].tolist() == pytest.approx([end.real, end.imag], rel=1e-5)


def test_rewards_are_those_of_sec_62(s4):
    u = SimpleNamespace(goal=(10.0, 0.0), walls=[(20, 21, -5, 5), (4, 5, 2, 9)], radius=1.0, penalty=100.0, reward_weight=5.0,
                        epsilon=3.0)
    path = torch.tensor([[[0.0, 0], [6, 0], [10, 4]],       # free, ends 4 m away
                         [[0.0, 0], [6, 0], [12, 0]],       # free, ends 2 m away
                         [[0.0, 0], [19, 0], [20, 0]],      # both transitions collide, ends 10 m away
                         [[0.0, 3], [8, 3], [10, 1]]])      # one collides, ends 1 m away
    assert s4.reward(path, u, "dense").tolist() == [-4, -2, -210, -101]
    assert s4.reward(path, u, "sparse").tolist() == [0, 5, -200, -95]


@pytest.mark.parametrize("kind", ["dense", "sparse"])
def test_plan_is_algorithm_2_in_plain_loops(s4, out, lively, kind):
    u = unit(s4, out, policy=lively)
    z, delta = pool = s4.skill_pool(u)
    start = torch.tensor([18.0, 6.0])
    torch.manual_seed(5)
    first, path = s4.plan(u, kind, 200, 2, pool, start)
    torch.manual_seed(5)
    best, best_path, picked = -1e9, None, torch.randint(256, (200, 2))
    for sequence in picked:
        state, states = start, [start]
        for skill in sequence:
            for step in delta[skill]:
                state = state + 0.1 * 40 * step
                states.append(state)
        r = -float((state - torch.tensor(u.goal)).norm())
        if kind == "sparse":
            r = 5.0 * (abs(r) < 5)
        for a, b in zip(states, states[1:]):
            r -= 100.0 * float(s4.collides(torch.stack([a, b])[None], u.walls, 1.0).any())
        if r > best + 1e-4:
            best, best_path, best_z = r, torch.stack(states), z[sequence[0]]
    torch.testing.assert_close(first, best_z)
    torch.testing.assert_close(path, best_path, atol=1e-4, rtol=1e-5)
    assert path.untyped_storage().nbytes() == path.numel() * 4  # no view that keeps all N in memory


def test_modes_differ_in_actions_and_in_feedback(s4, out, monkeypatch):
    policy, asked, spec = make_policy(out, "ant_semi"), [], []
    execute = s4.execute
    monkeypatch.setattr(s4, "execute", lambda p, robots, commands, hold, closed, deterministic: asked.append(
        (commands.shape, hold, closed, deterministic)) or execute(p, robots, commands, hold, closed, deterministic))
    monkeypatch.setattr(s4, "maze_spec", lambda u, make=s4.maze_spec: spec.append(u.walls) or make(u))
    for mode in ("printed", "closed"):
        u = unit(s4, out, policy=policy, mode=mode, trials=2, samples=[3], hold=4, episode=59)
        rows, examples = s4.run(u)
        assert len(rows) == 4 and [e.trial for e in examples] == [0, 1, 0, 1]
        poses = examples[0].poses
        assert poses.shape == (41, 15) and np.abs(poses[0, :2]).max() < 0.11  # the Ant starts at the origin
        assert [(step, path.shape) for step, path in examples[0].plans] == [(0, (11, 2)), (20, (6, 2))]  # H_P 3 -> 2, 1
        distance = np.hypot(*(poses[:, :2] - s4.GOAL).T)
        assert rows[0]["final_distance"] == pytest.approx(distance[-1])
        assert rows[0]["look_ahead"] == 40
        np.testing.assert_array_equal(poses[0], examples[2].poses[0])  # cases share their starts, trials do not
        assert (poses[0] != examples[1].poses[0]).any()
    assert asked == [((4, 5, 2), 4, False, False)] * 2 + [((4, 5, 2), 4, True, True)] * 2
    assert spec == [s4.MAZE["maze1"]["WALLS"]] * 2


# ---------------------------------------------------------------- tables and intervals

def test_table_2_is_the_papers(s4, out):
    """H_E, H_z, T, steps a skill, H_P dense and sparse as printed; ranges as in the text of App. A.1.4."""
    printed = dict(sectar=(600, 1, 40, 40, 4, 15, 1.5, -1.5), dads=(300, 20, 1, 20, 4, 15, 1.0, -1.0),
                   wedis_s=(600, 40, 1, 40, 4, 15, 1.5, 0), wedis_nts=(600, 1, 20, 20, 4, 30, 1.5, 0),
                   wedis=(600, 40, 5, 200, 3, 3, 1.5, 0))
    rows = claims.table2([unit(s4, out, name) for name in s4.METHODS])
    assert {row["method"]: tuple(row.values())[1:] for row in rows} == printed
    s, o = unit(s4, out, maze="s_maze"), unit(s4, out, maze="obstacles")  # the caption of Fig 18
    assert (s.length, s.hold, s.planned, o.length, o.hold, o.planned) == (6, 50, 2, 5, 50, 1)


def test_intervals_hold_policies_and_trials(s4):
    """The variance of a hierarchical bootstrap is between-policy / P + within-policy / (P n), as in a plain formula."""
    rng = np.random.default_rng(0)
    values = rng.normal(0, 1, (4, 30)) + np.array([[0], [1], [5], [6]])
    means = s4.resampled_means(values, rng)
    assert means.mean() == pytest.approx(values.mean(), abs=0.05)
    assert means.var() == pytest.approx(values.mean(1).var() / 4 + values.var(1).mean() / 120, rel=0.05)
    one = s4.resampled_means(values[:1], rng)
    assert one.var() == pytest.approx(values[0].var() / 30, rel=0.05)


def test_values_are_grouped_by_policy(s4):
    rows = [dict(maze=maze, policy_seed=str(seed), final_distance=f"{seed}.{trial}")
            for trial in range(3) for seed in (1, 0) for maze in ("a", "b")]
    found = s4.values_of(rows, "final_distance", maze="a")
    assert found.tolist() == [[1.0, 1.1, 1.2], [0.0, 0.1, 0.2]]
    assert not s4.values_of(rows, "final_distance", maze="c").size


def test_claims_are_judged_by_the_interval_of_the_difference(s4):
    rng = np.random.default_rng(0)
    rows = [dict(maze="maze1", reward="dense", method=method, mode="printed", samples=samples, policy_seed=str(seed),
                 final_distance=str(d))
            for method, samples, mean in (("wedis", "1000", 2), ("wedis", "100", 9), ("wedis_s", "1000", 9),
                                          ("wedis_nts", "1000", 5), ("sectar", "1000", 20))
            for seed in range(2) for d in rng.normal(mean, 1, 30)]
    found = claims.comparisons(rows, s4)
    by = {(row["claim"].split()[-1], row["better"], row["worse"]): row for row in found}
    assert by["cases", "wedis", "wedis_s"]["verdict"] == by["cases", "wedis", "wedis_nts"]["verdict"] == "holds"
    assert by["samples", "wedis", "wedis_s"]["verdict"] == "undecided"
    assert by["samples", "wedis", "wedis_nts"]["verdict"] == "does not hold"
    assert by["WEDIS-NTS", "wedis_s", "wedis_nts"]["verdict"] == "does not hold"
    assert not any("dads" in (row["better"], row["worse"]) for row in found)  # no rows, no verdict
    row = by["cases", "wedis", "wedis_s"]
    assert row["low"] < 7 < row["high"] and (row["better_policies"], row["trials"]) == (2, 30)
    assert {row["claim"] for row in found if "sectar" in row.values()} == {"SeCTAR has poor performance"}  # counts once
    lines = {line["claim"].split()[-1]: line for line in claims.counts(found)}
    assert [lines["samples"][verdict] for verdict in claims.VERDICTS] == [0, 1, 1]
    assert [lines["performance"][verdict] for verdict in claims.VERDICTS] == [3, 0, 0]


# ---------------------------------------------------------------- rows and flags

def test_flags_win_over_methods_over_mazes_over_the_file(s4, out):
    config, _ = common.parse_flags(vars(s4), ["--out", str(out)])
    s4.MAZE["mine"] = dict(WALLS=[], HOLD=30, LENGTH=4, GOAL=(1, 2), SAMPLES=7)
    s4.METHODS["other"] = dict(HOLD=25)
    u = s4.settings("other", "mine", config, dict(LENGTH=3))
    assert (u.hold, u.length, u.goal, u.samples, u.episode, u.walls) == (25, 3, (1.0, 2.0), [7], 600, [])
    assert s4.settings("other", "maze1", config, dict(HOLD=10)).hold == 10
    assert s4.settings("wedis", "maze1", config, {}).hold == 40  # rows leave no trace


def test_hold_is_a_flag_for_every_method(stage):
    ends = {hold: [row["final_distance"] for row in stage(method="dads", hold=hold, mazes="maze1").rows]
            for hold in (20, 60)}
    assert len(ends[20]) == 8 and ends[20] != ends[60]


@pytest.mark.parametrize("method", ["wedis", "wedis_s", "wedis_nts", "dads", "sectar"])
def test_each_row_of_methods_runs(s4, stage, method):
    assert method in s4.METHODS and len(s4.METHODS) == 5
    done = stage(method=method, mazes="maze1", draw="fig03 fig08 fig17")
    assert done.code == 0, done.err
    assert {row["mode"] for row in done.rows} == ({"printed", "closed"} if method == "wedis" else {"printed"})


@pytest.mark.parametrize("maze", ["maze1", "maze2", "s_maze", "obstacles", "open"])
def test_each_row_of_mazes_runs(s4, stage, maze):
    assert maze in s4.MAZE and len(s4.MAZE) == 5
    done = stage(mazes=maze, rewards="dense", modes="closed", episode=None, draw="fig06 fig18")
    assert done.code == 0, done.err
    row = done.rows[0]
    steps = dict(s_maze=600, obstacles=250).get(maze, 600)
    assert len(done.rows) == 2 and row["look_ahead"] == str(steps) and 0 < float(row["planning_ms"])


@pytest.mark.parametrize("experiment", ["mazes", "figure7", "fig18", "matched"])
def test_each_row_of_experiments_runs(s4, stage, experiment, out, monkeypatch):
    assert experiment in s4.EXPERIMENTS and len(s4.EXPERIMENTS) == 5  # and drive: test_drive.py
    flags = dict(mazes="maze2", rewards="dense")
    if experiment == "fig18":
        flags = dict(episode=600)
    if experiment in ("figure7", "matched"):
        flags["samples"] = "2 4"
    monkeypatch.setattr(s4, "can_render", lambda: True)
    monkeypatch.setattr(s4, "render", lambda model, poses, high, wide: [np.zeros((high, wide, 3), np.uint8) for _ in poses])
    done = stage(experiment=experiment, draw=None, **flags)
    assert done.code == 0, done.err
    assert list(done.rows[0]) == COLUMNS
    names = dict(mazes=["fig03_trajectory_scaling", "fig06_mazes", "fig14_robots", "fig17_more_examples"], figure7=["fig07_planning"],
                 fig18=["fig18_s_maze_obstacles"], matched=[])[experiment]
    assert sorted(path.stem for path in (out / "figures").glob("*.png")) == names
    if experiment in ("figure7", "matched"):
        policies = {(row["method"], row["policy_seed"]) for row in done.rows}
        wedis = {(method, seed) for method in ("wedis", "wedis_s", "wedis_nts") for seed in "012"}
        assert policies == wedis | {(method, seed) for method in ("dads", "sectar") for seed in "01"}


def test_sparse_plans_reach_to_the_end_of_the_episode(s4, out):
    u = unit(s4, out, "wedis_s", policy=make_policy(out, "ant_semi"), trials=1, samples=[2], episode=280)
    rows, _ = s4.run(u)
    assert {row["reward"]: row["look_ahead"] for row in rows} == dict(dense=160, sparse=280)


def test_matched_looks_equally_far_ahead(s4, out):
    policy = make_policy(out, "ant_semi")
    for method, ahead in (("wedis_s", [200, 600]), ("wedis", [200, 600])):
        u = unit(s4, out, method, policy=policy, trials=1, samples=[2], look_ahead=[200, 600], rewards=["dense"])
        assert [row["look_ahead"] for row in s4.run(u)[0]] == ahead
    u.look_ahead = [100, 200, 5000, 9999]  # what comes to the same is planned once, and none looks beyond the end
    assert [row["look_ahead"] for row in s4.run(u)[0]] == [200, 600]


def test_a_maze_of_the_readers_own_is_one_row(s4, stage, out):
    s4.MAZE["mine"] = dict(WALLS=[(3, 4, -2, 2)], GOAL=(5.0, 0.0))
    done = stage(mazes="mine", draw="fig03 fig06 fig08 fig17 gif")
    assert done.code == 0, done.err
    assert {row["maze"] for row in done.rows} == {"mine"} and "mine       dense   wedis" in done.out
    assert abs(float(done.rows[0]["final_distance"]) - 5) < 3
    assert (out / "figures" / "mine.gif").exists() or "no GIF" in done.out


def test_a_deleted_maze_and_two_methods_draw_what_is_left(s4, stage):
    del s4.MAZE["maze1"]
    done = stage(mazes="maze2", method="wedis dads", draw="fig03 fig06 fig08 fig17")
    assert done.code == 0 and "maze2      dense   wedis" in done.out, done.err


def test_fig_7_copes_with_a_method_for_one_reward(s4, stage, out):
    s4.METHODS["mine"] = dict(REWARDS="dense", MODES="printed", SAMPLES="3 7")
    done = stage(mazes="maze1", method="mine wedis", draw="fig07")
    assert done.code == 0, done.err
    assert (out / "figures" / "fig07_planning.png").stat().st_size > 10_000


def test_a_goal_written_without_points_is_in_metres_too(s4, stage, monkeypatch):
    monkeypatch.setattr(s4, "GOAL", (24, 12))
    for flags in (dict(mazes="s_maze", episode=600), dict(mazes="maze1", goal="-5 3.5"), dict(mazes="maze1")):
        done = stage(**flags, modes="closed", rewards="dense")
        assert done.code == 0, done.err


def test_trials_may_differ_by_method_and_what_cannot_be_drawn_is_said(s4, stage, monkeypatch):
    drawn = []
    monkeypatch.setattr(s4.common, "save_figure", lambda figure, out, name: drawn.append(figure))
    s4.METHODS["few"] = dict(TRIALS=1, MODES="closed")
    done = stage(method="wedis few", mazes="maze1", modes=None, trials=None, draw="fig17")
    assert done.code == 0, done.err
    assert [ax.get_title() for ax in drawn[0].axes if ax.axison].count("few closed, maze1, ant_semi seed 0") == 1
    s4.METHODS["far"] = dict(TRIALS=1, MODES="closed", POLICY_SEEDS="1")  # figures show each method's first policy
    done = stage(method="few far", mazes="maze1", modes=None, trials=None, draw="fig17")
    assert {ax.get_title() for ax in drawn[1].axes} == {f"{name}, maze1, ant_semi seed {n}" for n, name in
                                                        enumerate(("few closed", "far closed"))}
    done = stage(mazes="maze1", rewards="dense", draw="fig08")
    assert done.code == 0 and "no fig08_mpc_examples: no trial has the sparse reward" in done.out


def test_goal_and_epsilon_are_flags(stage):
    done = stage(mazes="maze1", goal="3 0.5", epsilon=2)
    assert done.code == 0, done.err
    assert all(float(row["final_distance"]) < 5 for row in done.rows)
    assert all((float(row["final_distance"]) < 2) == (row["success"] == "1") for row in done.rows)


# ---------------------------------------------------------------- results that are used again

def test_only_what_was_made_with_the_same_settings_is_used_again(s4, stage, monkeypatch):
    shown = []
    monkeypatch.setitem(s4.DRAWINGS, "fig07", lambda rows, units, examples: shown.append(rows))
    flags = dict(experiment="figure7", method="wedis", mazes="maze1", samples="2 4", rewards="dense", draw=None, hold=4,
                 episode=40)
    first = stage(**flags, policy_seeds="0 1")
    assert first.code == 0 and len(shown[0]) == 2 * 2 * 2 * 2, first.err  # modes, policies, sizes, trials
    again = stage(**flags, policy_seeds="0 1")
    assert again.out.count("already") == 4 and again.rows == first.rows and shown[1] == shown[0]

    for change in (dict(hold=8), dict(goal="20 0"), dict(trials=1), dict(seed=1), dict(samples="2")):
        changed = stage(**flags | change, policy_seeds="0")
        assert "already" not in changed.out, change
        assert {row["settings"] for row in shown[-1]}.isdisjoint(row["settings"] for row in first.rows), change
        assert {row["policy_seed"] for row in shown[-1]} == {"0"}  # another policy is not pooled into the figure
        made = {(row["mode"], row["seed"], row["policy_seed"], row["settings"]) for row in changed.rows}
        assert len(made) == len({unit[:3] for unit in made}), change  # no rows of older settings beside those
    stage(**flags, policy_seeds="0")
    monkeypatch.setattr(common, "FEEDBACK", 0.05)
    assert "already" not in stage(**flags, policy_seeds="0").out
    s4.MAZE["maze1"] = dict(WALLS=s4.HULL)
    assert "already" not in stage(**flags, policy_seeds="0").out
    assert "already" in stage(**flags, policy_seeds="0").out


def test_another_policy_under_the_same_name_is_planned_anew(stage, out):
    flags = dict(experiment="figure7", method="wedis", mazes="maze1", rewards="dense", policy_seeds="0", draw="fig06",
                 samples=4, hold=4, episode=40)
    assert stage(**flags).code == 0
    make_policy(out, "ant_semi", relation=dict(curvature=0.1))
    assert "already" not in stage(**flags).out


def test_claims_and_table_2_are_made_of_present_rows(s4, stage, out, monkeypatch, capsys):
    flags = dict(samples="100 1000", mazes="maze1", rewards="dense", episode=200, trials=2, pool=64, threads=1, out=out)
    assert stage(**flags, experiment="figure7").code == 0
    argv = [text for name, value in flags.items() for text in ("--" + name, str(value))]
    monkeypatch.setattr("sys.argv", ["claims.py", *argv])
    claims.main(s4)
    found = common.read_csv(out / "results/claims.csv")
    assert {row["verdict"] for row in found} <= set(claims.VERDICTS)
    assert len([row for row in found if row["mode"] == "printed"]) == 3 + 3 + 2 + 1 + 4
    assert len([row for row in found if row["mode"] == "closed"]) == 3 + 3 + 1
    assert len(common.read_csv(out / "results/table2.csv")) == 5
    monkeypatch.setattr("sys.argv", ["claims.py", *argv, "--goal", "20 0"])
    with pytest.raises(SystemExit):
        claims.main(s4)
    assert "holds nothing to compare" in capsys.readouterr().err


# ---------------------------------------------------------------- command line

def test_command_line_draws_everything_and_repeats_itself(fork, out):
    flags = ["--out", out, "--trials", 2, "--samples", 20, "--pool", 512, "--episode", 200, "--threads", 1]
    done = fork("04_mpc_maze", *flags)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    rows = common.read_csv(out / "results/mazes.csv")
    for maze in ("maze1", "maze2"):
        for kind in ("dense", "sparse"):
            line, = [line for line in lines if line.startswith(f"{maze:10} {kind:7} wedis ")]
            for mode in ("printed", "closed"):
                found = [row for row in rows if (row["maze"], row["reward"], row["mode"]) == (maze, kind, mode)]
                distance, success = (np.mean([float(row[name]) for row in found]) for name in ("final_distance", "success"))
                assert len(found) == 2 and f"{mode} {distance:4.1f} m {100 * success:3.0f} %" in line
    assert f"using {out / 'policy_ant_semi_seed0.pt'}" in lines
    assert len(rows) == 2 * 2 * 2 * 2 and list(rows[0]) == COLUMNS
    for name in ("fig03_trajectory_scaling", "fig06_mazes", "fig08_mpc_examples", "fig17_more_examples"):
        assert (out / "figures" / f"{name}.png").stat().st_size > 10_000
    for maze in ("maze1", "maze2"):
        if "no GIF" not in done.stdout:
            assert 10_000 < (out / "figures" / f"{maze}.gif").stat().st_size < 1e6
    assert fork("04_mpc_maze", *flags, "--draw", "fig06", "--mazes", "maze2").returncode == 0  # same seed, same numbers
    again = common.read_csv(out / "results/mazes.csv")
    assert [row | dict(planning_ms=0) for row in again] == [row | dict(planning_ms=0) for row in rows]  # maze1 stays


def test_without_a_gl_library_one_line_says_so(out):
    done = cli("04_mpc_maze", "--out", out, "--trials", 1, "--samples", 2, "--pool", 64, "--episode", 200, "--draw",
               "fig14 gif", "--threads", 1, MUJOCO_GL="disable")
    assert done.returncode == 0 and done.stdout.count("no Fig 14, no GIF: MuJoCo's renderer finds no GL library") == 1, done.stderr


@pytest.mark.parametrize("flags, line", [
    (dict(method="ppo"), "unknown 'ppo' in --method; allowed: wedis wedis_s wedis_nts dads sectar"),
    (dict(mazes="maze9"), "unknown 'maze9' in --mazes; allowed: maze1 maze2 s_maze obstacles"),
    (dict(modes="open"), "unknown 'open' in --modes; allowed: printed closed"),
    (dict(draw="fig99"), "unknown 'fig99' in --draw; allowed: "),
    (dict(draw="fig07", look_ahead="200 400"), "fig07 is for one --look_ahead"),
    (dict(samples="10 0"), "--samples is '0', but must be a whole number of at least 1"),
    (dict(samples="10 x"), "--samples is 'x', but must be a whole number"), (dict(samples=""), "--samples is ''"),
    (dict(look_ahead="200 0"), "--look_ahead is '0', but must be a whole number of at least 1"),
    (dict(policy_seeds="-1"), "--policy_seeds is '-1', but must be a whole number of at least 0"),
    (dict(policy_seeds=""), "--policy_seeds is '', but must be a whole number of at least 0"),
    (dict(trials=0), "--trials is '0', but must be a whole number of at least 1"),
    (dict(episode=100), "wedis in maze1: an episode has 100 steps, but one skill 200"),
    (dict(policy_seeds="7"), "no policy_ant_semi_seed7.pt in "),
    (dict(policy="half_cheetah"), "wedis printed, maze1, half_cheetah seed 0: mazes are for the ant"),
    (dict(method="dads", modes="closed"), "dads closed, maze1, ant_dads seed 0: mazes are for the ant, the closed loop for")])
def test_what_makes_no_sense_gets_one_line(stage, flags, line):
    done = stage(**flags)
    assert done.code == 2 and done.err.count("\n") == 1 and done.err.startswith(f"04_mpc_maze.py: {line}"), done.err


@pytest.mark.parametrize("table, row, line", [
    ("MAZE", dict(WALLS=[(1, 0, 0, 1)]), "each is (x0, x1, y0, y1), x0 < x1"),
    ("MAZE", dict(WALLS=[10, 11, -6, 6]), "each is (x0, x1, y0, y1)"), ("MAZE", dict(HOLDS=3), "wedis in mine: HOLDS is no constant"),
    ("METHODS", dict(HOLD="x"), "mine in maze1: HOLD is 'x', but must be a whole number"),
    ("METHODS", dict(PLANNED=0), "mine in maze1: PLANNED is 0, but must be a whole number of at least 1"),
    ("METHODS", dict(OUT="x"), "mine in maze1: OUT is no constant")])
def test_rows_that_make_no_sense_get_one_line(s4, stage, table, row, line):
    getattr(s4, table)["mine"] = row
    done = stage(**{dict(MAZE="mazes", METHODS="method")[table]: "mine"})
    assert done.code == 2 and line in done.err and done.err.count("\n") == 1, done.err


def test_a_policy_of_another_method_is_named(stage):
    done = stage(policy="ant_dads", mazes="maze1", modes="printed", length=1)
    assert done.code == 0, done.err
    assert "wedis printed, maze1, ant_dads seed 0" in done.out
