"""Stage 4: geometry against dense sampling, walls that touch, Algorithm 2 against loops, Table 2 against the paper, the command line."""
from types import SimpleNamespace

import common
import numpy as np
import pytest
import torch
from conftest import cli


def case(**changed):
    return SimpleNamespace(**dict(reward="dense", prediction="decoder", objective="final", samples=200, look_ahead=0, options="") | changed)


@pytest.fixture
def skills(s4):
    """WEDIS in Maze 1 with an untrained decoder, made livelier so that its paths differ."""
    torch.manual_seed(0)
    s4.POOL = 4096
    found = s4.Skills("wedis", "maze1")
    found.decoder, found.weight, found.top = common.Decoder(3).requires_grad_(False), 0.3, torch.full((3,), 1.5)
    found.decoder.head[2].weight *= 40
    return found


# ---------------------------------------------------------------- geometry

def test_distances_are_the_papers(s4):
    assert np.hypot(*np.subtract(s4.GOAL, s4.START)) == pytest.approx(26.8, abs=0.05)
    assert sum(np.subtract(s4.GOAL, s4.START)) == 36  # A.1.4: the effective distance


@pytest.mark.parametrize("maze, scale, n, length", [("maze1", 30, 500, 2), ("s_maze", 30, 500, 2), ("obstacles", 0.3, 500, 2), ("maze2", 2, 50, 45)])
def test_collisions_agree_with_dense_sampling(s4, maze, scale, n, length):
    rng = np.random.default_rng(0)
    path = rng.uniform([-8, -8], [33, 20], (n, 1, 2)) + np.pad(np.cumsum(rng.uniform(-scale, scale, (n, length, 2)), 1), ((0, 0), (1, 0), (0, 0)))
    found = s4.collides(torch.from_numpy(path.astype(np.float32)), s4.MAZE[maze], 1.0).numpy()
    points = path[:, :-1, None] + np.linspace(0, 1, 1501)[:, None] * np.diff(path, axis=1)[:, :, None]
    hit = np.zeros((n, length), bool)
    for x0, x1, y0, y1 in s4.MAZE[maze]:
        hit |= ((points >= (x0 - 1, y0 - 1)) & (points <= (x1 + 1, y1 + 1))).all(3).any(2)
    assert (hit != found).sum() <= 2 and 0.05 < found.mean() < 0.95  # sampling misses a corner cut shorter than its step


def test_a_transition_that_stands_still_collides_where_it_stands(s4):
    still = torch.tensor([[[7.0, 0.0]] * 2, [[9.4, 0.0]] * 2, [[10.6, 0.0]] * 2])
    assert s4.collides(still, [(9, 10, -1, 1)], 0.5).flatten().tolist() == [False, True, False]


def test_no_straight_line_but_some_path_solves_each_maze(s4):
    ways = dict(maze1=[(0, 0), (19.5, 2), (24, 12)], maze2=[(0, 0), (6, 1), (10, 2), (15.2, 9.5), (19, 10), (24, 12)],
                s_maze=[(0, 0), (9.5, 4), (28.5, -4), (38, 0)], obstacles=[(0, 0), (4, 5), (8, 7), (17, 8)])
    assert set(ways) == set(s4.MAZE)
    for maze, way in ways.items():
        assert s4.collides(torch.tensor([[way[0], way[-1]]], dtype=torch.float32), s4.MAZE[maze], s4.RADIUS).any(), maze
        assert not s4.collides(torch.tensor([way], dtype=torch.float32), s4.MAZE[maze], s4.RADIUS).any(), maze


def test_walls_stop_the_ant_and_the_sensor_feels_it(s4):
    robots = common.Robots(s4.maze_spec([(1.2, 2.2, -5, 5)]), 2)
    touch = robots.batch.bind("sensordata")
    robots.qpos[1, 0] = -20
    felt = np.zeros(2, bool)
    for _ in range(60):
        robots.qvel[:, 0] = 1  # pushed along x, no faster than it walks
        robots.step(np.zeros((2, 8)))
        felt |= touch[:, 0] > 0
    assert felt.tolist() == [True, False]
    assert robots.qpos[0, 0] < 1.2 and robots.qpos[1, 0] > -20 + 2


# ---------------------------------------------------------------- what skills promise

def test_promised_paths_are_algorithm_2_line_by_line(s4, skills):
    z, start = torch.randn(3, 2, 3), torch.tensor([1.0, -2.0])
    path = s4.scaled_path(start, skills.promise(z.flatten(0, 1), "decoder").view(3, 10, 2))
    for n in range(3):
        state, expected = start.clone(), [start]
        for j in range(2):
            for delta in skills.decoder(z[n, j:j + 1], 5)[0][0]:
                state = state + 0.1 * 40 * delta
                expected.append(state)
        torch.testing.assert_close(path[n], torch.stack(expected), atol=1e-5, rtol=1e-5)


def test_a_scaled_arc_has_its_closed_form(s4):
    """Steps of length d that turn by a each end at d (1 - e^{iaK}) / (1 - e^{ia}): scaling by H_z scales the arc, and nothing else."""
    for hold in (1, 40):
        angle, k = 0.2, torch.arange(12)
        delta = 0.1 * hold * torch.stack([torch.cos(angle * k), torch.sin(angle * k)], 1)[None]
        end = s4.scaled_path(torch.tensor([3.0, 4.0]), delta)[0, -1]
        closed = 3 + 4j + 0.1 * hold * (1 - np.exp(12j * angle)) / (1 - np.exp(1j * angle))
        assert end.tolist() == pytest.approx([closed.real, closed.imag], rel=1e-5)


@pytest.mark.parametrize("name", ["wedis", "wedis_s", "wedis_nts"])
def test_the_table_of_first_steps_reads_like_the_decoder(s4, skills, name):
    found = s4.Skills(name, "maze1")
    found.decoder, found.weight, found.top = skills.decoder, skills.weight, skills.top
    z = 1.5 * (2 * torch.rand(500, 3) - 1)
    exact = 0.1 * found.hold * common.predict(skills.decoder, z, found.length, skills.weight)
    assert exact.std() > 0.02 * found.hold
    torch.testing.assert_close(found.promise(z, "relation"), exact, atol=2e-4 * found.hold, rtol=0)


# ---------------------------------------------------------------- the planner

@pytest.mark.parametrize("reward", ["dense", "sparse"])
@pytest.mark.parametrize("objective", ["final", "sum"])
def test_plan_is_the_best_of_its_samples(s4, skills, reward, objective):
    start = torch.tensor([18.0, 6.0])
    found, path = s4.plan(skills, case(reward=reward, objective=objective), start, 2, 5, None, torch.Generator().manual_seed(5))
    pool, _ = skills.pool("decoder", False)
    assert pool.abs().max() <= 1.5 and pool[:, 0].min() >= 0 and pool[:, 1:].min() < -1.49
    z = pool[torch.randint(len(pool), (200, 2), generator=torch.Generator().manual_seed(5))]
    scores = []
    for candidate in z:
        p = s4.scaled_path(start, torch.cat([0.1 * 40 * skills.decoder(skill[None], 5)[0][0] for skill in candidate])[None])
        r = [-(q - torch.tensor(s4.GOAL)).norm() for q in p[0, 1:]]
        r = [5.0 * (abs(v) < 5) for v in r] if reward == "sparse" else r
        scores.append(float((r[-1] if objective == "final" else sum(r)) - 100 * s4.collides(p, s4.MAZE["maze1"], 1.0).sum()))
    chosen = [i for i in range(200) if torch.equal(z[i], found)]
    assert scores[chosen[0]] == pytest.approx(max(scores), abs=1e-3) and max(scores) > np.median(scores)
    torch.testing.assert_close(path[-1], s4.scaled_path(start, skills.promise(found, "decoder").flatten(0, 1)[None])[0, -1])


def toy(s4, samples, planner, seed, warm=None):
    """Plans through Maze 1 with skills that are exact arcs. Returns how far the plan ends from the goal (1000 if it hits a wall), how many
    paths were rolled out, and the skills."""
    def promise(z, _):
        heading = 0.85 * z[:, 1:2] + 0.2 * z[:, 2:] * torch.arange(5)
        return (1.7 + 1.1 * z[:, :1, None]) * torch.stack([heading.cos(), heading.sin()], -1)

    s4.PLANNER, s4.POOL, rolled_out, score = planner, 4096, [], s4.score
    s4.score = lambda path, *rest: rolled_out.append(len(path)) or score(path, *rest)
    skills = s4.Skills("wedis", "maze1")
    skills.top, skills.promise = torch.full((3,), 1.5), promise
    z, path = s4.plan(skills, case(samples=samples), torch.zeros(2), 3, 5, warm, torch.Generator().manual_seed(seed))
    s4.score = score
    for kept in (z, path):  # not views that keep all N in memory
        assert kept.untyped_storage().nbytes() == kept.numel() * kept.element_size()
    hit = s4.collides(path[None], skills.walls, s4.RADIUS).any()
    return 1000 if hit else float((path[-1] - torch.tensor(s4.GOAL)).norm()), sum(rolled_out), z


def test_cem_ends_nearer_than_shooting_at_equal_roll_outs(s4):
    runs = {planner: [toy(s4, 1003, planner, seed)[:2] for seed in range(12)] for planner in ("shooting", "cem")}
    assert {used for results in runs.values() for _, used in results} == {1003}
    near = {planner: np.mean([distance for distance, _ in results]) for planner, results in runs.items()}
    assert near["cem"] < 0.5 * near["shooting"] < 5


@pytest.mark.parametrize("planner", ["shooting", "cem"])
def test_a_warm_start_is_never_made_worse(s4, planner):
    good, _, z = toy(s4, 2000, "cem", 0)
    assert toy(s4, 8, planner, 1)[0] > good
    assert toy(s4, 8, planner, 1, warm=z)[0] <= good + 1e-4


def test_options_of_the_score(s4):
    goal, wall = (10.0, 0.0), [(20, 21, -5, 5)]
    through = torch.tensor([[[0.0, 0.3], [6, 0.3], [14, 0.3], [22, 0.3]], [[0, 3], [6, 3], [14, 3], [14, 4]]])
    score = lambda sparse=False: s4.score(through, wall, goal, sparse, "final")  # noqa: E731
    ends = (through[:, -1] - torch.tensor(goal)).norm(dim=1)
    torch.testing.assert_close(score(), -ends - torch.tensor([100.0, 0]))
    s4.STOP_AT_GOAL = 1.0  # the first passes the goal at 0.3 m, between two planned states, before it comes to the wall
    torch.testing.assert_close(score(), torch.tensor([-0.3, -ends[1]]))
    assert score(True).tolist() == [5, 0]
    s4.EPSILON, s4.TIE_BREAK = 6.0, True
    torch.testing.assert_close(score(True), torch.tensor([5 - 0.3 / 6, 5 - ends[1] / 6]))
    s4.STOP_AT_GOAL, s4.MARGIN = 0.0, 5.5  # the wall grown by 6.5 m begins at 13.5 m: two transitions of each are in it
    torch.testing.assert_close(score(), -ends - torch.tensor([100.0, 0]) - 2)


# ---------------------------------------------------------------- tables

def test_table_2_is_the_papers(s4):
    """H_E, H_z, T, steps a skill, H_P dense and sparse as printed; the ranges of App. A.1.4's text, which its table swaps for DADS and SeCTAR."""
    printed = dict(sectar=(600, 1, 40, 40, 4, 15, 1.5, -1.5), dads=(300, 20, 1, 20, 4, 15, 1.0, -1.0), wedis_s=(600, 40, 1, 40, 4, 15, 1.5, 0),
                   wedis_nts=(600, 1, 20, 20, 4, 30, 1.5, 0), wedis=(600, 40, 5, 200, 3, 3, 1.5, 0))
    rows = s4.table2()
    assert {row["method"]: tuple(row.values())[1:] for row in rows} == printed
    for row in rows:  # App. A.1.4: sparse tasks are planned to the episode's end
        assert row["skills_sparse"] == row["episode_steps"] // row["steps_per_skill"]
    s, o = s4.Skills("wedis", "s_maze"), s4.Skills("wedis", "obstacles")  # Fig 18's caption
    assert (s.length, s.hold, s.planned_dense) == (6, 50, 2) and (o.length, o.hold, o.planned_dense) == (5, 50, 1)


def test_claims_are_judged_by_the_interval_of_the_difference(s4):
    rng = np.random.default_rng(0)
    rows = [dict(maze="maze1", reward="dense", method=method, prediction="relation", samples=samples, final_distance=str(d))
            for method, samples, mean in (("wedis", "1000", 2), ("wedis", "100", 9), ("wedis_s", "1000", 9), ("wedis_nts", "1000", 5))
            for d in rng.normal(mean, 1, 30)]
    found = {(row["claim"].split()[-1], row["better"], row["worse"]): row for row in s4.claims(rows, "relation")
             if (row["maze"], row["reward"]) == ("maze1", "dense")}
    assert found["cases", "wedis", "wedis_s"]["verdict"] == found["cases", "wedis", "wedis_nts"]["verdict"] == "holds"
    assert found["samples", "wedis", "wedis_s"]["verdict"] == "undecided"
    assert found["samples", "wedis", "wedis_nts"]["verdict"] == found["WEDIS-NTS", "wedis_s", "wedis_nts"]["verdict"] == "does not hold"
    assert found["DADS", "wedis_s", "dads"]["verdict"] == "no data"
    row = found["cases", "wedis", "wedis_s"]
    assert row["low"] < 7 < row["high"] and row["high"] - row["low"] == pytest.approx(4 * (2 / 30) ** 0.5, rel=0.25)  # of a normal


# ---------------------------------------------------------------- command line

def test_command_line_prints_the_table_and_writes_everything(fork, tmp_path):
    flags = ["--out", tmp_path, "--trials", 2, "--samples", 50]
    done = fork("04_mpc_maze", *flags, "--episode", 200)
    assert done.returncode == 0, done.stderr
    rows = common.read_csv(tmp_path / "results/mazes.csv")
    assert len(rows) == 2 * 2 * 2 * 2 and {row["maze"] for row in rows} == {"maze1", "maze2"}
    assert all(float(row["min_distance"]) <= float(row["final_distance"]) for row in rows)
    assert all(f"| {maze} | {reward} | {p} | final |" in done.stdout for maze in ("maze1", "maze2") for reward in ("dense", "sparse")
               for p in ("relation", "decoder"))
    for name in ("fig03_trajectory_scaling.png", "fig06_mazes.png", "fig08_mpc_examples.png", "fig17_more_examples.png", "maze1.gif", "maze2.gif"):
        assert (tmp_path / "figures" / name).stat().st_size > 10_000
    again = fork("04_mpc_maze", *flags, "--episode", 200, "--animate", "false")  # same seed, same numbers
    assert again.returncode == 0
    strip = lambda rs: [{k: v for k, v in r.items() if k != "planning_ms"} for r in rs]  # noqa: E731
    assert strip(common.read_csv(tmp_path / "results/mazes.csv")) == strip(rows)


def test_figure_7_goes_on_where_it_stopped(fork, tmp_path):
    flags = ["--experiment", "figure7", "--out", tmp_path, "--trials", 2, "--sample_sizes", "3 10", "--mazes", "maze1", "--episode", 200,
             "--rewards", "dense"]
    done = fork("04_mpc_maze", *flags, "--method", "wedis dads")
    assert done.returncode == 0, done.stderr
    assert "dads is left out: no policy_ant_dads_seed0.pt; make it with: python 03_train_policy.py --experiment ant_dads --seed 0" in done.stdout \
        or (common.HERE / "pretrained/policy_ant_dads_seed0.pt").exists()
    rows = common.read_csv(tmp_path / "results/figure7.csv")
    first = [row for row in rows if row["method"] == "wedis"]
    assert len(first) == 2 * 2 * 2 and {row["look_ahead"] for row in first} == {"200"}  # no plan looks beyond the episode's end
    assert (tmp_path / "figures/fig07_planning.png").stat().st_size > 10_000
    assert len(common.read_csv(tmp_path / "results/claims.csv")) == 2 * 15 and len(common.read_csv(tmp_path / "results/table2.csv")) == 5
    again = fork("04_mpc_maze", *flags, "--method", "wedis wedis_s")
    assert again.returncode == 0 and "wedis in maze1 is in figure7.csv already" in again.stdout, again.stderr
    rows = common.read_csv(tmp_path / "results/figure7.csv")
    assert [row for row in rows if row["method"] == "wedis"] == first and {row["method"] for row in rows} >= {"wedis", "wedis_s"}


def test_stopping_at_the_goal_ends_a_trial_where_it_was_nearest(fork, tmp_path):
    flags = ["--experiment", "best", "--out", tmp_path, "--trials", 2, "--mazes", "maze1", "--rewards", "dense", "--sample_sizes", 100,
             "--stop_at_goal", 40]  # everywhere is near: it stops as soon as it walks away
    done = fork("04_mpc_maze", *flags)
    assert done.returncode == 0, done.stderr
    rows = common.read_csv(tmp_path / "results/best.csv")
    assert len(rows) == 2 and all("planner=cem" in row["options"] and "stop_at_goal=40.0" in row["options"] for row in rows)
    assert all(float(row["final_distance"]) - float(row["min_distance"]) < 0.3 for row in rows)


def test_without_a_gl_library_the_gif_is_drawn_by_matplotlib(tmp_path):
    done = cli("04_mpc_maze", "--out", tmp_path, "--trials", 1, "--samples", 5, "--episode", 200, "--mazes", "maze1", "--rewards", "dense",
               "--predictions", "relation", MUJOCO_GL="disable")
    assert done.returncode == 0 and "drawn by matplotlib" in done.stdout, done.stderr
    assert (tmp_path / "figures/maze1.gif").stat().st_size > 10_000


@pytest.mark.parametrize("flags, line", [
    (["--method", "ppo"], "unknown method 'ppo'; allowed: wedis wedis_s wedis_nts dads sectar"),
    (["--planner", "random"], "unknown planner 'random'; allowed: shooting cem"),
    (["--experiment", "fig18", "--mazes", "maze1"], "unknown maze 'maze1'; allowed: s_maze obstacles"),
    (["--sample_sizes", "10 0"], "--sample_sizes and --look_aheads are whole numbers above 0 with blanks between them")])
def test_a_wrong_choice_gets_one_line(flags, line, tmp_path, monkeypatch, capsys):
    import runpy
    script = str(common.HERE / "04_mpc_maze.py")
    monkeypatch.setattr("sys.argv", [script, "--out", str(tmp_path), *flags])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(script, run_name="__main__")
    assert (end.value.code, capsys.readouterr().err) == (2, f"04_mpc_maze.py: {line}\n")
